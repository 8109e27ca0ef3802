"""Shapes and dtypes in the signatures of smplxpp and avatar, checked on every call that the tests make.

A call is checked after it returned: bad input is answered with an `InputError` by the functions themselves, and many
tests look at exactly that. What is caught here is a call that *succeeds* with other shapes or dtypes than its signature
says, or that returns others.

`install()` has to run before the packages are imported. One letter stands for one number within a call.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.abc
import importlib.machinery
import inspect
import re
import sys
import types
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping
import numpy as np

PACKAGES = ("smplxpp", "avatar")
_SHAPED = re.compile(r"\b(Float|Float16|Float32|Float64|Int|Int32|Int64|Integer|UInt8|Bool|Num|Shaped|Real)\d*\[")


class ContractError(AssertionError):
    """A call succeeded although an array has another shape or dtype than its signature says."""


def install() -> None:
    """Check all functions, methods and dataclasses of modules of `PACKAGES` that are imported from now on."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with every call held against its annotations after it returned."""
    shaped = {name: text for name, text in _annotations(function).items() if _SHAPED.search(text)}
    if not shaped:
        return function
    if inspect.isgeneratorfunction(function):
        shaped.pop("return", None)
    code = inspect.unwrap(function).__code__  # `inspect.signature` at every call costs ten times as much
    places = {name: place for place, name in enumerate(code.co_varnames[: code.co_argcount])}
    if open_ended := shaped.keys() & set(code.co_varnames[code.co_argcount + code.co_kwonlyargcount :]):
        raise TypeError(f"{function.__qualname__}: shapes of *{', '.join(open_ended)} cannot be checked")
    hints: dict[str, Any] = {}
    held: set[Any] = set()
    slots = [(places.get(name, sys.maxsize), name) for name in shaped if name != "return"]
    returns = "return" in shaped

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        given = len(args)
        values = [args[place] if place < given else kwargs.get(name, _ABSENT) for place, name in slots]
        if returns:
            values.append(result)
        kinds = tuple(map(_kind, values))
        if kinds not in held:
            if not hints:
                hints.update({name: _resolved(text, function) for name, text in shaped.items()})
            names = [name for _, name in slots] + ["return"] * returns
            _hold(function.__qualname__, {name: (hints[name], v) for name, v in zip(names, values, strict=True)})
            held.add(kinds)
        return result

    return call


_ABSENT = object()
"""Stands for an argument that a call leaves to its default."""


def _checked_dataclass(cls: type) -> None:
    """Fields held against their annotations once an instance is made."""
    shaped = {f.name: str(f.type) for f in dataclasses.fields(cls) if _SHAPED.search(str(f.type))}
    if not shaped or "__init__" not in vars(cls):
        return
    made, hints, held = cls.__init__, {}, set()

    @functools.wraps(made)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        made(self, *args, **kwargs)
        values = [getattr(self, name) for name in shaped]
        kinds = tuple(map(_kind, values))
        if kinds not in held:
            if not hints:
                hints.update({name: _resolved(text, _declaring(cls, name)) for name, text in shaped.items()})
            _hold(cls.__qualname__, {name: (hints[name], v) for name, v in zip(shaped, values, strict=True)})
            held.add(kinds)

    cls.__init__ = init


def _declaring(cls: type, name: str) -> type:
    """The class that declares a field, whose module has the names in its annotation."""
    return next(one for one in cls.__mro__ if name in vars(one).get("__annotations__", {}))


def _annotations(function: Callable[..., Any]) -> dict[str, str]:
    return {name: str(text) for name, text in getattr(function, "__annotations__", {}).items()}


def _resolved(text: str, owner: Any) -> Any:
    """An annotation as an object; names that the module imports for type checkers alone are looked up too."""
    names = dict(vars(sys.modules[owner.__module__]))
    while True:
        try:
            return eval(text, names)
        except NameError as error:
            names[error.name] = Any  # a class that only type checkers see: not a shape


def _hold(where: str, pairs: dict[str, tuple[Any, Any]]) -> None:
    """Raise where a value does not fit its hint."""
    with jaxtyping.jaxtyped("context"):
        for name, (hint, value) in pairs.items():
            if value is not _ABSENT and not _fits(value, hint):
                raise ContractError(f"{where}: {name} should be {hint}, is {_described(value)}")


_PLAIN = frozenset({int, float, bool, str, type(None)})


def _kind(value: Any) -> Any:
    """All of a value that decides whether it fits: its type, and the dtype and shape of arrays.

    Values of the same kinds fit as those before them did, so that most calls are answered by one look into a set.
    """
    kind = type(value)
    if kind is np.ndarray:
        return kind, value.dtype, value.shape
    if kind in _PLAIN:
        return kind
    if isinstance(shape := getattr(value, "shape", None), tuple):  # not a body's shape
        return kind, getattr(value, "dtype", None), shape
    if isinstance(value, list | tuple):
        return kind, *map(_kind, value)
    return (dict, *map(_kind, value.values())) if isinstance(value, dict) else kind


def _fits(value: Any, hint: Any) -> bool:
    """Whether arrays in a value have the shape and dtype of a hint; what is not about arrays fits."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, arm) for arm in inner)
    if hint is None or hint is type(None):
        return value is None
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return isinstance(value, hint)
    if origin is tuple and isinstance(value, tuple) and inner[1:] != (Ellipsis,):
        return len(value) == len(inner) and all(map(_fits, value, inner))
    if origin in (list, tuple) and isinstance(value, list | tuple):
        return all(_fits(one, inner[0]) for one in value)
    if origin is dict and isinstance(value, dict):
        return all(_fits(one, inner[1]) for one in value.values())
    return True


def _described(value: Any) -> str:
    if hasattr(value, "shape"):
        return f"{type(value).__name__} of {getattr(value, 'dtype', '?')} and shape {tuple(value.shape)}"
    return f"{type(value).__name__} {value!r}"[:200]


class _Finder(importlib.abc.MetaPathFinder):
    """Wraps the loader of the packages' modules."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        if name.split(".")[0] not in PACKAGES:
            return None
        for finder in sys.meta_path:
            if finder is not self and (spec := finder.find_spec(name, path, target)) is not None:
                if spec.loader is not None:
                    spec.loader = _Loader(spec.loader)
                return spec
        return None


class _Loader(importlib.abc.Loader):
    """Another loader, with its modules' functions checked; whatever else it can, it still can."""

    def __init__(self, inner: importlib.abc.Loader) -> None:
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType | None:
        return self._inner.create_module(spec)

    def exec_module(self, module: types.ModuleType) -> None:
        self._inner.exec_module(module)
        for name, value in list(vars(module).items()):
            if getattr(value, "__module__", None) != module.__name__:
                continue
            if inspect.isfunction(value):
                setattr(module, name, checked(value))
            elif inspect.isclass(value):
                self._check_class(value)

    @staticmethod
    def _check_class(cls: type) -> None:
        for name, value in list(vars(cls).items()):
            if name == "__init__" and dataclasses.is_dataclass(cls):
                continue  # what is given may be converted; the fields are looked at instead
            if inspect.isfunction(value):
                setattr(cls, name, checked(value))
            elif isinstance(value, staticmethod | classmethod):
                setattr(cls, name, type(value)(checked(value.__func__)))
            elif isinstance(value, property) and value.fget is not None:
                setattr(cls, name, property(checked(value.fget), value.fset, value.fdel, value.__doc__))
        if dataclasses.is_dataclass(cls):
            _checked_dataclass(cls)
