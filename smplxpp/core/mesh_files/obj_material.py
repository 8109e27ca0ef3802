"""The colours of an OBJ file's materials, from its `.mtl` files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from smplxpp.core.files.paths import read_bytes
from smplxpp.core.mesh_files.raw_mesh import warn
from smplxpp.core.mesh_files.texture import beside

# How many numbers follow an option of a picture's name.
_OPTIONS = {"-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-cc": 1}
_VECTORS = ("-mm", "-o", "-s", "-t")
_MOST_BYTES = 1 << 24


@dataclass(frozen=True, eq=False)
class Material:
    """A material's colour: `color` (3,) of its `Kd`, `picture` the name in its `map_Kd`; None for what it lacks.

    Beside a picture `Kd` is left out: it should be a factor, but exporters write 0.8 or 0 there without meaning it.
    Texture coordinates are multiplied by `scale` and moved by `offset` before the picture is looked up; `clamp`: its
    last texels go on beyond its edges, where it would else be repeated.
    """

    color: UInt8[np.ndarray, " 3"] | None = None
    picture: str | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False


def read_materials(path: Path, libraries: list[str]) -> dict[str, Material]:
    """The materials of an OBJ file by name; a file that is missing or no text is left out with a warning.

    Args:
        path: of the OBJ file.
        libraries: what follows `mtllib`, a line an entry: a name with blanks in it, or several names.
    """
    out: dict[str, Material] = {}
    seen: set[Path] = set()
    for entry in dict.fromkeys(libraries):
        for name in [entry] if beside(path, entry) is not None else entry.split():
            found = beside(path, name)
            if found is None:
                warn(f"mesh file {path}: colours of its materials are lost: {name[:200]!r} is not in its folder")
            elif found not in seen:
                seen.add(found)
                data = read_bytes(found, subject="material file", most=_MOST_BYTES)
                out |= _parse(data.decode("utf-8", "replace"))
    return out


def _parse(text: str) -> dict[str, Material]:
    out: dict[str, Material] = {}
    name = ""
    for line in text.splitlines():
        words = line.split(None, 1) + ["", ""]
        keyword, rest = words[0].lower(), words[1].strip()
        known = out.get(name, Material())
        if keyword == "newmtl":
            name = rest
            out[name] = Material()
        elif keyword == "kd" and known.picture is None:
            out[name] = Material(_kd(rest))
        elif keyword == "map_kd" and rest:
            out[name] = _picture(rest)
    return out


def _kd(text: str) -> UInt8[np.ndarray, " 3"] | None:
    try:
        values = np.array([float(word) for word in text.split()[:3]])
    except ValueError:
        return None
    if len(values) != 3 or not np.isfinite(values).all():
        return None
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)


def _picture(text: str) -> Material:
    """What follows `map_Kd`: options, then a name, which may hold blanks."""
    words, given = text.split(), dict[str, list[str]]()
    while words and words[0] in (*_OPTIONS, *_VECTORS) and len(words) > 1:
        option = words.pop(0)
        given[option] = []
        for _ in range(3 if option in _VECTORS else _OPTIONS[option]):
            # Of a vector's three numbers the last two may be left out.
            if len(words) > 1 and (option not in _VECTORS or _is_number(words[0])):
                given[option].append(words.pop(0))
    return Material(
        picture=" ".join(words) if given else text,
        scale=_pair(given.get("-s", []), 1.0),
        offset=_pair(given.get("-o", []), 0.0),
        clamp=given.get("-clamp") == ["on"],
    )


def _pair(words: list[str], default: float) -> tuple[float, float]:
    """The first two numbers of an option; the default for one that is left out or infinite."""
    values = [float(word) for word in words[:2]]
    values = [value if np.isfinite(value) else default for value in values] + [default, default]
    return values[0], values[1]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
