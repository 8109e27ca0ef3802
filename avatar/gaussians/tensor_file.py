"""Read safetensors files with a JSON header of their own, checked before their tensors are used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from smplxpp.core.errors import InputError
from smplxpp.core.files import as_object, parse_json, regular_file

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
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
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
