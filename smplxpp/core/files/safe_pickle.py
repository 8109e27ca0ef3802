"""Read pickles and object arrays of other programs without executing anything in them.

A pickle is a program whose opcodes name Python objects and call them. `pickle_machine` runs the opcodes with arrays and
plain containers only. Objects of chumpy and scipy.sparse, which old body model files hold, become inert records of
their state, from which `dense_array` takes the numbers. Any other name is refused before anything is called.
"""

from __future__ import annotations

import math
import pickle
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy.sparse

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import read_array, read_arrays
from smplxpp.core.files.paths import regular_file
from smplxpp.core.files.pickle_machine import PickleMachine
from smplxpp.core.files.pickle_values import InertObject, RefusedName

# Exceptions that a truncated or foreign file raises in the pickle machine.
_BROKEN = (
    pickle.UnpicklingError,
    struct.error,
    EOFError,
    AttributeError,
    IndexError,
    KeyError,
    TypeError,
    ValueError,
    OverflowError,
    MemoryError,
    RecursionError,
    AssertionError,
)


def safe_load(path: str | Path) -> Any:
    """Read a pickle file of any protocol (also Python 2's) without executing anything in it.

    Strings of Python 2 are read as latin-1. Objects of chumpy and scipy.sparse become `InertObject`.

    Raises:
        InputError: no such file, a broken pickle, a name that is neither array nor container, or values that expand to
            much more than the file's size.
    """
    path = regular_file(path)
    try:
        with open(path, "rb") as stream:
            return _load(stream, f"file {path}")
    except OSError as error:
        raise InputError(f"file {path}", expected="a readable file", received=error.strerror or str(error)) from error


def safe_npz(path: str | Path, *, keys: Iterable[str] | None = None) -> dict[str, Any]:
    """Read the arrays of an npz file by name, object arrays in the manner of `safe_load`.

    Args:
        path: of the file.
        keys: names to read, as far as they exist; None: all.

    Raises:
        InputError: what `read_arrays` refuses, or an object array that names something refused.
    """
    return read_arrays(path, keys=keys, objects=_load)


def safe_npy(path: str | Path) -> Any:
    """Read an npy file: its array, or the one object that `numpy.save` packed into it, in the manner of `safe_load`.

    Raises:
        InputError: what `read_array` refuses, or a pickle that names something refused.
    """
    array = read_array(path, objects=_load)
    return array.item() if array.dtype.hasobject and array.size == 1 else array


def dense_array(value: Any, *, subject: str) -> np.ndarray:
    """Return the numbers of an array, a pickled sparse matrix or a pickled chumpy object as a dense array.

    Raises:
        InputError: an object whose numbers cannot be read without running its code.
    """
    try:
        return _dense(value, subject)
    except (TypeError, ValueError, IndexError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        received = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(subject, expected="a consistent array", received=received) from None


def _dense(value: Any, subject: str) -> np.ndarray:
    if isinstance(value, InertObject) and isinstance(value.state, dict):
        state = value.state
        # scipy's compressed matrices: values, their column (or row) indices, and where each row (or column) begins.
        if value.origin.startswith("scipy.sparse") and {"data", "indices", "indptr", "_shape"} <= state.keys():
            return _dense_sparse(value, subject)
        # chumpy's array Ch holds its numbers as `x`.
        if value.origin.startswith("chumpy") and "x" in state:
            return _dense(state["x"], subject)
        # chumpy's Select holds flat indices into another object.
        if value.origin.startswith("chumpy") and {"a", "idxs"} <= state.keys():
            taken = _dense(state["a"], subject).ravel()[np.asarray(state["idxs"])]
            return taken.reshape(state.get("preferred_shape", taken.shape))
    # An object array of one element only wraps its content.
    if isinstance(value, np.ndarray) and value.dtype.hasobject and value.size == 1:
        return _dense(value.item(), subject)
    array = None if isinstance(value, InertObject) else np.asarray(value)
    if array is None or array.dtype.hasobject:
        received = value.origin if array is None else f"an object array of shape {array.shape}"
        raise InputError(
            subject, expected="an array", received=received, remedy="save it as a plain numpy array in an npz file"
        )
    return array


def _dense_sparse(value: InertObject, subject: str) -> np.ndarray:
    kind = value.origin.rpartition(".")[2]
    build = {"csc_matrix": scipy.sparse.csc_array, "csr_matrix": scipy.sparse.csr_array}.get(kind)
    if build is None:
        raise InputError(subject, expected="a csc or csr matrix", received=value.origin)
    state = value.state
    shape = tuple(int(n) for n in state["_shape"])
    # A joint regressor has half a million elements.
    max_dense = 100_000_000
    if len(shape) != 2 or min(shape) < 0 or math.prod(shape) > max_dense:
        raise InputError(subject, expected=f"a matrix of at most {max_dense} elements", received=f"shape {shape}")
    try:
        # The full check catches indices outside the shape, which would otherwise read foreign memory.
        matrix = build((state["data"], state["indices"], state["indptr"]), shape=shape)
        matrix.check_format(full_check=True)
    except (TypeError, ValueError) as error:
        raise InputError(subject, expected="a consistent sparse matrix", received=str(error)) from error
    return matrix.toarray()


def _load(stream: BinaryIO, subject: str) -> Any:
    # Read completely, so that the machine never asks a stream for lengths that a file claims.
    max_bytes, chunk = 1 << 32, 1 << 20
    pieces: list[bytes] = []
    while piece := stream.read(chunk):
        pieces.append(piece)
        if len(pieces) * chunk > max_bytes:
            raise InputError(subject, expected=f"a pickle of at most {max_bytes} bytes", received="more")
    data = b"".join(pieces)
    try:
        return PickleMachine(data).load()
    except RefusedName as error:
        raise InputError(
            subject,
            expected="numpy arrays and plain containers",
            received=f"a pickle that calls {error}: refused, nothing was run",
            remedy="convert it to an npz file of plain arrays with the tool that wrote it",
        ) from None
    except _BROKEN as error:
        received = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(subject, expected="a readable pickle", received=received) from None
