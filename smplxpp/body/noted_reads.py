"""Name what a file of body parameters has and its layout's reader does not look at."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from smplxpp.core.errors import warn_of_left_out

# Parts of `poses` that AMASS writes a second time, under names of their own, and what fits write of the posed body,
# which follows from the parameters.
_COPIES = frozenset({"root_orient", "pose_body", "pose_hand", "pose_jaw", "pose_eye", "full_pose"}) | frozenset(
    {"joints", "Jtr", "joints_3d", "vertices", "verts", "faces"}
)


class NotedReads(dict[str, Any]):
    """A record of a file that notes which of its entries a reader looked at, so that the others can be named.

    Example:
        >>> record = NotedReads({"poses": np.ones(3), "contacts": np.ones(4), "fps": 30})
        >>> record["poses"].sum(), record.keys_left()
        (3.0, ['contacts'])
    """

    def __init__(self, record: Mapping[str, Any]) -> None:
        super().__init__({str(key): value for key, value in record.items()})
        self._read: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        self._read.add(key)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return an entry, as `dict.get` does."""
        self._read.add(key)
        return super().get(key, default)

    def keys_left(self) -> list[str]:
        """Return the names of arrays that no reader looked at and that are not zero, without copies of the poses."""
        left: list[str] = []
        # Of another person in the file only the id was looked at.
        if not self._read - {"id"}:
            return left
        for key in self.keys() - self._read - _COPIES:
            value = super().__getitem__(key)
            try:
                array = np.asarray(value)
            except ValueError:  # a ragged list is no array
                continue
            # Single numbers describe the file (a count, a duration); arrays describe the person or the motion.
            if array.dtype.kind in "iuf" and array.size > 1 and array.any():
                left.append(key)
        return sorted(left)


def warn_of_unread(records: Any, layout: str, source: str) -> None:
    """Name the arrays of a file that are not zero and that its layout's reader does not read."""
    left = sorted({key for one in records if isinstance(one, NotedReads) for key in one.keys_left()})
    # Files of frames get one text, so that it is shown once.
    source = re.sub(r"[0-9]{4,}", "#", source)
    warn_of_left_out(source, left, reason=f"not read in the layout {layout}", stacklevel=5)
