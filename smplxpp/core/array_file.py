"""Named arrays in one npz file that says nothing of the time it was written: the same arrays give the same bytes."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from smplxpp.core.atomic import atomic_path
from smplxpp.core.errors import InputError


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
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), stream.getbuffer(), packing, compresslevel=level)


def read_arrays(path: str | Path, *, subject: str, remedy: str = "") -> dict[str, np.ndarray]:
    """Read all arrays of an npz file.

    Args:
        path: of the file.
        subject: what the file is, for messages.
        remedy: what a user can do about a damaged one.

    Raises:
        InputError: missing or damaged file, or one with pickled objects.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(subject, expected="an existing file", received=str(path))
    try:
        # A file of our own: numpy does not close what it opened when the archive turns out to be damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            return {key: data[key] for key in data.files}
    except (ValueError, OSError, EOFError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        # A lone npy loads as an array, which has no `files`; objects in an npz are refused as ValueError.
        raise InputError(
            f"{subject} {path}",
            expected="an npz of plain arrays",
            received=f"{type(error).__name__}: {error}",
            remedy=remedy,
        ) from None
