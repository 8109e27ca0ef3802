"""Cache arrays within a bound in bytes, separately in each process."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np

Arrays = tuple[np.ndarray, ...]


class ArrayCache:
    """A least-recently-used cache of arrays, safe to use from several threads.

    Pickling (for a worker of a data loader) keeps the bound, not the content, and a forked process starts empty. So
    every process holds at most `max_bytes`.

    Args:
        max_bytes: bound of the size of all cached arrays.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._start()

    def _start(self) -> None:
        self._process = os.getpid()
        self._lock = threading.Lock()
        self._items: OrderedDict[Hashable, Arrays] = OrderedDict()
        self._bytes = 0

    @property
    def held_bytes(self) -> int:
        """Total size of the cached arrays in bytes."""
        return self._bytes if self._process == os.getpid() else 0

    def get(self, key: Hashable, make: Callable[[], Arrays]) -> Arrays:
        """Return the arrays of `key`, making them if they are not cached; read-only, because they are shared."""
        if self._process != os.getpid():  # a lock that another thread held at the fork would never be released
            self._start()
        with self._lock:
            # The dictionary is kept in the order of use: the most recent item is the last.
            if key in self._items:
                self._items.move_to_end(key)
                return self._items[key]
        arrays = make()  # outside the lock: threads decode at the same time
        # Callers share the arrays; a write into one of them would change what the others see.
        for array in arrays:
            array.setflags(write=False)
        size = sum(array.nbytes for array in arrays)
        with self._lock:
            # Another thread may have stored the same key in the meantime. An array above the bound is returned, but
            # never kept.
            if size <= self.max_bytes and key not in self._items:
                self._items[key] = arrays
                self._bytes += size
                # Drop the least recently used items first.
                while self._bytes > self.max_bytes:
                    _, dropped = self._items.popitem(last=False)
                    self._bytes -= sum(array.nbytes for array in dropped)
        return arrays

    def __getstate__(self) -> dict[str, int]:
        return {"max_bytes": self.max_bytes}

    def __setstate__(self, state: dict[str, int]) -> None:
        vars(self).update(vars(ArrayCache(state["max_bytes"])))
