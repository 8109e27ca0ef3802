"""Define the values that a pickle may hold (name tokens, arrays, records) and their builders.

Builders check types, shapes and sizes before they allocate. numpy's own `__setstate__` is not among them: given an
object array and raw bytes, it interprets the bytes as pointers.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from smplxpp.core.files.array_file import check_dtype, check_shape

_OBJECT_KINDS = ("O", "O4", "O8")


class RefusedName(Exception):
    """A name in a pickle that is neither an array type nor a plain container."""


@dataclass
class InertObject:
    """Record of an object of a package that is not loaded: its class name, arguments and state, without behaviour."""

    origin: str
    arguments: tuple[Any, ...] = ()
    state: Any = None


@dataclass(frozen=True)
class Name:
    """Module and name of an object in a pickle, never imported."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass
class Dtype:
    """An element type: numpy's type string of kind and size, and the byte order that is set later."""

    kind: str
    order: str = ""

    def resolved(self) -> np.dtype:
        """Return the numpy type; raises ValueError for other types than numbers and texts."""
        return check_dtype(self.order + self.kind)


@dataclass
class Unbuilt:
    """An array that is created before its content is set; `value` holds it afterwards."""

    value: np.ndarray | None = None


@dataclass
class Budget:
    """Number of bytes that the arrays of a file may take, and have taken."""

    most: int
    taken: int = 0

    def spend(self, amount: int) -> None:
        """Count bytes before they are allocated.

        Raises:
            pickle.UnpicklingError: more than the file can reasonably hold.
        """
        self.taken += amount
        if self.taken > self.most:
            broken("arrays of many times the file's size")


class Memo(dict[int, Any]):
    """Values that a pickle refers to again, with arrays resolved that were stored before their content."""

    def __getitem__(self, index: int) -> Any:
        value = super().__getitem__(index)
        return value.value if isinstance(value, Unbuilt) and value.value is not None else value


# The names a pickle may use; helpers of numpy have moved between its versions.
_NDARRAY, _DTYPE = Name("numpy", "ndarray"), Name("numpy", "dtype")
_OBJECT = {Name("builtins", "object"), Name("__builtin__", "object")}


def broken(what: str) -> NoReturn:
    """Raise the exception of the standard library's unpickler."""
    raise pickle.UnpicklingError(what)


def exactly(value: Any, kind: type) -> Any:
    """Return the value if it has exactly this type, without subclasses."""
    if type(value) is not kind:
        broken(f"a {kind.__name__} where there is {type(value).__name__}")
    return value


def as_key(value: Any) -> Any:
    """Return a key of a dictionary or a set whose hash the file cannot choose."""
    if isinstance(value, np.integer):
        value = int(value)
    # Integers up to 2^60 hash to themselves; with larger ones a file could make all hashes collide.
    if isinstance(value, str | bytes | None) or (isinstance(value, int) and abs(value) < 1 << 60):
        return value
    broken(f"a key of type {type(value).__name__}")


def is_recorded(token: Name) -> bool:
    """Tell whether objects of this class become records."""
    package = token.module.split(".")
    return package[0] == "chumpy" or package[:2] == ["scipy", "sparse"]


def _bytes(value: Any) -> bytes:
    """Return raw content as bytes; Python 2 wrote it as a text."""
    if isinstance(value, str):
        return value.encode("latin1")
    if not isinstance(value, bytes | bytearray):
        broken(f"content of type {type(value).__name__}")
    return bytes(value)


def _array(budget: Budget, shape: Any, dtype: Any, order: str, content: Any) -> np.ndarray:
    """Build an array after checking shape, type and size; objects come as a list, numbers as bytes."""
    if isinstance(shape, int):
        shape = (shape,)
    if not (isinstance(shape, tuple) and all(type(n) is int for n in shape) and isinstance(dtype, Dtype)):
        broken("an array without shape and type")
    # The product of the shape is bounded before any memory is taken.
    count = check_shape(shape)
    if dtype.kind in _OBJECT_KINDS:
        # As bytes, objects would be pointers.
        values = exactly(content, list)
        if len(values) != count:
            broken(f"{len(values)} objects for shape {shape}")
        budget.spend(8 * count)
        out = np.empty(count, dtype=object)
        for index, value in enumerate(values):
            out[index] = value
        return out.reshape(shape, order=order)  # type: ignore[call-overload]
    # Numbers come as bytes, whose length must fit shape and type exactly.
    resolved, raw = dtype.resolved(), _bytes(content)
    if count * resolved.itemsize != len(raw):
        broken(f"{len(raw)} bytes for {resolved} of shape {shape}")
    budget.spend(len(raw))
    # The copy in native order does not share memory with the pickle's bytes.
    flat = np.frombuffer(raw, dtype=resolved, count=count) if count else np.empty(0, resolved)
    return flat.reshape(shape, order=order).astype(resolved.newbyteorder("="), order="K")  # type: ignore[call-overload]


def array_of_state(budget: Budget, state: Any) -> np.ndarray:
    """Build an array from (version, shape, dtype, Fortran order, content); the oldest files have no version."""
    if not isinstance(state, tuple) or len(state) not in (4, 5):
        broken("an array without content")
    shape, dtype, fortran_order, content = state[-4:]
    return _array(budget, shape, dtype, "F" if fortran_order else "C", content)


def _reconstruct(budget: Budget, cls: Any, shape: Any, kind: Any) -> Unbuilt:
    if not (isinstance(cls, Name) and cls == _NDARRAY):
        broken("an array of another class")
    return Unbuilt()


def _frombuffer(budget: Budget, content: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> np.ndarray:
    if exactly(order, str) not in ("C", "F") or axes is not None:
        broken("an array in another order")
    return _array(budget, shape, dtype, order, content)


def _scalar(budget: Budget, dtype: Any, content: Any = b"") -> Any:
    if not isinstance(dtype, Dtype) or dtype.kind in _OBJECT_KINDS:
        broken("a number of an unknown type")
    return _array(budget, (1,), dtype, "C", content)[0]


def _dtype(budget: Budget, kind: Any, align: Any = False, copy: Any = True) -> Dtype:
    if exactly(kind, str) not in _OBJECT_KINDS:
        check_dtype(kind)
    return Dtype(kind)


def _old_object(budget: Budget, cls: Any, base: Any, state: Any) -> InertObject:
    """Build a record for copyreg's helper of old protocols."""
    if not (isinstance(cls, Name) and is_recorded(cls)) or base not in _OBJECT:
        broken("an object of an unexpected class")
    return InertObject(str(cls))


def _encoded(budget: Budget, text: Any, encoding: Any = "latin1") -> bytes:
    """Decode bytes that protocol 2 wrote as a text."""
    if exactly(encoding, str) not in ("latin1", "latin-1"):
        broken("bytes in another encoding")
    return exactly(text, str).encode("latin1")


def _listed(budget: Budget, items: Any = ()) -> list[Any]:
    if not isinstance(items, list | tuple):
        broken("a container of no list")
    budget.spend(8 * len(items))
    return list(items)


def _mapping(budget: Budget, items: Any = ()) -> dict[Any, Any]:
    """Build a dictionary from pairs, without the factory of a defaultdict."""
    pairs = [] if isinstance(items, Name) else _listed(budget, items)
    return {as_key(key): value for key, value in (_listed(budget, pair) for pair in pairs)}


def _raw_bytes(budget: Budget, value: Any = b"", encoding: Any = None) -> bytes:
    return _encoded(budget, value, encoding) if encoding is not None else _bytes(value)


def _in_builtins(name: str, builder: Callable[..., Any]) -> Iterator[tuple[Name, Callable[..., Any]]]:
    return ((Name(module, name), builder) for module in ("builtins", "__builtin__"))


BUILDERS: dict[Name, Callable[..., Any]] = {
    _DTYPE: _dtype,
    **{
        Name(f"numpy.{core}.{module}", name): builder
        for core in ("core", "_core")
        for module, name, builder in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _frombuffer),
        )
    },
    Name("copy_reg", "_reconstructor"): _old_object,
    Name("copyreg", "_reconstructor"): _old_object,
    Name("_codecs", "encode"): _encoded,
    Name("collections", "OrderedDict"): _mapping,
    Name("collections", "defaultdict"): _mapping,
    **dict(_in_builtins("dict", _mapping)),
    **dict(_in_builtins("list", _listed)),
    **dict(_in_builtins("tuple", lambda budget, items=(): tuple(_listed(budget, items)))),
    **dict(_in_builtins("set", lambda budget, items=(): set(map(as_key, _listed(budget, items))))),
    **dict(_in_builtins("frozenset", lambda budget, items=(): frozenset(map(as_key, _listed(budget, items))))),
    **dict(_in_builtins("bytes", _raw_bytes)),
    **dict(_in_builtins("bytearray", _raw_bytes)),
    **dict(_in_builtins("complex", lambda budget, real, imag: complex(float(real), float(imag)))),
    **dict(_in_builtins("slice", lambda budget, *bounds: slice(*bounds))),
}
KNOWN_NAMES = BUILDERS.keys() | _OBJECT | {_NDARRAY}
