"""Reading other people's pickles and object arrays without executing anything they contain.

A pickle is a program: its opcodes name Python objects and call them. Here only the names that build numpy arrays and
plain containers exist. Objects of chumpy and scipy.sparse, which old body model files hold, become inert records of
their state; `dense_array` reads the numbers out of them. Any other name is refused before anything is called.
"""

from __future__ import annotations

import collections
import io
import pickle
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy.sparse

from smplxpp.core.errors import InputError

# Errors that a truncated, foreign or hostile file can raise inside the unpickler.
_BROKEN = (
    pickle.UnpicklingError,
    EOFError,
    ImportError,
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


class InertObject:
    """Stands for an object of a package that is not loaded: its class name, arguments and state, no behaviour."""

    __slots__ = ("arguments", "state")
    origin: str
    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any) -> InertObject:
        self = super().__new__(cls)
        self.arguments, self.state = arguments, {}
        return self

    def __setstate__(self, state: Any) -> None:
        self.state = state


def safe_load(path: str | Path) -> Any:
    """The content of a pickle file (any protocol, Python 2's included), executing nothing from it.

    Strings of Python 2 are read as latin-1. Objects of chumpy and scipy.sparse become `InertObject`.

    Raises:
        InputError: no such file, a broken pickle, or one that names anything but arrays and containers.
    """
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            return _load(stream, subject=f"file {path}")
    except OSError as error:
        raise _unreadable(path, error) from error


def safe_npz(path: str | Path, *, keys: Iterable[str] | None = None) -> dict[str, Any]:
    """The arrays of an npz file by name, object arrays through the same restricted unpickler.

    Args:
        path: the file.
        keys: read these only (those that exist); None reads all.

    Raises:
        InputError: no such file, not an npz file, or an object array that names something refused.
    """
    path = Path(path)
    wanted = None if keys is None else set(keys)
    out = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.namelist():
                name = entry.removesuffix(".npy")
                if wanted is None or name in wanted:
                    out[name] = _read_npy(io.BytesIO(archive.read(entry)), subject=f"file {path}: array {name}")
    except OSError as error:
        raise _unreadable(path, error) from error
    except zipfile.BadZipFile as error:
        raise InputError(f"file {path}", expected="an npz archive", received=str(error)) from error
    return out


def dense_array(value: Any, *, subject: str) -> np.ndarray:
    """The numbers of an array, a pickled sparse matrix, or a pickled chumpy object, as a dense array.

    Raises:
        InputError: an object whose numbers cannot be read without running its code.
    """
    if isinstance(value, InertObject) and isinstance(value.state, dict):
        state = value.state
        if value.origin.startswith("scipy.sparse") and {"data", "indices", "indptr", "_shape"} <= state.keys():
            return _dense_sparse(value, subject)
        if value.origin.startswith("chumpy") and "x" in state:
            return dense_array(state["x"], subject=subject)
        # chumpy's Select: flat indices into another object.
        if value.origin.startswith("chumpy") and {"a", "idxs"} <= state.keys():
            taken = dense_array(state["a"], subject=subject).ravel()[np.asarray(state["idxs"])]
            return taken.reshape(state.get("preferred_shape", taken.shape))
    if isinstance(value, np.ndarray) and value.dtype.hasobject and value.size == 1:
        return dense_array(value.item(), subject=subject)
    if isinstance(value, InertObject) or (isinstance(value, np.ndarray) and value.dtype.hasobject):
        received = value.origin if isinstance(value, InertObject) else f"an object array of shape {value.shape}"
        raise InputError(
            subject, expected="an array", received=received, remedy="save it as a plain numpy array in an npz file"
        )
    return np.asarray(value)


def _dense_sparse(value: InertObject, subject: str) -> np.ndarray:
    kind = value.origin.rpartition(".")[2]
    build = {"csc_matrix": scipy.sparse.csc_array, "csr_matrix": scipy.sparse.csr_array}.get(kind)
    if build is None:
        raise InputError(subject, expected="a csc or csr matrix", received=value.origin)
    state = value.state
    try:
        matrix = build((state["data"], state["indices"], state["indptr"]), shape=state["_shape"])
        matrix.check_format(full_check=True)
    except (TypeError, ValueError) as error:
        raise InputError(subject, expected="a consistent sparse matrix", received=str(error)) from error
    return matrix.toarray()


def _load(stream: BinaryIO, *, subject: str) -> Any:
    try:
        return _RestrictedUnpickler(stream, subject).load()
    except InputError:
        raise
    except _BROKEN as error:
        raise InputError(subject, expected="a readable pickle", received=f"{type(error).__name__}: {error}") from error


def _read_npy(stream: BinaryIO, *, subject: str) -> Any:
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in read_header:
            raise ValueError(f"npy format version {version}")
        if read_header[version](stream)[2].hasobject:
            return _load(stream, subject=subject)
        stream.seek(0)
        return np.lib.format.read_array(stream, allow_pickle=False)
    except InputError:
        raise
    except (ValueError, EOFError) as error:
        raise InputError(subject, expected="a readable npy array", received=str(error)) from error


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError(f"file {path}", expected="a readable file", received=error.strerror or str(error))


class _RestrictedUnpickler(pickle.Unpickler):
    def __init__(self, stream: BinaryIO, subject: str) -> None:
        super().__init__(stream, encoding="latin1")
        self._subject = subject

    def find_class(self, module: str, name: str) -> Any:
        """The only place where a pickle meets Python: names outside the table end the reading."""
        if (module, name) in _ALLOWED:
            return _ALLOWED[module, name]
        package = module.split(".")
        if package[0] == "chumpy" or package[:2] == ["scipy", "sparse"]:
            return type("InertObject", (InertObject,), {"__slots__": (), "origin": f"{module}.{name}"})
        raise InputError(
            self._subject,
            expected="numpy arrays and plain containers",
            received=f"a pickle that calls {module}.{name}: refused, nothing was run",
            remedy="convert it to an npz file of plain arrays with the tool that wrote it",
        )


def _reconstruct_object(cls: type, base: type, state: Any) -> Any:
    """copyreg's helper of old protocols, for the inert records alone."""
    if not (isinstance(cls, type) and issubclass(cls, InertObject)) or base is not object:
        raise pickle.UnpicklingError("an object of an unexpected class")
    return cls()


def _encode_latin1(text: str, encoding: str = "latin1") -> bytes:
    """How protocol 2 writes bytes."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"bytes in encoding {encoding}")
    return text.encode("latin1")


def _numpy_names() -> dict[tuple[str, str], Any]:
    # The helpers that rebuild arrays are private and have moved between numpy versions: ask numpy which it writes.
    helpers = {
        ("multiarray", "_reconstruct"): np.zeros(1).__reduce__()[0],
        ("multiarray", "scalar"): np.float64(0).__reduce__()[0],
        ("numeric", "_frombuffer"): np.zeros(1).__reduce_ex__(5)[0],
    }
    out: dict[tuple[str, str], Any] = {("numpy", "ndarray"): np.ndarray, ("numpy", "dtype"): np.dtype}
    for core in ("core", "_core"):
        out |= {(f"numpy.{core}.{module}", name): helper for (module, name), helper in helpers.items()}
    return out


_ALLOWED: dict[tuple[str, str], Any] = _numpy_names() | {
    ("copy_reg", "_reconstructor"): _reconstruct_object,
    ("copyreg", "_reconstructor"): _reconstruct_object,
    ("_codecs", "encode"): _encode_latin1,
    ("collections", "OrderedDict"): collections.OrderedDict,
    **{
        (module, kind.__name__): kind
        for module in ("builtins", "__builtin__")
        for kind in (object, set, frozenset, bytes, bytearray, complex, slice, list, tuple, dict, int, float, bool, str)
    },
}
