"""What is wrong with keypoints or cameras, told by what the other cameras see.

Swapped sides, other people, cameras that stand elsewhere than their calibration says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.register.multiview import Sightings, resection

# A swap has to explain this many points more, and leave at most this share of the squared distances.
_LEAST_MENDED, _LEFT_OVER = 4, 0.4
_LEAST_PAIRED = 6
# Of the frames in which sides can be told, how many have to be swapped for the whole view to count as swapped.
_WHOLE_VIEW = 0.8
# A view shows somebody else, or a camera stands elsewhere, when fewer of its sightings than this agree with the others.
_OTHER_PERSON = 0.25
_LEAST_SIGHTINGS = 6
# A camera's own pose is off when it would have to turn by more than this (degrees) and then agrees far better.
_LEAST_TURN, _BETTER = 0.5, 0.6
# Points on both sides of the face in dlib's count.
_FACE_PAIRS = (
    *((17 + k, 26 - k) for k in range(5)),
    *((31, 35), (32, 34)),
    *((36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46)),
    *((48, 54), (49, 53), (50, 52), (55, 59), (56, 58)),
    *((60, 64), (61, 63), (65, 67)),
)


def mirror_index(names: Sequence[str]) -> Int64[np.ndarray, " K"]:
    """Where the other side of each point is among the names; the point itself where it has no side, -1 where its other
    side is not among them."""
    face = {f"face_{a}": f"face_{b}" for pair in _FACE_PAIRS for a, b in (pair, pair[::-1])}
    place = {name: k for k, name in enumerate(names)}

    def other(name: str) -> str:
        if name in face:
            return face[name]
        return name.replace("left_", "right_") if "left_" in name else name.replace("right_", "left_")

    return np.array([place.get(other(name), -1) for name in names], dtype=np.int64)


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
        length = np.linalg.norm(s.residuals(known), axis=2) / s.threshold[:, None]
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
    agree = known & (length < s.threshold[:, None])
    known, agree = table.by_frame(known).sum(axis=2), table.by_frame(agree).sum(axis=2)
    return (known >= _LEAST_SIGHTINGS) & (agree < _OTHER_PERSON * known)


@dataclass(frozen=True)
class CameraFault:
    """A camera that others contradict.

    Attributes:
        camera: its place.
        turn_degrees, shift: how it would have to turn, and by how many metres its centre would have to move, to agree;
            NaN where no pose does: it shows somebody else.
    """

    camera: int
    turn_degrees: float
    shift: float


def find_camera_fault(table: Table, points: Float64[np.ndarray, "N 3"]) -> CameraFault | None:
    """The worst camera that stands elsewhere than its calibration says, or sees somebody else in all frames."""
    s, faults = table.sightings, []
    length = np.linalg.norm(s.residuals(points), axis=2)
    for camera in range(len(s.K)):
        known = (s.weight[camera] > 0) & np.isfinite(points).all(axis=1)
        if known.sum() < 4 * _LEAST_SIGHTINGS:
            continue
        before = float(np.minimum(length[camera, known] / s.threshold[camera], 1.0).mean())
        pose, agree = resection(s, camera, points)
        turn, shift = _difference(s.cam_from_world[camera], pose)
        moved = Sightings(s.K, _with_row(s.cam_from_world, camera, pose), s.pixels, s.weight, s.threshold, s.noise)
        after_length = np.linalg.norm(moved.residuals(points)[camera, known], axis=1)
        after = float(np.minimum(after_length / s.threshold[camera], 1.0).mean())
        share_before = float((length[camera, known] < s.threshold[camera]).mean())
        share_after = float(agree[known].mean())
        if turn > _LEAST_TURN and after < _BETTER * before and share_after > 0.5:
            faults.append((before, CameraFault(camera, turn, shift)))
        elif share_before < _OTHER_PERSON and share_after < 0.5:
            faults.append((before, CameraFault(camera, float("nan"), float("nan"))))
    return max(faults, key=lambda one: one[0])[1] if faults else None


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


def _with_row(values: np.ndarray, row: int, value: np.ndarray) -> np.ndarray:
    out = values.copy()
    out[row] = value
    return out


def _difference(given: Float64[np.ndarray, "3 4"], found: Float64[np.ndarray, "3 4"]) -> tuple[float, float]:
    """Degrees between two poses of a camera, and metres between its centres."""
    turn = given[:, :3] @ found[:, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    centres = [-pose[:, :3].T @ pose[:, 3] for pose in (given, found)]
    return float(angle), float(np.linalg.norm(centres[0] - centres[1]))
