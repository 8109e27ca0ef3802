"""The file of bound Gaussians: safetensors with the digest of the mesh they belong to."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from avatar.gaussians.binding import BoundGaussians
from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.errors import InputError

SCHEMA = 1
_KIND = "bound_gaussians"


def save_bound(bound: BoundGaussians, path: str | Path) -> None:
    """Write all tensors and the mesh's digest, whole or not at all."""
    # One entry: safetensors writes several in an order that differs from run to run.
    about = {"schema": SCHEMA, "face_count": bound.face_count, "topology": bound.topology}
    metadata = {_KIND: json.dumps(about, sort_keys=True)}
    tensors = {name: value.detach().cpu().contiguous() for name, value in bound.tensors.items()}
    atomic_write_bytes(path, save(tensors, metadata=metadata))


def load_bound(path: str | Path, *, faces: Int[np.ndarray, "F 3"] | None = None) -> BoundGaussians:
    """Read what `save_bound` wrote, bit for bit.

    Args:
        path: the file.
        faces: of the template it is to be used with, checked when given.

    Raises:
        InputError: a missing, damaged or foreign file, numbers that are not finite, or Gaussians of another mesh.
    """
    path = Path(path)
    subject = f"Gaussians {path}"
    if not path.is_file():
        raise InputError(subject, expected="an existing file", received="none")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise InputError(subject, expected="a safetensors file", received=str(error)) from None
    try:
        about = json.loads(metadata.get(_KIND, "{}"))
        schema = about.get("schema", "?") if _KIND in metadata else "something else"
    except (ValueError, AttributeError):
        about, schema = {}, "unreadable"
    if schema != SCHEMA:
        raise InputError(subject, expected=f"{_KIND} of schema {SCHEMA}", received=f"schema: {schema}")
    try:
        bound = BoundGaussians(**tensors, face_count=int(about["face_count"]), topology=about["topology"])
    except InputError as error:
        raise InputError(f"{subject}: {error.subject}", expected=error.expected, received=error.received) from None
    except (TypeError, KeyError, AttributeError, ValueError) as error:
        raise InputError(subject, expected="all tensors of bound Gaussians", received=str(error)) from None
    for name, value in bound.tensors.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise InputError(f"{subject}: {name}", expected="finite values", received="NaN or infinity")
    if faces is not None:
        bound.check_topology(faces, subject)
    return bound
