"""Prepare records of body parameters for their reader: name what it does not look at, fill frames that are empty."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core import ARRAY_NAMES, POSE_BLOCKS, GeometryWarning, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.errors import InputError, warn_of_left_out

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


def with_known_names(content: Any) -> Any:
    """Return AIST++'s record (`smpl_poses`, `smpl_trans`) by AMASS' names; everything else as it is.

    Its positions are metres times `smpl_scaling`; it has one shape, the mean one, and 60 frames a second.

    Example:
        >>> dance = {"smpl_poses": np.zeros((2, 72)), "smpl_trans": np.full((2, 3), 95.0), "smpl_scaling": [95.0]}
        >>> with_known_names(dance)["trans"].tolist()
        [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    if not isinstance(content, Mapping) or not {"smpl_poses", "smpl_trans"} <= set(content):
        return content
    scale = float(np.ravel(content.get("smpl_scaling", 1.0))[0])
    return {
        "poses": content["smpl_poses"],
        "trans": np.asarray(content["smpl_trans"], dtype=np.float64) / (scale or 1.0),
        "betas": np.zeros(10),
        "fps": 60.0,
    }


def of_one_person(content: Any, person: int | None, *, source: str = "file") -> Any:
    """Return one person's record of a file that lists the people's `poses`, `trans` and `betas`, as 3DPW's do.

    Args:
        content: arrays by name; what has no such lists is returned as it is.
        person: place in the lists; None: the only one.
        source: the file, in messages.

    Raises:
        InputError: several people and none chosen, or a place that is none.
    """
    people = content.get("poses") if isinstance(content, Mapping) else None
    try:
        shapes = [np.shape(one) for one in people] if people is not None and _rows(people) else []
    except ValueError:  # ragged rows
        return content
    # Rows of 72 numbers and more; a pose of matrices or of joints has rows of 3 and 9.
    whole = 60
    if not shapes or any(len(shape) != 2 or shape[1] < whole for shape in shapes):
        return content
    if (person is None and len(shapes) > 1) or (person is not None and not 0 <= person < len(shapes)):
        raise InputError(
            f"{source}: people",
            expected=f"one of {len(shapes)} people, by the place in their lists: 0 to {len(shapes) - 1}",
            received="none chosen" if person is None else str(person),
            remedy="choose one: person, --person",
        )
    place = person or 0
    mine = {key: content[key][place] for key in ("poses", "trans", "betas") if _rows(content.get(key)) == len(shapes)}
    return {**{key: value for key, value in content.items() if not _rows(value)}, **mine}


def _rows(value: Any) -> int:
    """Return the length of a list or an array, 0 for anything else, as an array of a single number."""
    listed = isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim > 0)
    return len(value) if listed else 0


_ROTATIONS = frozenset(name for name, _ in POSE_BLOCKS)


def without_gaps(content: Any, *, source: str) -> Any:
    """Return a file of stacked frames whose empty frames are interpolated; those at the ends repeat the nearest one.

    A frame is empty if all its parameters are NaN, as `smplxpp register` writes for frames that it was not asked for.
    Rotations are interpolated on the shortest arc, everything else linearly. Frames with single NaNs stay as they are.

    Args:
        content: arrays by name.
        source: the file, in the warning.

    Warns:
        GeometryWarning: which frames were filled.

    Example:
        >>> rows = {name: np.full((3, 3), np.nan) for name in ("global_orient", "transl")}
        >>> rows["transl"][[0, 2]], rows["global_orient"][[0, 2]] = [[0.0], [0.2]], 0.0
        >>> with warnings.catch_warnings(action="ignore"):
        ...     without_gaps(rows, source="file motion.npz")["transl"][1].tolist()
        [0.1, 0.1, 0.1]
    """
    if not isinstance(content, Mapping) or "transl" not in content:
        return content
    arrays = {
        name: np.asarray(content[name])
        for name in ARRAY_NAMES
        if name in content and isinstance(content[name], np.ndarray) and content[name].dtype.kind == "f"
    }
    count = len(arrays["transl"]) if "transl" in arrays else 0
    arrays = {name: rows for name, rows in arrays.items() if rows.ndim > 1 and len(rows) == count}
    if count < 2 or len(arrays) < 2:
        return content
    empty = np.logical_and.reduce(
        [np.isnan(rows.reshape(count, -1)).all(axis=1) for rows in arrays.values() if rows.size]
    )
    known = np.flatnonzero(~empty)
    if not empty.any() or not len(known):
        return content
    gaps = np.flatnonzero(empty)
    # Frames that a warning names.
    named = 6
    shown = ", ".join(map(str, gaps[:named])) + (f" and {len(gaps) - named} more" if len(gaps) > named else "")
    warnings.warn(
        f"{source}: {len(gaps)} of {count} frames hold nothing ({shown}): filled from the frames around them",
        GeometryWarning,
        stacklevel=4,
    )
    # Neighbours of each gap among the known frames, and how far it is from the first to the second.
    after = np.minimum(np.searchsorted(known, gaps), len(known) - 1)
    before = np.maximum(np.searchsorted(known, gaps) - 1, 0)
    first, second = known[before], known[after]
    share = np.where(second > first, (gaps - first) / np.maximum(second - first, 1), 0.0)
    # Before the first known frame both neighbours are this frame.
    first = np.where(gaps < known[0], known[0], first)
    filled = dict(content)
    for name, rows in arrays.items():
        filled[name] = rows.copy()
        filled[name][gaps] = _between(rows, first, second, share, turns=name in _ROTATIONS)
    return filled


def _between(
    rows: np.ndarray,
    first: Int64[np.ndarray, " G"],
    second: Int64[np.ndarray, " G"],
    share: Float64[np.ndarray, " G"],
    *,
    turns: bool,
) -> np.ndarray:
    """Interpolate between pairs of rows by a share of each; rotation vectors along the shortest arc."""
    a, b = rows[first].astype(np.float64), rows[second].astype(np.float64)
    weight = share.reshape(-1, *(1,) * (rows.ndim - 1))
    if not turns:
        return a + weight * (b - a)
    start, end = (matrix_from_rotvec(values.reshape(len(values), -1, 3)) for values in (a, b))
    arc = rotvec_from_matrix(start.swapaxes(-1, -2) @ end)
    between = start @ matrix_from_rotvec(share[:, None, None] * arc)
    return rotvec_from_matrix(between).reshape(a.shape)
