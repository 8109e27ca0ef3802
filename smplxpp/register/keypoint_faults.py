"""Find faults of keypoints and cameras by comparison with the other cameras.

Three faults of single views contradict points that the other views have triangulated: left and right exchanged, another
person, and a camera whose calibration is wrong. A fourth, left and right exchanged in all views, contradicts nothing;
the triangulated person then faces backwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core.keypoints import Keypoints2D
from smplxpp.register.multiview import Sightings, resection


@dataclass(frozen=True)
class FaultBounds:
    """Bounds from which a view counts as faulty. They trade missed faults against good views that are rejected.

    Attributes:
        loose: a whole view is judged by this multiple of a point's threshold, because detectors' points are off by
            centimetres that depend on the direction of view.
        least_paired: sightings of points with two sides that a view needs to be judged for exchanged sides.
        least_mended: points more that must agree once the sides are exchanged.
        left_over: largest share of the squared distances that may remain after the exchange.
        whole_view: share of the frames that can be judged, from which a view is exchanged in all frames.
        least_sightings: sightings that a view needs to be judged for another person or a wrong calibration.
        far: multiple of the threshold above which a sighting contradicts the others.
        other_person: a view shows another person if a smaller share of its sightings agrees.
        contradicts: a camera is judged if its median distance, in thresholds, times the root of its frames exceeds
            this: a detector's errors depend on the view and are alike within a frame, where a new pose explains them.
        moved: a new pose of a camera counts if it moves the projections by more than this share of the threshold.
        better: the new pose must leave less than this share of the old distance ...
        as_well: ... and less than this multiple of what is typical of the cameras.
        far_better: or it leaves less than this share, and half of the points within the threshold. This second rule
            serves single wrong cameras, because points follow the other cameras, which then seem to agree better.
    """

    loose: float = 2.0
    least_paired: int = 6
    least_mended: int = 4
    left_over: float = 0.5
    whole_view: float = 0.8
    least_sightings: int = 8
    far: float = 3.0
    other_person: float = 0.4
    contradicts: float = 1.0
    moved: float = 0.2
    better: float = 0.9
    as_well: float = 1.6
    far_better: float = 0.5


_BOUNDS = FaultBounds()
# Pairs of points on both sides of the face, in the order of dlib's 68 landmarks.
_FACE_PAIRS = (
    *((17 + k, 26 - k) for k in range(5)),
    *((31, 35), (32, 34)),
    *((36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46)),
    *((48, 54), (49, 53), (50, 52), (55, 59), (56, 58)),
    *((60, 64), (61, 63), (65, 67)),
)
_FACE_MIRROR = {f"face_{a}": f"face_{b}" for pair in _FACE_PAIRS for a, b in (pair, pair[::-1])}


def mirror_index(names: Sequence[str]) -> Int64[np.ndarray, " K"]:
    """Return the index of each point's counterpart on the other side: itself for points without a side, -1 for points
    whose counterpart is not among the names."""
    place = {name: k for k, name in enumerate(names)}
    return np.array([place.get(other_side(name), -1) for name in names], dtype=np.int64)


def other_side(name: str) -> str:
    """Return the name of a point's counterpart on the other side; the same name for points without a side."""
    if name in _FACE_MIRROR:
        return _FACE_MIRROR[name]
    return name.replace("left_", "right_") if "left_" in name else name.replace("right_", "left_")


@dataclass(frozen=True, eq=False)
class Table:
    """Sightings of K points in F frames by all cameras, N = F K, frame by frame.

    Attributes:
        sightings: of all cameras.
        names: of the K points.
        frames: numbers of the F frames.
        cameras: their names.
    """

    sightings: Sightings
    names: tuple[str, ...]
    frames: tuple[int, ...]
    cameras: tuple[str, ...]

    def by_frame(self, values: np.ndarray) -> np.ndarray:
        """Reshape an array of shape (C, N, ...) to (C, F, K, ...)."""
        return values.reshape(len(values), len(self.frames), len(self.names), *values.shape[2:])


def find_swapped(table: Table, points: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, "C F"]:
    """Find views whose points agree with the other cameras only once left and right are exchanged.

    Views from the side, in which left and right coincide, cannot be judged; they count as exchanged if nearly all other
    frames of the camera are.
    """
    # Only points with a counterpart count, where both are seen and triangulated.
    s, mirror = table.sightings, mirror_index(table.names)
    paired = (mirror >= 0) & (mirror != np.arange(len(mirror)))
    swapped_points = points.reshape(len(table.frames), -1, 3)[:, np.where(mirror < 0, 0, mirror)].reshape(-1, 3)
    seen = table.by_frame(s.weight > 0) & paired & np.isfinite(points).all(axis=1).reshape(len(table.frames), -1)
    seen &= np.isfinite(swapped_points).all(axis=1).reshape(len(table.frames), -1)

    def squares(known: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(s.residuals(known), axis=2) / (_BOUNDS.loose * s.threshold[:, None])
        return np.where(seen, np.minimum(table.by_frame(length) ** 2, 1.0), 0.0)

    # Truncated squared distances to the points as they are, and to their counterparts.
    as_given, swapped_sides = squares(points), squares(swapped_points)
    mended = (seen & (swapped_sides < 1)).sum(axis=2) - (seen & (as_given < 1)).sum(axis=2)
    enough = seen.sum(axis=2) >= _BOUNDS.least_paired

    def far_better(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return one.sum(axis=2) < _BOUNDS.left_over * other.sum(axis=2)

    # A frame is exchanged, or fine, if clearly more points agree one way round and little of the squared distance
    # remains. Side views are neither and take the verdict of their camera's other frames.
    swapped = enough & (mended >= _BOUNDS.least_mended) & far_better(swapped_sides, as_given)
    fine = enough & (mended <= -_BOUNDS.least_mended) & far_better(as_given, swapped_sides)
    judged = swapped.sum(axis=1) + fine.sum(axis=1)
    whole = swapped.any(axis=1) & (swapped.sum(axis=1) >= _BOUNDS.whole_view * judged)
    return swapped | whole[:, None]


def find_other_people(table: Table, points: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, "C F"]:
    """Find views whose sightings agree with hardly any point of the other cameras."""
    s = table.sightings
    length = np.linalg.norm(s.residuals(points), axis=2)
    known = (s.weight > 0) & np.isfinite(points).all(axis=1)
    agree = known & (length < _BOUNDS.far * s.threshold[:, None])
    # Counts by camera and frame: a detector that followed another person contradicts nearly all points of a view at
    # once.
    known, agree = table.by_frame(known).sum(axis=2), table.by_frame(agree).sum(axis=2)
    return (known >= _BOUNDS.least_sightings) & (agree < _BOUNDS.other_person * known)


def find_camera_fault(table: Table, points: Float64[np.ndarray, "N 3"]) -> tuple[int, bool] | None:
    """Find the camera that contradicts the others most over all frames.

    Returns:
        Its index, and True if another pose would make it agree (its calibration is wrong) or False if none would (it
        shows another person). None if no camera contradicts the others.
    """
    # Distances in multiples of each camera's threshold; their median over cameras is what is typical.
    s, faults = table.sightings, []
    length = np.linalg.norm(s.residuals(points), axis=2) / s.threshold[:, None]
    known = (s.weight > 0) & np.isfinite(points).all(axis=1)
    enough = [k for k in range(len(s.K)) if known[k].sum() >= _BOUNDS.least_sightings]
    before = {k: float(np.median(length[k, known[k]])) for k in enough}
    typical = float(np.median(list(before.values()))) if enough else 0.0
    # Resection: where would the camera have to be, to see the points where it says?
    for k in enough:
        # The points follow the other cameras. A calibration fault is one that a rigid motion of this camera repairs:
        # its error falls to what is typical, or to a fraction of what it was. If no motion does, the view is of another
        # person.
        frames = int(table.by_frame(known)[k].any(axis=1).sum())
        if before[k] * np.sqrt(frames) < _BOUNDS.contradicts:
            continue
        found = resection(s, k, points)
        as_well = found.median < min(_BOUNDS.as_well * typical, _BOUNDS.better * before[k])
        if found.moved > _BOUNDS.moved and (as_well or found.median < min(1.0, _BOUNDS.far_better * before[k])):
            faults.append((before[k], k, True))
        elif (length[k, known[k]] < _BOUNDS.far).mean() < _BOUNDS.other_person:
            faults.append((before[k], k, False))
    return max(faults)[1:] if faults else None


def number_ranges(numbers: Sequence[int]) -> str:
    """Return numbers as text, consecutive ones as a range: `3, 7 to 9`."""
    parts, values = [], sorted(numbers)
    start = 0
    for k in range(len(values)):
        # A range ends where the next number does not follow.
        if k + 1 == len(values) or values[k + 1] != values[k] + 1:
            first, last = values[start], values[k]
            parts.append(str(first) if first == last else f"{first} to {last}")
            start = k + 1
    return ", ".join(parts[:12]) + (f" and {len(parts) - 12} more runs" if len(parts) > 12 else "")


def pose_difference(given: Float64[np.ndarray, "3 4"], found: Float64[np.ndarray, "3 4"]) -> tuple[float, float]:
    """Return the angle between two poses of a camera, degrees, and the distance of its centres, metres."""
    turn = given[:, :3] @ found[:, :3].T
    # trace(R) = 1 + 2 cos(angle); the clip keeps round-off inside the domain of the arc cosine. The centre is -R^T t.
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    centres = [-pose[:, :3].T @ pose[:, 3] for pose in (given, found)]
    return float(angle), float(np.linalg.norm(centres[0] - centres[1]))


def sides_are_exchanged(names: Sequence[str], points: Float64[np.ndarray, "T K 3"]) -> bool:
    """Return whether feet and nose point backwards in more than nine of ten frames in which that can be seen.

    With u upwards along the trunk and a from its right to its left, a body faces along a x u.

    Args:
        names: of the points.
        points: triangulated, NaN where they are not.
    """
    # Pairs (start, end) of points whose difference points across, upwards, or forwards whatever the pose is.
    across_pairs = ("{}_hip", "coco_{}_hip", "{}_shoulder", "coco_{}_shoulder")
    up_pairs = (("pelvis", "neck"), ("coco_{}_hip", "coco_{}_shoulder"), ("{}_hip", "{}_shoulder"))
    forward_pairs = (
        ("{}_ankle", "{}_foot"),
        ("{}_heel", "{}_big_toe"),
        ("{}_ankle", "{}_big_toe"),
        ("coco_{}_ankle", "{}_big_toe"),
        ("{}_ear", "nose"),
        ("head", "jaw"),
        ("head", "nose"),
        ("neck", "nose"),
    )
    place = {name: k for k, name in enumerate(names)}

    def vector(start: str, end: str) -> np.ndarray | None:
        if start in place and end in place:
            return points[:, place[end]] - points[:, place[start]]
        return None

    def mean(vectors: list[np.ndarray | None]) -> np.ndarray:
        there = [v for v in vectors if v is not None]
        if not there:
            return np.full((len(points), 3), np.nan)
        stacked = np.stack(there)
        known = np.isfinite(stacked).all(axis=2, keepdims=True)
        return np.where(known, stacked, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)

    # The mean of each kind of vectors in each frame; the sign of (a x u) . forwards tells the facing.
    across = mean([vector(a.format("right"), a.format("left")) for a in across_pairs])
    above = mean([vector(a.format(s), b.format(s)) for a, b in up_pairs for s in ("left", "right")])
    ahead = mean([vector(a.format(s), b.format(s)) for a, b in forward_pairs for s in ("left", "right")])
    with np.errstate(invalid="ignore"):
        along = np.einsum("tx,tx->t", np.cross(across, above), ahead)
    known = along[np.isfinite(along)]
    return len(known) > 0 and float(np.mean(known < 0)) > 0.9


def exchanged(keypoints: Mapping[str, Keypoints2D]) -> dict[str, Keypoints2D]:
    """Exchange left and right in all views; points whose counterpart is missing lose their confidence."""
    out = {}
    for name, one in keypoints.items():
        other = mirror_index(one.names)
        there = np.where(other < 0, 0, other)
        confidence = np.where(other < 0, 0.0, one.confidence[:, there])
        out[name] = replace(one, points=one.points[:, there], confidence=confidence)
    return out
