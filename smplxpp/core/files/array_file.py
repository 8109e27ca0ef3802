"""Read and write npy and npz files; sizes and types are checked before memory is allocated.

Files hold no time stamp, so that equal arrays give equal bytes. Arrays of objects are read by
`smplxpp.core.files.safe_pickle` alone.
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
"""Reads the pickle of an object array from a stream; the second argument names the array in messages."""

_SUFFIX = ".npy"
# The exceptions that the standard library raises on damaged archives.
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
        packing: compression, a constant of `zipfile`; deflate is used at its fastest level.

    Raises:
        ValueError: an array of objects.
    """
    # Level 1 of deflate trades some size for speed.
    level = 1 if packing == zipfile.ZIP_DEFLATED else None
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
            # A ZipInfo made from a name alone has the constant date 1980-01-01.
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
        subject: what the file is called in messages.
        remedy: advice in messages about a damaged file.
        keys: names to read, as far as they exist; None: all.
        objects: reader of object arrays; None refuses them.

    Raises:
        InputError: missing or damaged file, no npz, an array of another type, or an array that claims to be larger than
            its file can hold.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    wanted, max_entries = None if keys is None else set(keys), 10_000
    out: dict[str, np.ndarray] = {}
    with _as_input_error(f"{subject} {path}", "an npz of plain arrays", remedy):
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in archive.infolist() if entry.filename.endswith(_SUFFIX)]
            names = [entry.filename.removesuffix(_SUFFIX) for entry in entries]
            if len(set(names)) != len(names) or len(names) > max_entries:
                raise ValueError(f"{len(names)} arrays of {len(set(names))} names")
            chosen = [(n, e) for n, e in zip(names, entries, strict=True) if wanted is None or n in wanted]
            # Refuse decompression bombs by the sizes in the directory, before anything is unpacked.
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
    """Return the names of the arrays in an npz file, without reading the arrays.

    Raises:
        InputError: missing or damaged file, or no npz.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    with _as_input_error(f"{subject} {path}", "an npz of plain arrays", remedy), zipfile.ZipFile(path) as archive:
        return [name.removesuffix(_SUFFIX) for name in archive.namelist() if name.endswith(_SUFFIX)]


def read_array(
    path: str | Path, *, subject: str = "file", remedy: str = "", objects: ObjectReader | None = None
) -> np.ndarray:
    """Read the array of an npy file.

    Args:
        path: of the file.
        subject: what the file is called in messages.
        remedy: advice in messages about a damaged file.
        objects: reader of object arrays; None refuses them.

    Raises:
        InputError: missing or damaged file, no npy, an array of another type than numbers and texts, or an array
            that claims to be larger than its file.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    with _as_input_error(f"{subject} {path}", "an npy array", remedy), open(path, "rb") as stream:
        return _read(stream, path.stat().st_size, f"{subject} {path}", remedy, objects)


def check_dtype(text: str) -> np.dtype:
    """Return the numpy type of a type string of numbers, bools or texts.

    Raises:
        ValueError: any other type, because nothing here has complex values, objects are stored as pointers, and
            structures may contain objects.
    """
    match = re.fullmatch(r"([<>|=]?)([biufSU])(\d{1,5})|(\?)", text)
    if match is None:
        raise ValueError(f"arrays of type {text[:40]!r}")
    try:
        dtype = np.dtype(text)
    except TypeError:  # a number of three bytes
        raise ValueError(f"arrays of type {text!r}") from None
    # Characters of a text in an array; names of joints have twenty.
    longest_text = 4096
    characters = dtype.itemsize // (4 if dtype.kind == "U" else 1)
    if not dtype.itemsize or (dtype.kind in "SU" and characters > longest_text):
        raise ValueError(f"texts of {characters} characters")
    return dtype


def check_shape(shape: tuple[int, ...]) -> int:
    """Return the number of elements of an array.

    Raises:
        ValueError: more than 32 dimensions (the limit of numpy 1), or negative or absurd lengths.
    """
    if len(shape) > 32 or not all(0 <= n < 1 << 48 for n in shape):
        raise ValueError(f"{len(shape)} dimensions of up to {max(shape, default=0):.3g}")
    return math.prod(shape)


@contextmanager
def _as_input_error(subject: str, expected: str, remedy: str) -> Iterator[None]:
    """Convert exceptions of the standard library into an InputError."""
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
    """Refuse archives that expand to much more than their size."""
    # Half a GiB is always allowed; above that, a compression ratio over 200 marks a decompression bomb.
    if unpacked > max(1 << 29, 200 * packed):
        raise ValueError(f"{packed} bytes that unpack to {unpacked}")


def _read(stream: Any, size: int, subject: str, remedy: str, objects: ObjectReader | None) -> Any:
    """Read an array in npy format from a stream of `size` bytes."""
    with _as_input_error(subject, "plain arrays of numbers or texts", remedy):
        descr, fortran_order, shape, start = _header(stream)
        count = check_shape(shape)
        if descr in ("|O", "O"):
            if objects is None:
                raise ValueError("an array of objects, which is a program and not numbers")
            return objects(stream, subject)
        # The type string decides how many bytes are read, so that only numbers, bools and texts pass.
        dtype = check_dtype(descr)
        # The header must agree with the entry's size exactly; it would otherwise decide how much memory is taken.
        if count * dtype.itemsize != size - start:
            raise ValueError(f"{size - start} bytes for {dtype} of shape {shape}")
        # In chunks of a MiB, because one read of a compressed entry would hold its bytes twice.
        chunk, data = 1 << 20, np.empty(count * dtype.itemsize, dtype=np.uint8)
        for at in range(0, len(data), chunk):
            wanted = min(chunk, len(data) - at)
            piece = stream.read(wanted)
            # numpy would repeat a single byte over the whole chunk.
            if len(piece) != wanted:
                raise ValueError(f"{at + len(piece)} bytes where the header announces {len(data)}")
            data[at : at + wanted] = np.frombuffer(piece, dtype=np.uint8)
        if stream.read(1):  # reading to the end also verifies the checksum of an archive's entry
            raise ValueError("more than the array")
        if dtype.kind == "U":
            # Python's texts have no code points beyond Unicode's last, nor halves of surrogate pairs.
            points = data.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder))
            if ((points > 0x10FFFF) | ((points >= 0xD800) & (points < 0xE000))).any():
                raise ValueError("texts with code points that are no characters")
        array = data.view(dtype).reshape(shape, order="F" if fortran_order else "C")
        # Native byte order, because compiled kernels take no other.
        return array.astype(dtype.newbyteorder("="), copy=False)


def _header(stream: Any) -> tuple[str, bool, tuple[int, ...], int]:
    """Return type string, Fortran order, shape and the place of the first number; the text is never evaluated."""
    # Format of npy: magic string, version, length of the header (2 bytes in version 1, 4 later), header, numbers.
    start = stream.read(8)
    if start[:6] != b"\x93NUMPY" or len(start) != 8 or start[6] not in (1, 2, 3):
        raise ValueError("no npy header")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(stream.read(width), "little")
    text = stream.read(length).decode("latin1") if length <= 1 << 16 else ""
    # `np.load` evaluates the header as a Python literal; three regular expressions read the same keys without
    # evaluation.
    descr = re.findall(r"""['"]descr['"]\s*:\s*['"]([^'"]{1,16})['"]\s*[,}]""", text)
    order = re.findall(r"""['"]fortran_order['"]\s*:\s*(True|False)\s*[,}]""", text)
    shape = re.findall(r"""['"]shape['"]\s*:\s*\(([\d\sL,]{0,600})\)\s*[,}]""", text)
    if not len(descr) == len(order) == len(shape) == 1:
        raise ValueError("a header of numbers of one type", text[:100])
    # Python 2 wrote lengths such as 3L.
    lengths = tuple(int(n.strip(" L")) for n in shape[0].split(",") if n.strip())
    return descr[0], order[0] == "True", lengths, 8 + width + length
