"""How large a pickle's value is to whoever walks it, every reference followed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from smplxpp.core.files.pickle_values import InertObject, Unbuilt, broken

_MOST_LEVELS = 200


def _children(value: Any) -> Iterator[Any]:
    if isinstance(value, dict):
        return iter(value.values())
    if isinstance(value, InertObject):
        return iter((value.arguments, value.state))
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        return iter(value.ravel().tolist())
    return iter(value if isinstance(value, list | tuple) else ())


def _own_size(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return 8 + value.nbytes
    return 8 + (len(value) if isinstance(value, str | bytes | dict | list | tuple | set | frozenset) else 0)


def check_unfolding(value: Any, budget: int) -> None:
    """Refuse what is small in the file and huge to whoever walks it: lists of lists that are all the same list.

    Raises:
        pickle.UnpicklingError: too deep, too large with every reference counted, or a container within itself.
    """
    sizes: dict[int, int] = {}
    begun = {id(value)}
    path = [(value, _children(value), _own_size(value))]
    while path:
        node, children, size = path[-1]
        child = next(children, path)
        if child is path:
            path.pop()
            sizes[id(node)] = size
            if path:
                parent, rest, before = path[-1]
                path[-1] = (parent, rest, before + size)
        elif id(child) in sizes:
            path[-1] = (node, children, size + sizes[id(child)])
        elif isinstance(child, Unbuilt):
            broken("an array without content, or within itself")
        elif isinstance(child, dict | list | tuple | InertObject) or _own_size(child) > 8 or _holds_objects(child):
            if id(child) in begun and id(child) not in sizes:
                if isinstance(child, InertObject):  # records may refer to each other: nobody follows them blindly
                    continue
                broken("a container within itself")
            begun.add(id(child))
            path.append((child, _children(child), _own_size(child)))
        else:
            path[-1] = (node, children, size + 8)
        if len(path) > _MOST_LEVELS or (path and path[-1][2] > budget):
            broken("values that unfold to many times the file's size")


def _holds_objects(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.hasobject
