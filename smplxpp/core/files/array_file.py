"""The one door for arrays: npy and npz files whose sizes and types are checked before anything is allocated.

Files are written without the time they were written at: the same arrays give the same bytes. Arrays of objects are read
by `smplxpp.core.files.safe_pickle` alone.
"""

from __future__ import annotations

import io
import lzma
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.files.paths import regular_file

ObjectReader = Callable[[BinaryIO, str], Any]
"""Reads the pickle of an array of objects from a stream; the second argument names it in messages."""

_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER, _MOST_DIMENSIONS, _MOST_ENTRIES = 1 << 16, 32, 10_000
# Characters of a text in an array; names of joints have twenty.
_LONGEST_TEXT = 4096
# What an archive may unpack to: this much in any case, more if that is not much more than the file has.
_FREELY_UNPACKED, _MOST_UNPACKING = 1 << 29, 200
_PIECE = 1 << 20
_SUFFIX = ".npy"
# Everything that a damaged archive makes the standard library raise.
DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    OverflowError,
)


def write_arrays(path: str | Path, arrays: Mapping[str, np.ndarray], *, packing: int = zipfile.ZIP_DEFLATED) -> None:
    """Write arrays in their order, without pickled objects, whole or not at all; `np.load` reads the file.

    Args:
        path: of the file.
        arrays: by name.
        packing: how they are compressed, a constant of `zipfile`; deflate is the quickest of its levels.

    Raises:
        ValueError: an array of objects.
    """
    level = 1 if packing == zipfile.ZIP_DEFLATED else None
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
            # An entry made from its name alone has the date 1980-01-01.
            archive.writestr(zipfile.ZipInfo(f"{name}{_SUFFIX}"), stream.getbuffer(), packing, compresslevel=level)


def read_arrays(
    path: str | Path,
    *,
    subject: str = "file",
    remedy: str = "",
    keys: Iterable[str] | None = None,
    objects: ObjectReader | None = None,
) -> dict[str, np.ndarray]:
    """Read the arrays of an npz file, in their order.

    Args:
        path: of the file.
        subject: what the file is, for messages.
        remedy: what a user can do about a damaged one.
        keys: read these only (those that exist); None reads all.
        objects: reads arrays of objects; None refuses them.

    Raises:
        InputError: missing or damaged file, no npz, an array of another type, or one that says to be larger than its
            file can hold.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    wanted = None if keys is None else set(keys)
    out: dict[str, np.ndarray] = {}
    with _errors_said(f"{subject} {path}", "an npz of plain arrays", remedy):
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in archive.infolist() if entry.filename.endswith(_SUFFIX)]
            names = [entry.filename.removesuffix(_SUFFIX) for entry in entries]
            if len(set(names)) != len(names) or len(names) > _MOST_ENTRIES:
                raise ValueError(f"{len(names)} arrays of {len(set(names))} names")
            chosen = [(n, e) for n, e in zip(names, entries, strict=True) if wanted is None or n in wanted]
            _check_unpacking(sum(entry.file_size for _, entry in chosen), path.stat().st_size)
            for name, entry in chosen:
                with archive.open(entry) as stream:
                    out[name] = _read(stream, entry.file_size, f"{subject} {path}: array {name}", remedy, objects)
    if not names:
        raise InputError(
            f"{subject} {path}", expected="an npz of plain arrays", received="an archive without any", remedy=remedy
        )
    return out


def array_names(path: str | Path, *, subject: str = "file", remedy: str = "") -> list[str]:
    """The names of an npz file's arrays, without reading them.

    Raises:
        InputError: missing or damaged file, or no npz.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    with _errors_said(f"{subject} {path}", "an npz of plain arrays", remedy), zipfile.ZipFile(path) as archive:
        return [name.removesuffix(_SUFFIX) for name in archive.namelist() if name.endswith(_SUFFIX)]


def read_array(path: str | Path, *, subject: str = "file", remedy: str = "") -> np.ndarray:
    """Read the array of an npy file.

    Raises:
        InputError: missing or damaged file, no npy, an array of another type than numbers and texts, or one that says
            to be larger than its file.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    with _errors_said(f"{subject} {path}", "an npy array", remedy), open(path, "rb") as stream:
        return _read(stream, path.stat().st_size, f"{subject} {path}", remedy, None)


def check_dtype(text: str) -> np.dtype:
    """The type that numpy spells so: numbers, bools and texts.

    Raises:
        ValueError: any other: objects are pointers, a structure may hide some.
    """
    match = re.fullmatch(r"([<>|=]?)([biufcSU])(\d{1,5})|(\?)", text)
    if match is None:
        raise ValueError(f"arrays of type {text[:40]!r}")
    try:
        dtype = np.dtype(text)
    except TypeError:  # a number of three bytes
        raise ValueError(f"arrays of type {text!r}") from None
    characters = dtype.itemsize // (4 if dtype.kind == "U" else 1)
    if not dtype.itemsize or (dtype.kind in "SU" and characters > _LONGEST_TEXT):
        raise ValueError(f"texts of {characters} characters")
    return dtype


def check_shape(shape: tuple[int, ...]) -> int:
    """The number of an array's elements.

    Raises:
        ValueError: negative or absurd lengths.
    """
    if len(shape) > _MOST_DIMENSIONS or not all(0 <= n < 1 << 48 for n in shape):
        raise ValueError(f"{len(shape)} dimensions of up to {max(shape, default=0):.3g}")
    return math.prod(shape)


@contextmanager
def _errors_said(subject: str, expected: str, remedy: str) -> Iterator[None]:
    """Turn what the standard library raises into an InputError."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(subject, expected="a readable file", received=str(error), remedy=remedy) from None
    except DAMAGED as error:
        received = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(subject, expected=expected, received=received, remedy=remedy) from None


def _check_unpacking(unpacked: int, packed: int) -> None:
    if unpacked > max(_FREELY_UNPACKED, _MOST_UNPACKING * packed):
        raise ValueError(f"{packed} bytes that unpack to {unpacked}")


def _read(stream: Any, size: int, subject: str, remedy: str, objects: ObjectReader | None) -> Any:
    """An array in npy format from a stream of so many bytes."""
    with _errors_said(subject, "plain arrays of numbers or texts", remedy):
        descr, fortran_order, shape, start = _header(stream)
        count = check_shape(shape)
        if descr in ("|O", "O"):
            if objects is None:
                raise ValueError("an array of objects, which is a program and not numbers")
            return objects(stream, subject)
        dtype = check_dtype(descr)
        if count * dtype.itemsize != size - start:
            raise ValueError(f"{size - start} bytes for {dtype} of shape {shape}")
        data = np.empty(count * dtype.itemsize, dtype=np.uint8)
        for at in range(0, len(data), _PIECE):
            piece = stream.read(min(_PIECE, len(data) - at))
            data[at : at + _PIECE] = np.frombuffer(piece, dtype=np.uint8)
        if stream.read(1):  # an archive's entry is checked at its end
            raise ValueError("more than the array")
        array = data.view(dtype).reshape(shape, order="F" if fortran_order else "C")
        return array.astype(dtype.newbyteorder("="), copy=False)


def _header(stream: Any) -> tuple[str, bool, tuple[int, ...], int]:
    """Type, order, shape and where the numbers begin; read as text, never evaluated."""
    start = stream.read(8)
    if start[:6] != _MAGIC or len(start) != 8 or start[6] not in (1, 2, 3):
        raise ValueError("no npy header")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(stream.read(width), "little")
    text = stream.read(length).decode("latin1") if length <= _LONGEST_HEADER else ""
    descr = re.findall(r"""['"]descr['"]\s*:\s*['"]([^'"]{1,16})['"]\s*[,}]""", text)
    order = re.findall(r"""['"]fortran_order['"]\s*:\s*(True|False)\s*[,}]""", text)
    shape = re.findall(r"""['"]shape['"]\s*:\s*\(([\d\sL,]{0,600})\)\s*[,}]""", text)
    if not len(descr) == len(order) == len(shape) == 1:
        raise ValueError("a header of numbers of one type", text[:100])
    # Python 2 wrote lengths such as 3L.
    lengths = tuple(int(n.strip(" L")) for n in shape[0].split(",") if n.strip())
    return descr[0], order[0] == "True", lengths, 8 + width + length
