"""Return procedural people in order or by name, made afresh or read from a cache folder."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from smplxpp.body import BodyModel, load_body
from smplxpp.core import ARRAY_NAMES, BodyParams, InputError, TriangleMesh
from smplxpp.core.files import read_arrays, read_bytes, write_arrays
from smplxpp.people.cast import CAST, OUTSIDERS, Member
from smplxpp.people.making import make_person
from smplxpp.people.outside import outside_body, seed_of
from smplxpp.people.person_scan import PersonScan

CACHE_VARIABLE = "SMPLXPP_PEOPLE"


def people(
    *, count: int | None = None, seed: int = 0, cache: Path | None = None, outsiders: bool = False
) -> Iterator[PersonScan]:
    """Yield the scans of the cast, in order.

    Args:
        count: number of people, by default the whole cast; a larger one adds other people of the same kinds.
        seed: 0 gives the people as the cast describes them; others give other bodies, facings and patterns.
        cache: folder of people made before; by default the one that `SMPLXPP_PEOPLE` names, or none.
        outsiders: yield `OUTSIDERS` in place of `CAST`.
    """
    names = tuple(OUTSIDERS if outsiders else CAST)
    for k in range(len(names) if count is None else count):
        yield person(names[k % len(names)], seed=seed + k // len(names), cache=cache)


def person(name: str | int, *, seed: int = 0, cache: Path | None = None) -> PersonScan:
    """Return one scan by its name in the cast or among its outsiders, or by its place in the cast; see `people`.

    Raises:
        InputError: no member of the cast has that name.
    """
    name = tuple(CAST)[name] if isinstance(name, int) else name
    if name not in CAST | OUTSIDERS:
        raise InputError("person", expected=f"one of {', '.join(CAST | OUTSIDERS)}", received=name)
    folder = cache or (Path(os.environ[CACHE_VARIABLE]) if os.environ.get(CACHE_VARIABLE) else None)
    if folder is None:
        made = make_person(name, _member(name), _body(), seed=seed)
    else:
        made = _cached(folder / f"{_key(name, seed)}.npz", name, seed)
    return replace(made, name=f"{name} ({seed})") if seed else made


def _cached(path: Path, name: str, seed: int) -> PersonScan:
    """Return the person of a file, which is written first where it is missing."""
    if path.is_file():
        return _read(path, name, seed)
    made = make_person(name, _member(name), _body(), seed=seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(path, made)
    return made


@lru_cache
def _body() -> BodyModel:
    return load_body()


@lru_cache
def _code() -> bytes:
    """Return a digest of the sources that people follow from; the cast enters the key of each member."""
    room = Path(__file__).parent
    names = ("cloth_mesh", "scan_simulation", "textures", "bodies", "making", "outside", "paint")
    files = [*(room / f"{name}.py" for name in names), *sorted((room / "garments").glob("*.py"))]
    return hashlib.sha256(b"".join(read_bytes(path) for path in files)).digest()


def _key(name: str, seed: int) -> str:
    return hashlib.sha256(_code() + repr((name, _member(name), seed)).encode()).hexdigest()[:20]


def _write(path: Path, scan: PersonScan) -> None:
    arrays = {"vertices": scan.mesh.vertices, "faces": scan.mesh.faces, "labels": scan.face_labels, "seen": scan.seen}
    arrays |= {f"params_{key}": getattr(scan.params, key) for key in ARRAY_NAMES}
    if scan.colors is not None:
        arrays["colors"] = scan.colors
    write_arrays(path, arrays)


def _member(name: str) -> Member:
    return (CAST | OUTSIDERS)[name]


def _read(path: Path, name: str, seed: int) -> PersonScan:
    arrays = read_arrays(path, subject="cached person")
    return PersonScan.of(
        outside_body(_body(), _member(name).outside, seed=seed_of(name, seed)),
        BodyParams.from_mapping({key: arrays[f"params_{key}"] for key in ARRAY_NAMES}),
        name=name,
        mesh=TriangleMesh(arrays["vertices"], arrays["faces"]),
        colors=arrays.get("colors"),
        face_labels=arrays["labels"],
        seen=arrays["seen"],
    )
