"""Run the opcodes of a pickle with a restricted vocabulary: arrays, plain containers, records.

Names in a pickle never become Python objects. They become `Name` tokens, and calls are looked up in the table of
`smplxpp.core.files.pickle_values`. Containers are changed only by opcodes that occur in data files.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np

from smplxpp.core.files.pickle_values import (
    BUILDERS,
    KNOWN_NAMES,
    Budget,
    Dtype,
    InertObject,
    Memo,
    Name,
    RefusedName,
    Unbuilt,
    array_of_state,
    as_key,
    broken,
    exactly,
    is_recorded,
)

_REFUSED_OPCODES = (
    pickle.EXT1,
    pickle.EXT2,
    pickle.EXT4,
    pickle.PERSID,
    pickle.BINPERSID,
    pickle.NEXT_BUFFER,
    pickle.READONLY_BUFFER,
)


class PickleMachine(pickle._Unpickler):
    """Reads one pickle without executing it; `load` returns its value.

    Raises (from `load`):
        RefusedName: a name that is not in the table.
        pickle.UnpicklingError and other standard errors: a broken file.
    """

    # State of the parent class, which the standard library's type stubs omit.
    stack: list[Any]
    append: Callable[[Any], None]
    pop_mark: Callable[[], list[Any]]
    memo: dict[int, Any]

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")
        self.memo = Memo()
        # Bytes that the value may take with all references followed: 64 MiB, and 16 times the file.
        self._budget = Budget((1 << 26) + 16 * len(data))

    def load(self) -> Any:
        """Run the opcodes and return the value of the pickle."""
        value = super().load()
        check_unfolding([value], self._budget.most)
        return value

    def find_class(self, module: str, name: str) -> Any:
        """Return a token for a name, which is never imported."""
        token = Name(module, name)
        if token not in KNOWN_NAMES and not is_recorded(token):
            raise RefusedName(str(token))
        return token

    def _call(self, token: Any, arguments: Any) -> Any:
        if not isinstance(token, Name) or not isinstance(arguments, tuple):
            broken("a call of no name")
        if is_recorded(token):
            return InertObject(str(token), arguments)
        builder = BUILDERS.get(token)
        if builder is None:
            raise RefusedName(str(token))
        return builder(self._budget, *arguments)

    # Opcodes that call builders, or change containers on the stack.

    def load_reduce(self) -> None:
        arguments = self.stack.pop()
        self.stack[-1] = self._call(self.stack[-1], arguments)

    def load_newobj_ex(self) -> None:
        keywords = self.stack.pop()
        if keywords != {}:
            broken("a call with keywords")
        self.load_reduce()

    def _instantiate(self, token: Any, arguments: list[Any]) -> None:
        """Run the opcodes INST and OBJ of old protocols."""
        self.append(self._call(token, tuple(arguments)))

    def load_build(self) -> None:
        # BUILD gives a state to the object below it on the stack: an array its content, a type its byte order, a
        # record its attributes.
        state = self.stack.pop()
        top = self.stack[-1]
        if isinstance(top, Unbuilt) and top.value is None:
            top.value = self.stack[-1] = array_of_state(self._budget, state)
        elif isinstance(top, Dtype):
            top.order = exactly(exactly(state, tuple)[1], str)
        elif isinstance(top, InertObject):
            top.state = state
        else:
            broken(f"a state for {type(top).__name__}")

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self._set_items(items)

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set_items([key, value])

    def load_setitems(self) -> None:
        self._set_items(self.pop_mark())

    def _set_items(self, items: list[Any]) -> None:
        target = exactly(self.stack[-1], dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            target[as_key(key)] = value

    def load_append(self) -> None:
        value = self.stack.pop()
        exactly(self.stack[-1], list).append(value)

    def load_appends(self) -> None:
        items = self.pop_mark()
        exactly(self.stack[-1], list).extend(items)

    def load_additems(self) -> None:
        items = self.pop_mark()
        exactly(self.stack[-1], set).update(map(as_key, items))

    def load_frozenset(self) -> None:
        items = self.pop_mark()
        self.append(frozenset(map(as_key, items)))

    # The parent's methods by opcode, without extensions, persistent objects and buffers, which refer to other data.
    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        code: method for code, method in pickle._Unpickler.dispatch.items() if bytes([code]) not in _REFUSED_OPCODES
    } | {
        pickle.REDUCE[0]: load_reduce,
        pickle.NEWOBJ[0]: load_reduce,
        pickle.NEWOBJ_EX[0]: load_newobj_ex,
        pickle.BUILD[0]: load_build,
        pickle.DICT[0]: load_dict,
        pickle.SETITEM[0]: load_setitem,
        pickle.SETITEMS[0]: load_setitems,
        pickle.APPEND[0]: load_append,
        pickle.APPENDS[0]: load_appends,
        pickle.ADDITEMS[0]: load_additems,
        pickle.FROZENSET[0]: load_frozenset,
    }


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
    """Refuse values that are small in the file and huge with all references followed, such as nested equal lists.

    A depth-first walk with an explicit stack adds up sizes; a container that was walked before counts with its size.

    Raises:
        pickle.UnpicklingError: too deep, too large with every reference counted, or a container within itself.
    """
    max_levels = 200
    # Sizes of finished containers by identity: a second reference adds the size without a second walk.
    sizes: dict[int, int] = {}
    begun = {id(value)}
    # Each level of the path holds a container, the iterator over its children, and the bytes added up so far.
    path = [(value, _children(value), _own_size(value))]
    while path:
        node, children, size = path[-1]
        # The path itself serves as a sentinel that no child can be.
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
                if isinstance(child, InertObject):  # records may refer to each other
                    continue
                broken("a container within itself")
            begun.add(id(child))
            path.append((child, _children(child), _own_size(child)))
        else:
            path[-1] = (node, children, size + 8)
        if len(path) > max_levels or (path and path[-1][2] > budget):
            broken("values that unfold to many times the file's size")


def _holds_objects(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.hasobject
