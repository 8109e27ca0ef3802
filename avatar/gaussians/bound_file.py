"""The file of bound Gaussians: safetensors with the digest of the mesh they belong to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from avatar.gaussians.binding import BoundGaussians
from smplxpp.core.atomic import atomic_path
from smplxpp.core.errors import InputError

SCHEMA = 1
_KIND = "bound_gaussians"


def save_bound(bound: BoundGaussians, path: str | Path) -> None:
    """Write all tensors and the mesh's digest, whole or not at all."""
    metadata = {"kind": _KIND, "schema": str(SCHEMA), "face_count": str(bound.face_count), "topology": bound.topology}
    tensors = {name: value.detach().cpu().contiguous() for name, value in bound.tensors.items()}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata=metadata)


def load_bound(path: str | Path, *, faces: np.ndarray | None = None) -> BoundGaussians:
    """Read what `save_bound` wrote, bit for bit.

    Args:
        path: the file.
        faces: (F, 3) of the template it is to be used with, checked when given.

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
    if metadata.get("kind") != _KIND or metadata.get("schema") != str(SCHEMA):
        raise InputError(
            subject,
            expected=f"{_KIND} of schema {SCHEMA}",
            received=f"{metadata.get('kind', 'something else')} of schema {metadata.get('schema', '?')}",
        )
    try:
        bound = BoundGaussians(**tensors, face_count=int(metadata["face_count"]), topology=metadata["topology"])
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
