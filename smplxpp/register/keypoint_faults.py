"""What is wrong with keypoints or cameras, told by what the other cameras see.

Swapped sides, other people, cameras that stand elsewhere than their calibration says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.register.multiview import Sightings, resection

# What is said of a whole view is judged by more than a point's threshold: detectors' points are off by centimetres that
# depend on the side they are seen from.
_LOOSE = 2.0
# A swap has to explain this many points more, and leave at most this share of the squared distances.
_LEAST_MENDED, _LEFT_OVER = 4, 0.5
_LEAST_PAIRED = 6
# Of the frames in which sides can be told, how many have to be swapped for the whole view to count as swapped.
_WHOLE_VIEW = 0.8
# A view shows somebody else when fewer of at least so many sightings are near what the others see.
_OTHER_PERSON, _FAR, _LEAST_SIGHTINGS = 0.4, 3.0, 8
# A camera is misplaced when from another pose, from which it sees the points elsewhere by more than this share of a
# threshold, it sees them better than before: about as well as the others do, or half of them within the threshold where
# that was far from so (points follow the other cameras, which therefore seem to see them better).
_MOVED, _BETTER, _AS_WELL, _FAR_BETTER = 0.2, 0.9, 1.6, 0.5
# Points on both sides of the face in dlib's count.
_FACE_PAIRS = (
    *((17 + k, 26 - k) for k in range(5)),
    *((31, 35), (32, 34)),
    *((36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46)),
    *((48, 54), (49, 53), (50, 52), (55, 59), (56, 58)),
    *((60, 64), (61, 63), (65, 67)),
)
_FACE_MIRROR = {f"face_{a}": f"face_{b}" for pair in _FACE_PAIRS for a, b in (pair, pair[::-1])}


def mirror_index(names: Sequence[str]) -> Int64[np.ndarray, " K"]:
    """Where the other side of each point is among the names; the point itself where it has no side, -1 where its other
    side is not among them."""
    place = {name: k for k, name in enumerate(names)}
    return np.array([place.get(other_side(name), -1) for name in names], dtype=np.int64)


def other_side(name: str) -> str:
    """The name of the same point on the other side; itself where it has no side."""
    if name in _FACE_MIRROR:
        return _FACE_MIRROR[name]
    return name.replace("left_", "right_") if "left_" in name else name.replace("right_", "left_")


@dataclass(frozen=True, eq=False)
class Table:
    """Sightings of F frames of K points, N = F K, point after point of a frame.

    Attributes:
        sightings: of all cameras. names, frames: of points and of frames. cameras: their names.
    """

    sightings: Sightings
    names: tuple[str, ...]
    frames: tuple[int, ...]
    cameras: tuple[str, ...]

    def by_frame(self, values: np.ndarray) -> np.ndarray:
        """(C, F, K, ...) of what is (C, N, ...)."""
        return values.reshape(len(values), len(self.frames), len(self.names), *values.shape[2:])


def find_swapped(table: Table, points: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, "C F"]:
    """Views whose left and right are exchanged: seen as their other sides, their points agree with the other cameras.

    Views from the side, where left and right lie on one another, tell nothing; they follow the camera's others where
    these are all swapped.
    """
    s, mirror = table.sightings, mirror_index(table.names)
    paired = (mirror >= 0) & (mirror != np.arange(len(mirror)))
    swapped_points = points.reshape(len(table.frames), -1, 3)[:, np.where(mirror < 0, 0, mirror)].reshape(-1, 3)
    seen = table.by_frame(s.weight > 0) & paired & np.isfinite(points).all(axis=1).reshape(len(table.frames), -1)
    seen &= np.isfinite(swapped_points).all(axis=1).reshape(len(table.frames), -1)

    def squares(known: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(s.residuals(known), axis=2) / (_LOOSE * s.threshold[:, None])
        return np.where(seen, np.minimum(table.by_frame(length) ** 2, 1.0), 0.0)

    as_given, exchanged = squares(points), squares(swapped_points)
    mended = (seen & (exchanged < 1)).sum(axis=2) - (seen & (as_given < 1)).sum(axis=2)
    enough = seen.sum(axis=2) >= _LEAST_PAIRED

    def far_better(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return one.sum(axis=2) < _LEFT_OVER * other.sum(axis=2)

    swapped = enough & (mended >= _LEAST_MENDED) & far_better(exchanged, as_given)
    fine = enough & (mended <= -_LEAST_MENDED) & far_better(as_given, exchanged)
    told = swapped.sum(axis=1) + fine.sum(axis=1)
    whole = swapped.any(axis=1) & (swapped.sum(axis=1) >= _WHOLE_VIEW * told)
    return swapped | whole[:, None]


def find_other_people(table: Table, points: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, "C F"]:
    """Views whose sightings agree with next to nothing of what the other cameras see."""
    s = table.sightings
    length = np.linalg.norm(s.residuals(points), axis=2)
    known = (s.weight > 0) & np.isfinite(points).all(axis=1)
    agree = known & (length < _FAR * s.threshold[:, None])
    known, agree = table.by_frame(known).sum(axis=2), table.by_frame(agree).sum(axis=2)
    return (known >= _LEAST_SIGHTINGS) & (agree < _OTHER_PERSON * known)


def find_camera_fault(table: Table, points: Float64[np.ndarray, "N 3"]) -> tuple[int, bool] | None:
    """The worst camera that contradicts the others in all frames.

    Returns:
        Its place, and whether another pose would make it agree (it is misplaced) or none would (it sees somebody else).
        None where there is no such camera.
    """
    s, faults = table.sightings, []
    length = np.linalg.norm(s.residuals(points), axis=2) / s.threshold[:, None]
    known = (s.weight > 0) & np.isfinite(points).all(axis=1)
    enough = [k for k in range(len(s.K)) if known[k].sum() >= _LEAST_SIGHTINGS]
    before = {k: float(np.median(length[k, known[k]])) for k in enough}
    typical = float(np.median(list(before.values()))) if enough else 0.0
    for k in enough:
        found = resection(s, k, points)
        as_well = found.median < min(_AS_WELL * typical, _BETTER * before[k])
        if found.moved > _MOVED and (as_well or found.median < min(1.0, _FAR_BETTER * before[k])):
            faults.append((before[k], k, True))
        elif (length[k, known[k]] < _FAR).mean() < _OTHER_PERSON:
            faults.append((before[k], k, False))
    return max(faults)[1:] if faults else None


def in_words(numbers: Sequence[int]) -> str:
    """Frames, runs of them shortened: `3, 7 to 9`."""
    parts, values = [], sorted(numbers)
    start = 0
    for k in range(len(values)):
        if k + 1 == len(values) or values[k + 1] != values[k] + 1:
            first, last = values[start], values[k]
            parts.append(str(first) if first == last else f"{first} to {last}")
            start = k + 1
    return ", ".join(parts[:12]) + (f" and {len(parts) - 12} more runs" if len(parts) > 12 else "")


def pose_difference(given: Float64[np.ndarray, "3 4"], found: Float64[np.ndarray, "3 4"]) -> tuple[float, float]:
    """Degrees between two poses of a camera, and metres between its centres."""
    turn = given[:, :3] @ found[:, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    centres = [-pose[:, :3].T @ pose[:, 3] for pose in (given, found)]
    return float(angle), float(np.linalg.norm(centres[0] - centres[1]))
