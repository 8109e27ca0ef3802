"""Read and write files of bound Gaussians: safetensors with the digest of their mesh."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from safetensors.torch import save
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.tensor_file import open_tensor_file, require_finite
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.json_file import as_integer, as_text, shown

SCHEMA = 1
_KIND = "bound_gaussians"
_REMEDY = "take the file that `smplxpp fit` wrote, or fit again"


def save_bound(bound: BoundGaussians, path: str | Path) -> None:
    """Write all tensors and the mesh's digest; a failed write leaves no file."""
    # One metadata entry, because safetensors writes several in an order that differs from run to run.
    about = {"schema": SCHEMA, "face_count": bound.face_count, "topology": bound.topology}
    metadata = {_KIND: json.dumps(about, sort_keys=True)}
    tensors = {name: value.detach().cpu().contiguous() for name, value in bound.tensors.items()}
    atomic_write_bytes(path, save(tensors, metadata=metadata))


def load_bound(path: str | Path, *, faces: Int[np.ndarray, "F 3"] | None = None) -> BoundGaussians:
    """Read what `save_bound` wrote, bit for bit.

    Args:
        path: the file.
        faces: of the template, to check that the Gaussians belong to it; None: no check.

    Raises:
        InputError: a missing, damaged or foreign file, numbers that are not finite, or Gaussians of another mesh.
    """
    subject = f"Gaussians {path}"
    file = open_tensor_file(path, subject=subject, header=_KIND, remedy=_REMEDY)
    schema = file.about.get("schema")
    if schema != SCHEMA:
        raise InputError(subject, expected=f"{_KIND} of schema {SCHEMA}", received=f"schema: {shown(schema)}")
    bound = bound_from_tensors(file.tensors(), file.about, subject=subject)
    if faces is not None:
        bound.check_topology(faces, subject)
    return bound


def bound_from_tensors(tensors: Mapping[str, Tensor], about: Mapping[str, Any], *, subject: str) -> BoundGaussians:
    """Make Gaussians from the tensors of a file, checked.

    Args:
        tensors: the attributes by name, no others; integers of any size.
        about: metadata of the file: `face_count` and `topology`.
        subject: name of the file in errors.

    Raises:
        InputError: attributes that are missing, unknown, of other shapes or types, or not finite; a quaternion of
            length 0.
    """
    # The set of tensors has to be exactly that of `BoundGaussians`.
    names = [field.name for field in fields(BoundGaussians) if field.name not in ("face_count", "topology")]
    if set(tensors) != set(names):
        missing, unknown = sorted(set(names) - set(tensors)), sorted(set(tensors) - set(names))
        received = [f"no {', '.join(missing)}"] if missing else []
        received += [f"unknown {', '.join(unknown)[:200]}"] if unknown else []
        raise InputError(
            subject,
            expected=f"all tensors of bound Gaussians: {', '.join(names)}",
            received="; ".join(received),
            remedy=_REMEDY,
        )
    count = as_integer(about.get("face_count"), subject=f"{subject}: face_count", least=0)
    topology = as_text(about.get("topology"), subject=f"{subject}: topology")
    # Types and finite values here; shapes and ranges in `BoundGaussians`.
    index = tensors["face_index"]
    if index.is_floating_point() or index.is_complex() or index.ndim != 1:
        raise InputError(
            f"{subject}: face_index", expected="whole numbers of shape (N,)", received=f"{index.dtype}, {index.ndim} D"
        )
    for name, value in tensors.items():
        if name != "face_index" and not value.is_floating_point():
            raise InputError(f"{subject}: {name}", expected="floats", received=str(value.dtype))
    require_finite(tensors, subject=subject, remedy=_REMEDY)
    try:
        # The dataclass checks shapes and ranges; its errors are given the file's name.
        bound = BoundGaussians(**{**tensors, "face_index": index.long()}, face_count=count, topology=topology)
    except InputError as error:
        raise InputError(f"{subject}: {error.subject}", expected=error.expected, received=error.received) from None
    if bool((bound.quats == 0).all(dim=1).any()):
        raise InputError(f"{subject}: quats", expected="quaternions of any length but zero", received="zero")
    return bound
