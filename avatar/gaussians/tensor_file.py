"""Read safetensors files with a JSON header of their own, and write and read bound Gaussians in them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians
from smplxpp.core.errors import InputError
from smplxpp.core.files import as_object, parse_json, regular_file
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.json_file import as_integer, as_text, shown

_DAMAGED = (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError, RuntimeError)
"""Exceptions that the library raises for a damaged file or a type that torch does not know."""


@dataclass(frozen=True)
class TensorFile:
    """A file of tensors whose header has been read; its tensors are read on demand.

    Attributes:
        path: of the file.
        subject: name of the file in errors.
        expected: description of a right file, for errors.
        about: the header; empty for a file without one.
    """

    path: Path
    subject: str
    expected: str
    about: Mapping[str, Any]

    def tensors(self) -> dict[str, Tensor]:
        """Read all tensors of the file by name.

        They take at most the file's size, because the library checks their shapes against it.

        Raises:
            InputError: a damaged file, or a type that torch does not know.
        """
        try:
            with safe_open(self.path, framework="pt") as file:
                return {name: file.get_tensor(name) for name in file.keys()}
        except _DAMAGED as error:
            raise InputError(self.subject, expected=self.expected, received=_message(error)) from None


def open_tensor_file(
    path: str | Path, *, subject: str, header: str | None, expected: str = "a safetensors file", remedy: str = ""
) -> TensorFile:
    """Read the header of a safetensors file.

    Args:
        path: of the file.
        subject: name of the file in errors.
        header: key of the metadata that holds a JSON object describing the file; None: there is none.
        expected: description of a right file, for errors.
        remedy: advice for a missing file.

    Raises:
        InputError: missing, damaged or foreign file.
    """
    path = regular_file(path, subject=subject.removesuffix(str(path)).strip(), remedy=remedy)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except _DAMAGED as error:
        raise InputError(subject, expected=expected, received=_message(error), remedy=remedy) from None
    if header is None:
        return TensorFile(path, subject, expected, {})
    if header not in metadata:
        received = f"another file, without {header!r} in its metadata"
        raise InputError(subject, expected=expected, received=received, remedy=remedy)
    about = as_object(parse_json(metadata[header], subject=f"{subject}: metadata"), subject=f"{subject}: metadata")
    return TensorFile(path, subject, expected, about)


def require_finite(tensors: Mapping[str, Tensor], *, subject: str, remedy: str = "") -> None:
    """Raise `InputError` that names the first tensor with NaN or infinity in it, and how many."""
    for name, value in tensors.items():
        # The sum is not finite where a value is not, and where it overflows; it takes a quarter of the time.
        if not value.is_floating_point() or math.isfinite(value.detach().sum()):
            continue
        if not bool(torch.isfinite(value).all()):
            wrong = int((~torch.isfinite(value)).sum())
            raise InputError(
                f"{subject}: {name}",
                expected="finite values",
                received=f"NaN or infinity in {wrong} of {value.numel()}",
                remedy=remedy,
            )


def require_like(
    tensors: Mapping[str, Tensor], wanted: Mapping[str, Tensor], *, subject: str, remedy: str = ""
) -> None:
    """Raise `InputError` unless each of `wanted` is among the tensors, of its shape and kind (floats, integers, bools).

    Only shapes and types of `wanted` are used, so it may lie on torch's device "meta".
    """
    for name, model in wanted.items():
        given = tensors.get(name)
        if given is None or given.shape != model.shape or _kind(given) != _kind(model):
            raise InputError(
                subject,
                expected=f"{name} of shape {tuple(model.shape)}, {_kind(model)}",
                received="none" if given is None else f"shape {tuple(given.shape)}, {_kind(given)}",
                remedy=remedy,
            )


def _kind(value: Tensor) -> str:
    if value.dtype == torch.bool:
        return "bools"
    return "floats" if value.is_floating_point() else "complex numbers" if value.is_complex() else "integers"


def _message(error: Exception) -> str:
    return (str(error) or type(error).__name__)[:300]


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
