"""The people, one after the other or by name; made anew, or read from a folder that remembers them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import replace
from functools import cache as remembered
from pathlib import Path

import numpy as np

from benchmarks.people.cast import CAST
from benchmarks.people.making import make_person
from benchmarks.people.person_scan import PersonScan
from smplxpp.body import BodyModel, load_body
from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import read_arrays
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import ARRAY_NAMES, BodyParams

CACHE_VARIABLE = "SMPLXPP_PEOPLE"
_HERE = Path(__file__).parent
# What a person is made by: the cast is told apart by its members.
_SOURCES = ("builds", "stances", "tailor", "paint", "making")


def people(*, count: int | None = None, seed: int = 0, cache: Path | None = None) -> Iterator[PersonScan]:
    """The scans of the cast, in order.

    Args:
        count: of people, by default the whole cast; more than it has go on with other people of the same kinds.
        seed: 0 gives the people as they are described; another one other bodies, facings and patterns of these kinds.
        cache: a folder that remembers who was made; by default the one that `SMPLXPP_PEOPLE` names, or none.
    """
    names = tuple(CAST)
    for k in range(len(names) if count is None else count):
        yield person(names[k % len(names)], seed=seed + k // len(names), cache=cache)


def person(name: str | int, *, seed: int = 0, cache: Path | None = None) -> PersonScan:
    """One scan by its name in the cast, or by its place there; see `people` for the options.

    Raises:
        InputError: nobody has that name.
    """
    name = tuple(CAST)[name] if isinstance(name, int) else name
    if name not in CAST:
        raise InputError("person", expected=f"one of {', '.join(CAST)}", received=name)
    folder = cache or (Path(os.environ[CACHE_VARIABLE]) if os.environ.get(CACHE_VARIABLE) else None)
    if folder is None:
        made = make_person(name, CAST[name], _body(), seed=seed)
    else:
        made = _remembered(folder / f"{_key(name, seed)}.npz", name, seed)
    return replace(made, name=f"{name} ({seed})") if seed else made


def _remembered(path: Path, name: str, seed: int) -> PersonScan:
    """The person of a file, which is written where it is not there."""
    if path.is_file():
        return _read(path, name)
    made = make_person(name, CAST[name], _body(), seed=seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(path, made)
    return made


@remembered
def _body() -> BodyModel:
    return load_body()


@remembered
def _code() -> bytes:
    """The sources that people are made by."""
    synth = _HERE.parents[1] / "pipelines" / "synth"
    files = [_HERE / f"{name}.py" for name in _SOURCES]
    files += [*sorted((_HERE.parent / "garments").glob("*.py")), synth / "scan_simulation.py", synth / "textures.py"]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).digest()


def _key(name: str, seed: int) -> str:
    return hashlib.sha256(_code() + repr((name, CAST[name], seed)).encode()).hexdigest()[:20]


def _write(path: Path, scan: PersonScan) -> None:
    arrays = {"vertices": scan.mesh.vertices, "faces": scan.mesh.faces, "labels": scan.face_labels, "seen": scan.seen}
    arrays |= {f"params_{key}": getattr(scan.params, key) for key in ARRAY_NAMES}
    if scan.colors is not None:
        arrays["colors"] = scan.colors
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        # numpy's signature lists options of its own among the arrays' names.
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def _read(path: Path, name: str) -> PersonScan:
    arrays = read_arrays(path, subject="remembered person")
    return PersonScan.of(
        _body(),
        BodyParams.from_mapping({key: arrays[f"params_{key}"] for key in ARRAY_NAMES}),
        name=name,
        mesh=TriangleMesh(arrays["vertices"], arrays["faces"]),
        colors=arrays.get("colors"),
        face_labels=arrays["labels"],
        seen=arrays["seen"],
    )
