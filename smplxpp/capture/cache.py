"""A cache bounded in bytes, one for each process."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np

Arrays = tuple[np.ndarray, ...]


class ArrayCache:
    """Least recently used arrays are forgotten first; safe to use from several threads.

    Pickling (a loader's worker) carries the bound, not the content; a forked process starts empty. So every process
    holds at most `max_bytes`, whatever the number of workers.
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
        """Bytes of the arrays held now."""
        return self._bytes if self._process == os.getpid() else 0

    def get(self, key: Hashable, make: Callable[[], Arrays]) -> Arrays:
        """The arrays of `key`, made if they are not here. Read-only: they are shared."""
        if self._process != os.getpid():  # a lock that another thread held at the fork would never be released
            self._start()
        with self._lock:
            if key in self._items:
                self._items.move_to_end(key)
                return self._items[key]
        arrays = make()  # outside the lock: threads decode at the same time
        for array in arrays:
            array.setflags(write=False)
        size = sum(array.nbytes for array in arrays)
        with self._lock:
            if size <= self.max_bytes and key not in self._items:
                self._items[key] = arrays
                self._bytes += size
                while self._bytes > self.max_bytes:
                    _, dropped = self._items.popitem(last=False)
                    self._bytes -= sum(array.nbytes for array in dropped)
        return arrays

    def __getstate__(self) -> dict[str, int]:
        return {"max_bytes": self.max_bytes}

    def __setstate__(self, state: dict[str, int]) -> None:
        vars(self).update(vars(ArrayCache(state["max_bytes"])))
