"""Read and write zip packages: checked ones of named pieces, and small ones of texts in memory.

The same content gives the same bytes. Names and sizes are checked before anything is unpacked.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import DAMAGED
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.files.paths import regular_file

# Zips carry a time; the oldest that they can.
_TIME = (1980, 1, 1, 0, 0, 0)
_MOST_PIECES, _MOST_BYTES = 64, 512 << 20
# Deflate makes a thousand of one; what our tensors unpack to is a few times their size.
_FREELY_UNPACKED, _MOST_UNPACKING = 4 << 20, 100
_PIECE = 1 << 20
_NAME = re.compile(r"[a-z][a-z0-9_]{0,60}\.[a-z]{1,16}")
_ENCRYPTED = 1


def write_package(path: str | Path, pieces: Mapping[str, bytes]) -> dict[str, int]:
    """Write pieces by name, compressed, whole or not at all; the same pieces give the same bytes.

    Returns:
        Bytes that each piece takes in the file.

    Raises:
        ValueError: a name that is no plain one in lower case with a suffix.
    """
    for name in pieces:
        if not _NAME.fullmatch(name):
            raise ValueError(f"piece {name!r}")
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as package:
        for name, data in pieces.items():
            package.writestr(zipfile.ZipInfo(name, _TIME), data, zipfile.ZIP_DEFLATED, compresslevel=9)
        return {entry.filename: entry.compress_size for entry in package.infolist()}


def read_package(path: str | Path, *, subject: str, expected: str, remedy: str = "") -> dict[str, bytes]:
    """Return the pieces of a package by name.

    Args:
        subject: what the file is, for messages. expected: what it should be. remedy: what a user can do.

    Raises:
        InputError: missing or damaged file, no zip; names that are paths, or twice there; pieces that are encrypted, or
            would unpack to more than half a GiB or to a hundred times the file.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    about = f"{subject} {path}"
    try:
        packed = path.stat().st_size
        with zipfile.ZipFile(path) as package:
            entries = package.infolist()
            _check(entries, packed, about, remedy)
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


def _check(entries: list[zipfile.ZipInfo], packed: int, subject: str, remedy: str) -> None:
    names = [entry.filename for entry in entries]
    odd = [name for name in names if not _NAME.fullmatch(name)]
    if odd:
        raise InputError(
            subject, expected="pieces with plain names", received=f"a piece {odd[0][:80]!r}", remedy=remedy
        )
    if len(set(names)) != len(names) or len(names) > _MOST_PIECES:
        raise InputError(
            subject,
            expected=f"at most {_MOST_PIECES} pieces, each once",
            received=f"{len(names)} of {len(set(names))} names",
            remedy=remedy,
        )
    for entry in entries:
        if entry.flag_bits & _ENCRYPTED or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(
                f"{subject}: {entry.filename}", expected="a piece stored or deflated", received="another", remedy=remedy
            )
    unpacked = sum(entry.file_size for entry in entries)
    most = min(_MOST_BYTES, max(_FREELY_UNPACKED, _MOST_UNPACKING * packed))
    if unpacked > most:
        raise InputError(
            subject,
            expected=f"pieces of at most {most} bytes",
            received=f"{packed} that unpack to {unpacked}",
            remedy=remedy,
        )


def _unpacked(package: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """The bytes of an entry; never more than it says to have, whatever it unpacks to."""
    parts, left = [], entry.file_size
    with package.open(entry) as stream:
        while left > 0 and (piece := stream.read(min(_PIECE, left))):
            parts.append(piece)
            left -= len(piece)
        if left or stream.read(1):
            raise zipfile.BadZipFile(f"{entry.filename}: not the {entry.file_size} bytes that it says")
    return b"".join(parts)


def zip_bytes(files: Mapping[str, str]) -> bytes:
    """A compressed zip of texts by their names, in their order."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as package:
        for name, text in files.items():
            entry = zipfile.ZipInfo(name, _TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            package.writestr(entry, text)
    return stream.getvalue()


def zip_member(data: bytes, name: str) -> str:
    """A text of a zip that `zip_bytes` made; nothing bounds what it unfolds to, so it is not for files of others."""
    with zipfile.ZipFile(io.BytesIO(data)) as package:
        return package.read(name).decode()
