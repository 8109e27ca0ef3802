"""Read the colours and textures of an OBJ file's materials from its `.mtl` files."""

from __future__ import annotations

import codecs
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from smplxpp.core.files.paths import read_bytes
from smplxpp.core.mesh_files.raw_mesh import decode_name, warn
from smplxpp.core.mesh_files.texture import file_beside

# Options before the name of a texture, with the number of their arguments; vectors have one to three.
_OPTIONS = {"-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-cc": 1}
_VECTORS = ("-mm", "-o", "-s", "-t")


@dataclass(frozen=True, eq=False)
class Material:
    """Colour of a material: a plain colour, or a texture with its placement.

    With a texture `Kd` is ignored: it should be a factor, but exporters write 0.8 or 0 there without meaning it.

    Attributes:
        color: (3,) of `Kd`; None without it.
        picture: name of the texture in `map_Kd`; None without it.
        scale: factor of the texture coordinates.
        offset: offset of the texture coordinates after scaling.
        clamp: repeat the last texels outside the texture instead of the whole texture.
    """

    color: UInt8[np.ndarray, " 3"] | None = None
    picture: str | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False

    @property
    def key(self) -> tuple[object, ...]:
        """What a material looks like: equal for materials of other names that look alike."""
        color = None if self.color is None else self.color.tobytes()
        return color, self.picture, self.scale, self.offset, self.clamp


def read_materials(path: Path, libraries: list[str]) -> dict[str, Material]:
    """Return the materials of an OBJ file by name; missing files are left out with a warning.

    Args:
        path: path of the OBJ file.
        libraries: text after `mtllib` of each line: a name with blanks in it, or several names.
    """
    out: dict[str, Material] = {}
    seen: set[Path] = set()
    names: list[str] = []
    # Material files that are looked for: scenes have a few.
    most_libraries = 1000
    for entry in list(dict.fromkeys(libraries))[:most_libraries]:
        # A name may contain blanks; only if no such file exists does the line list several libraries.
        names += [entry] if file_beside(path, entry) is not None else entry.split()
    names = list(dict.fromkeys(names))
    missing = names[most_libraries:]
    for name in names[:most_libraries]:
        found = file_beside(path, name)
        if found is None:
            missing.append(name)
        elif found not in seen:
            seen.add(found)
            out |= _parse(read_bytes(found, subject="material file", most=1 << 24))
    if missing:
        more = f" and {len(missing) - 1} more are not" if len(missing) > 1 else " is not"
        warn(f"mesh file {path}: colours of its materials are lost: {missing[0][:200]!r}{more} in its folder")
    return out


def _parse(data: bytes) -> dict[str, Material]:
    out: dict[str, Material] = {}
    name = ""
    for line in data.removeprefix(codecs.BOM_UTF8).replace(b"\r", b"\n").split(b"\n"):
        words = [*line.split(None, 1), b"", b""]
        keyword, rest = words[0].lower().decode("latin-1"), decode_name(words[1])
        known = out.get(name, Material())
        if keyword == "newmtl":
            name = rest
            out[name] = Material()
        # A texture replaces the plain colour, whichever line comes first.
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
    """Parse the text after `map_Kd`: options, then a name, which may contain blanks."""
    words, given = text.split(), dict[str, list[str]]()
    while words and words[0] in (*_OPTIONS, *_VECTORS) and len(words) > 1:
        option = words.pop(0)
        given[option] = []
        for _ in range(3 if option in _VECTORS else _OPTIONS[option]):
            # The last two numbers of a vector may be missing.
            if len(words) > 1 and (option not in _VECTORS or _is_number(words[0])):
                given[option].append(words.pop(0))
    return Material(
        picture=" ".join(words) if given else text,
        scale=_pair(given.get("-s", []), 1.0),
        offset=_pair(given.get("-o", []), 0.0),
        clamp=given.get("-clamp") == ["on"],
    )


def _pair(words: list[str], default: float) -> tuple[float, float]:
    """Return the first two numbers of an option; missing or infinite ones have the default."""
    values = [float(word) for word in words[:2]]
    values = [value if np.isfinite(value) else default for value in values] + [default, default]
    return values[0], values[1]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
