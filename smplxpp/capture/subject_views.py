"""Turn the people of all views into rays of the world, frame by frame, to compare them in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.capture.calibrations.world import focus_of
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.keypoint_people import Person
from smplxpp.capture.subject_geometry import Sighted
from smplxpp.core import Camera

# Points that are compared: the body's and the feet's. Fingers and points of the face are many and small.
_PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe", "heel", "nose", "eye", "ear")
_LEAST_CONFIDENCE = 0.05


@dataclass(frozen=True, eq=False)
class Views:
    """People of all views as rays, and where they are in the files.

    Attributes:
        names: of the cameras.
        sighted: people of each frame.
        place: index of each of them in its list, by frame.
        height: of each in its image, a share of the image's height, by frame.
        points: pixels of the seen points of each, by frame.
        focus: point that the cameras look at, metres.
        reach: median distance of the cameras from it.
    """

    names: tuple[str, ...]
    sighted: Mapping[int, Sighted]
    place: Mapping[int, list[int]]
    height: Mapping[int, list[float]]
    points: Mapping[int, list[Float64[np.ndarray, "n 2"]]]
    focus: Float64[np.ndarray, " 3"]
    reach: float

    @staticmethod
    def of(
        people: Mapping[str, Mapping[int, Sequence[Person]]],
        cameras: Mapping[str, Camera],
        distortions: Mapping[str, Distortion],
        frames: Sequence[int],
    ) -> Views:
        """Collect the people of some frames.

        Args:
            people: by camera and frame, in pixels of the images on disk.
            cameras: full cameras of the undistorted images; those that are compared.
            distortions: of distorted images.
            frames: numbers.
        """
        # One row a person of a view: camera, frame, place in its list.
        listed = [
            (c, frame, k, one)
            for c, name in enumerate(cameras)
            for frame, own in people[name].items()
            for k, one in enumerate(own)
        ]
        camera_of = np.array([c for c, *_ in listed], dtype=np.int64)
        table = _table([one for *_, one in listed])
        # Rays camera by camera: undistortion takes all points of a lens at once.
        rays, origin = np.zeros((*table.shape[:2], 3)), np.zeros((len(listed), 3))
        for c, (name, camera) in enumerate(cameras.items()):
            rows = np.flatnonzero(camera_of == c)
            rays[rows], shown = _rays(table[rows], camera, distortions.get(name))
            table[rows, :, 2] = np.where(shown, table[rows, :, 2], 0.0)
            origin[rows] = camera.position
        rows_of: dict[int, list[int]] = {frame: [] for frame in frames}
        for row, (_, frame, _, _) in enumerate(listed):
            rows_of[frame].append(row)
        heights = [camera.height for camera in cameras.values()]
        sizes = [_height(one) / heights[c] for c, one in zip(camera_of.tolist(), table, strict=True)]
        centres = np.stack([camera.position for camera in cameras.values()])
        focus = focus_of(centres, np.stack([camera.cam_from_world[2, :3] for camera in cameras.values()]))
        return Views(
            names=tuple(cameras),
            sighted={f: Sighted(camera_of[r], origin[r], rays[r], table[r, :, 2]) for f, r in rows_of.items()},
            place={f: [listed[row][2] for row in r] for f, r in rows_of.items()},
            height={f: [sizes[row] for row in r] for f, r in rows_of.items()},
            points={f: [table[row][table[row, :, 2] > 0, :2] for row in r] for f, r in rows_of.items()},
            focus=focus,
            reach=float(np.median(np.linalg.norm(centres - focus, axis=1))),
        )


def _table(people: Sequence[Person]) -> Float64[np.ndarray, "D K 3"]:
    """Return u, v, confidence of the compared points that anybody has; 0 where a point is missing or unsure."""
    names = dict.fromkeys(
        name for one in people for name in one.points if "face" not in name and any(part in name for part in _PARTS)
    )
    table = np.zeros((len(people), len(names), 3))
    for row, one in enumerate(people):
        for column, name in enumerate(names):
            table[row, column] = one.points.get(name, 0.0)
    table[table[..., 2] < _LEAST_CONFIDENCE] = 0.0
    return table


def _rays(
    table: Float64[np.ndarray, "D K 3"], camera: Camera, distortion: Distortion | None
) -> tuple[Float64[np.ndarray, "D K 3"], np.ndarray]:
    """Return unit vectors of the world to the points of one camera, and which points the lens shows."""
    detected = table[..., 2] > 0
    plane = (table[detected][:, :2] - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    if distortion is not None:
        plane = distortion.undistort(plane)
    known = np.isfinite(plane).all(axis=1)
    inside = np.concatenate([np.where(known[:, None], plane, 0.0), np.ones((len(plane), 1))], axis=1)
    inside = inside @ camera.cam_from_world[:3, :3]
    rays, shown = np.zeros(table.shape), detected.copy()
    rays[detected] = inside / np.linalg.norm(inside, axis=1, keepdims=True)
    shown[detected] = known
    return rays, shown


def _height(points: Float64[np.ndarray, "K 3"]) -> float:
    """Return the height in pixels of the seen points; 0 for fewer than two."""
    seen = points[points[:, 2] > 0]
    return float(np.ptp(seen[:, 1])) if len(seen) > 1 else 0.0
