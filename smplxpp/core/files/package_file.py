"""Read and write zip packages: checked ones of named pieces, and small ones of texts in memory.

The same content gives the same bytes. Names and sizes are checked before anything is unpacked.
"""

from __future__ import annotations

import io
import re
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import DAMAGED
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.files.paths import regular_file

# The oldest time that a zip entry can carry, so that equal content gives equal bytes.
_TIME = (1980, 1, 1, 0, 0, 0)
_NAME = re.compile(r"[a-z][a-z0-9_]{0,60}\.[a-z]{1,16}")


def write_package(path: str | Path, pieces: Mapping[str, bytes]) -> dict[str, int]:
    """Write named pieces as a compressed zip, atomically; equal pieces give equal bytes.

    Returns:
        Compressed bytes of each piece.

    Raises:
        ValueError: a name that is not plain lower case with a suffix.
    """
    for name in pieces:
        if not _NAME.fullmatch(name):
            raise ValueError(f"piece {name!r}")
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as package:
        for name, data in pieces.items():
            # A fixed time and one compression level make equal content equal byte for byte.
            package.writestr(zipfile.ZipInfo(name, _TIME), data, zipfile.ZIP_DEFLATED, compresslevel=9)
        return {entry.filename: entry.compress_size for entry in package.infolist()}


def read_package(path: str | Path, *, subject: str, expected: str, remedy: str = "") -> dict[str, bytes]:
    """Return the pieces of a package by name.

    Args:
        subject: what the file is called in messages.
        expected: what it should be, in messages.
        remedy: advice in messages.

    Raises:
        InputError: missing or damaged file, no zip; names that are paths or duplicates; pieces that are encrypted, or
            would unpack to more than half a GiB or a hundred times the file.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    about = f"{subject} {path}"
    try:
        packed = path.stat().st_size
        with zipfile.ZipFile(path) as package:
            entries = package.infolist()
            _check_frame(path, entries, about, expected, remedy)
            _check(entries, packed, about, remedy)
            # Sizes in the directory were checked; each entry is read to no more than its own.
            return {entry.filename: _unpacked(package, entry) for entry in entries}
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            about, expected="a readable file", received=error.strerror or str(error), remedy=remedy
        ) from None
    except DAMAGED as error:
        received = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(about, expected=expected, received=received, remedy=remedy) from None


def _check_frame(path: Path, entries: list[zipfile.ZipInfo], subject: str, expected: str, remedy: str) -> None:
    """Refuse bytes before the first entry, behind the directory, and between the two: readers disagree on them."""
    # The last 22 bytes are the end record: signature, two numbers of disks, entries here and in all, size and offset of
    # the directory, length of a comment.
    with open(path, "rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(size - 22)
        signature, *_, count, directory, offset, comment = struct.unpack("<4s4H2IH", stream.read(22))
    first = min((entry.header_offset for entry in entries), default=0)
    whole = signature == b"PK\5\6" and comment == 0 and offset + directory == size - 22 and count == len(entries)
    if not whole or first or any(entry.extra for entry in entries):
        raise InputError(subject, expected=expected, received="a zip with other bytes about its pieces", remedy=remedy)


def _check(entries: list[zipfile.ZipInfo], packed: int, subject: str, remedy: str) -> None:
    """Refuse odd names, too many pieces, encryption, and decompression bombs, before anything is unpacked."""
    max_pieces = 64
    names = [entry.filename for entry in entries]
    odd = [name for name in names if not _NAME.fullmatch(name)]
    if odd:
        raise InputError(
            subject, expected="pieces with plain names", received=f"a piece {odd[0][:80]!r}", remedy=remedy
        )
    if len(set(names)) != len(names) or len(names) > max_pieces:
        raise InputError(
            subject,
            expected=f"at most {max_pieces} pieces, each once",
            received=f"{len(names)} of {len(set(names))} names",
            remedy=remedy,
        )
    for entry in entries:
        # Bit 0 of the flags marks an encrypted entry.
        plain = entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size
        if entry.flag_bits & 1 or not (plain or entry.compress_type == zipfile.ZIP_DEFLATED):
            raise InputError(
                f"{subject}: {entry.filename}", expected="a piece stored or deflated", received="another", remedy=remedy
            )
    unpacked = sum(entry.file_size for entry in entries)
    # Deflate reaches a ratio of a thousand; tensors of real packages unpack to a few times their size. Four MiB are
    # always allowed, half a GiB never exceeded.
    most = min(512 << 20, max(4 << 20, 100 * packed))
    if unpacked > most:
        raise InputError(
            subject,
            expected=f"pieces of at most {most} bytes",
            received=f"{packed} that unpack to {unpacked}",
            remedy=remedy,
        )


def _unpacked(package: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Return the bytes of an entry, reading no more than the size that it states."""
    parts, left = [], entry.file_size
    with package.open(entry) as stream:
        while left > 0 and (piece := stream.read(min(1 << 20, left))):
            parts.append(piece)
            left -= len(piece)
        # Less or more than the stated size means a forged directory; reading to the end also verifies the CRC.
        if left or stream.read(1):
            raise zipfile.BadZipFile(f"{entry.filename}: not the {entry.file_size} bytes that it states")
    return b"".join(parts)


def zip_bytes(files: Mapping[str, str]) -> bytes:
    """Return a compressed zip of texts by name, in their order."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as package:
        for name, text in files.items():
            entry = zipfile.ZipInfo(name, _TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            package.writestr(entry, text)
    return stream.getvalue()


def zip_member(data: bytes, name: str) -> str:
    """Return a text of a zip that `zip_bytes` made; its size is not bounded, so that it is unsafe for foreign files."""
    with zipfile.ZipFile(io.BytesIO(data)) as package:
        return package.read(name).decode()
