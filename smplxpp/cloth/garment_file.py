"""Garments of a template as a file: an npz without pickled objects, the same bytes for the same garments."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.cloth.collider import ColliderMesh
from smplxpp.cloth.driver import DriverConfig
from smplxpp.cloth.embedding import Embedding
from smplxpp.cloth.garment import Garment, GarmentConfig
from smplxpp.cloth.model import Fabric, SolverConfig
from smplxpp.core import BodyParams, InputError, TriangleMesh, row_lengths
from smplxpp.core.files import as_integer, as_list, as_number, as_object, as_text, parse_json, read_arrays, write_arrays
from smplxpp.core.params import ARRAY_NAMES
from smplxpp.template.template import Template

SCHEMA = 1
_ABOUT = "smplxpp_garments"
_REMEDY = "train again, or take the file as `smplxpp train` wrote it"
# Arrays of a garment by name: type and shape, whose letters are sizes.
_ARRAYS: Mapping[str, tuple[type, str]] = {
    "particles": (np.int64, "n"),
    "rest_vertices": (np.float64, "n 3"),
    "rest_faces": (np.int64, "m 3"),
    "lengths": (np.float64, "e"),
    "depth": (np.float64, "n"),
    "vertices": (np.int64, "N"),
    "vertex_depth": (np.float64, "N"),
    "corners": (np.int32, "N 3"),
    "weights": (np.float32, "N 3"),
    "offset": (np.float32, "N 3"),
    "collider_vertices": (np.int64, "c"),
    "collider_faces": (np.int32, "d 3"),
    "collider_margin": (np.float32, "c"),
    "collider_deepest": (np.float32, "c"),
}
# What they index: vertices of the template, particles, vertices of the collider.
_INDICES = {"particles": "V", "vertices": "V", "collider_vertices": "V", "rest_faces": "n", "corners": "n"}


def save_garments(path: str | Path, garments: Sequence[Garment]) -> None:
    """Write garments, whole or not at all; none is a file too."""
    arrays, about = garments_to_arrays(garments)
    write_arrays(path, {_ABOUT: np.array(json.dumps(about)), **arrays})


def garments_to_arrays(garments: Sequence[Garment]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays of garments by name, and what else a file has to say of them, as JSON."""
    about = [{"part": g.part, "config": asdict(g.config)} for g in garments]
    arrays: dict[str, np.ndarray] = {}
    for k, garment in enumerate(garments):
        own = {
            "particles": garment.particles,
            "rest_vertices": garment.rest.vertices,
            "rest_faces": garment.rest.faces,
            "lengths": garment.lengths,
            "depth": garment.depth,
            "vertices": garment.vertices,
            "vertex_depth": garment.vertex_depth,
            "corners": garment.embedding.corners,
            "weights": garment.embedding.weights,
            "offset": garment.embedding.offset,
            "collider_vertices": garment.collider.vertices,
            "collider_faces": garment.collider.faces,
            "collider_margin": garment.collider.margin,
            "collider_deepest": garment.collider.deepest,
        }
        arrays |= {f"{k}.{name}": np.asarray(own[name], dtype=kind) for name, (kind, _) in _ARRAYS.items()}
        arrays |= {f"{k}.params.{name}": np.asarray(v) for name, v in garment.reference.as_dict().items()}
    return arrays, {"schema": SCHEMA, "garments": about}


def load_garments(path: str | Path, template: Template) -> list[Garment]:
    """Read the garments that `save_garments` wrote, with checks.

    Raises:
        InputError: missing, damaged or foreign file, one of a newer version, or one of another template.
    """
    subject = f"garments {path}"
    arrays = read_arrays(path, subject="garments", remedy=_REMEDY)
    text = arrays.get(_ABOUT)
    if text is None or text.shape != () or text.dtype.kind != "U":
        raise InputError(subject, expected="a file of garments", received="another npz", remedy=_REMEDY)
    about = as_object(parse_json(str(text.item()), subject=subject, remedy=_REMEDY), subject=subject)
    return garments_from_arrays(arrays, about, template, subject=subject)


def garments_from_arrays(
    arrays: Mapping[str, np.ndarray], about: Mapping[str, Any], template: Template, *, subject: str
) -> list[Garment]:
    """Return the garments that `garments_to_arrays` took apart.

    Raises:
        InputError: arrays that are missing or do not fit, a newer version, or another template.
    """
    schema = as_number(about.get("schema"), subject=f"{subject}: schema", least=1)
    if schema > SCHEMA:
        raise InputError(
            subject, expected=f"version {SCHEMA} or older", received=f"version {schema:g}", remedy="update smplxpp"
        )
    rows = as_list(about.get("garments"), subject=f"{subject}: garments")
    # An array without a meaning may have one in a newer version.
    own = (*_ARRAYS, *(f"params.{name}" for name in (*ARRAY_NAMES, "fps", "flat_hand_mean", "v_shape")))
    unknown = set(arrays) - {_ABOUT} - {f"{k}.{name}" for k in range(len(rows)) for name in own}
    if unknown:
        raise InputError(
            subject, expected=f"arrays of {len(rows)} garments", received=min(unknown)[:80], remedy=_REMEDY
        )
    return [
        _garment(arrays, k, as_object(row, subject=subject), template, f"{subject}: garment {k}")
        for k, row in enumerate(rows)
    ]


def _garment(
    arrays: Mapping[str, np.ndarray], k: int, about: Mapping[str, Any], template: Template, subject: str
) -> Garment:
    own = _checked({name: arrays.get(f"{k}.{name}") for name in _ARRAYS}, template, subject)
    prefix = f"{k}.params."
    params = {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
    rest = TriangleMesh(own["rest_vertices"], own["rest_faces"])
    if len(rest.edges) != len(own["lengths"]):
        raise InputError(
            subject, expected=f"{len(rest.edges)} lengths", received=str(len(own["lengths"])), remedy=_REMEDY
        )
    reference = BodyParams.from_mapping(params, source=subject)
    if len(reference) != 1:
        raise InputError(subject, expected="one reference pose", received=f"{len(reference)}", remedy=_REMEDY)
    # Another template may have as many vertices and more: particles are vertices, in the reference pose.
    off = float(row_lengths(template.pose(reference)[0][own["particles"]] - rest.vertices).max())
    # Metres: as near are vertices that were posed on two machines.
    same = 1e-4
    if not off < same:
        raise InputError(
            subject,
            expected="particles that are vertices of the template",
            received=f"some that are {1e3 * off:.3g} mm off",
            remedy="it is of another template: train again",
        )
    return Garment(
        part=as_text(about.get("part"), subject=f"{subject}: part"),
        config=_config(as_object(about.get("config"), subject=f"{subject}: config"), subject),
        reference=reference,
        particles=own["particles"],
        rest=rest,
        lengths=own["lengths"],
        depth=own["depth"],
        vertices=own["vertices"],
        vertex_depth=own["vertex_depth"],
        embedding=Embedding(own["corners"], own["weights"], own["offset"]),
        collider=ColliderMesh(
            own["collider_vertices"], own["collider_faces"], own["collider_margin"], own["collider_deepest"]
        ),
    )


def _checked(found: Mapping[str, np.ndarray | None], template: Template, subject: str) -> dict[str, np.ndarray]:
    """The arrays, each of its type and shape, finite, its indices inside what they point into."""
    sizes: dict[str, int] = {"V": template.vertex_count, "3": 3}
    out = {}
    for name, (kind, shape) in _ARRAYS.items():
        value = found[name]
        letters = shape.split()
        if value is None or value.dtype != kind or value.ndim != len(letters):
            received = "none" if value is None else f"{value.dtype} of shape {value.shape}"
            raise InputError(f"{subject}: {name}", expected=f"{kind.__name__} ({shape})", received=received)
        for letter, size in zip(letters, value.shape, strict=True):
            if sizes.setdefault(letter, size) != size:
                raise InputError(
                    f"{subject}: {name}", expected=f"shape ({shape})", received=f"{value.shape}", remedy=_REMEDY
                )
        # Depth is infinite without a path to an attachment.
        if name.endswith("depth") and not (value >= 0).all():
            raise InputError(f"{subject}: {name}", expected="metres from 0 on", received="others", remedy=_REMEDY)
        if value.dtype.kind == "f" and not name.endswith("depth") and not np.isfinite(value).all():
            raise InputError(f"{subject}: {name}", expected="finite numbers", received="infinity", remedy=_REMEDY)
        out[name] = value
    for name, letter in (*_INDICES.items(), ("collider_faces", "c")):
        value = out[name]
        if value.size and (value.min() < 0 or value.max() >= sizes[letter]):
            raise InputError(
                f"{subject}: {name}",
                expected=f"indices below {sizes[letter]}",
                received=f"{value.min()} to {value.max()}",
                remedy="it is of another template: train again" if letter == "V" else _REMEDY,
            )
    if not sizes["n"] or not sizes["N"] or not sizes["m"]:
        raise InputError(subject, expected="particles, faces and vertices", received="none", remedy=_REMEDY)
    return out


def _config(stored: Mapping[str, Any], subject: str) -> GarmentConfig:
    fabric = as_object(stored.get("fabric"), subject=f"{subject}: fabric")
    return GarmentConfig(
        **_numbers(stored, GarmentConfig, subject, without=("fabric",)),
        fabric=Fabric(**_numbers(fabric, Fabric, subject)),
    )


def _numbers(stored: Mapping[str, Any], cls: type, subject: str, *, without: tuple[str, ...] = ()) -> dict[str, float]:
    names = [field.name for field in fields(cls) if field.name not in without]
    return {name: as_number(stored.get(name), subject=f"{subject}: {name}", least=0.0, most=1e9) for name in names}


def simulation_from(about: Mapping[str, Any], *, subject: str) -> DriverConfig:
    """Return how garments are stepped, as a bundle says beside them; numbers that it lacks are the defaults.

    Raises:
        InputError: other than numbers, or ones so far from the defaults that a step would take minutes.
    """
    stored = as_object(about.get("simulation", {}), subject=f"{subject}: simulation")
    solver = as_object(stored.get("solver", {}), subject=f"{subject}: simulation: solver")
    return DriverConfig(
        **_options(stored, DriverConfig(), f"{subject}: simulation"),
        solver=SolverConfig(**_options(solver, SolverConfig(), f"{subject}: simulation: solver")),
    )


def _options(stored: Mapping[str, Any], usual: DriverConfig | SolverConfig, subject: str) -> dict[str, Any]:
    """The stored numbers of a configuration, up to ten times the default; steps of time from a tenth of it."""
    out: dict[str, Any] = {}
    for name, value in asdict(usual).items():
        if name not in stored or name == "solver":
            continue
        if value is None:  # the floor: a height, or none
            if stored[name] is not None:
                out[name] = as_number(stored[name], subject=f"{subject}: {name}", least=-1e4, most=1e4)
            continue
        least, most = 0.1 * value if name in ("substep", "ramp_step") else 0.0, max(10.0 * value, 0.1)
        out[name] = as_number(stored[name], subject=f"{subject}: {name}", least=least, most=most)
        if isinstance(value, int):
            out[name] = as_integer(stored[name], subject=f"{subject}: {name}", least=1)
    return out
