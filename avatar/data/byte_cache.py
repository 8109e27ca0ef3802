"""Least-recently-used cache of tensors, bounded in bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor


class ByteCache:
    """Tensors by key; the least recently used ones are dropped when a bound is exceeded.

    Args:
        max_bytes: bound of all tensors together.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._kept: OrderedDict[Hashable, tuple[Tensor, ...]] = OrderedDict()
        self._bytes = 0

    def __contains__(self, key: Hashable) -> bool:
        return key in self._kept

    def get(self, key: Hashable, make: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Return the cached tensors of a key, or make and cache them, without gradients."""
        # A hit becomes the most recently used entry.
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        with torch.no_grad():
            made = make()
        # Tensors above the bound are not cached; the least recently used ones make room.
        size = _bytes(made)
        if size <= self.max_bytes:
            self._kept[key] = made
            self._bytes += size
            while self._bytes > self.max_bytes:
                self._bytes -= _bytes(self._kept.popitem(last=False)[1])
        return made


def _bytes(tensors: Sequence[Tensor]) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)
