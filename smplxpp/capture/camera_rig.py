"""Place cameras on rings around a person, with close-ups of the face, and choose those that are held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from smplxpp.capture.writers.metadata import BODY, FACE, RigCamera
from smplxpp.core.camera import Camera
from smplxpp.core.spread import spread_inside


def camera_rig(
    points: Float[np.ndarray, "P 3"],
    heads: Float[np.ndarray, "Q 3"],
    *,
    count: int,
    size: int,
    seed: int,
    aspect: float = 0.8,
) -> list[RigCamera]:
    """Place `count` cameras that see the person in every frame.

    Args:
        points: points of the person over all frames, which body cameras must hold.
        heads: points of the head over all frames, which face cameras must hold.
        count: number of cameras; from four on two of them look at the face.
        size: height of body images in pixels; face images are square, 3/4 as high.
        seed: seed of small irregularities of places and principal points.
        aspect: width of body images by their height.
    """
    rng = np.random.default_rng([seed, 3])
    faces = 2 if count >= 4 else 0
    bodies = count - faces
    # A sixth of the ring is held out, evenly spread, but never the first camera, which looks at the front.
    held_out = set(spread_inside(range(bodies), max(1, round(bodies / 6)))) if bodies >= 4 else set()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    width = max(8, round(size * aspect / 8) * 8)
    # Body cameras: 3.4 m away, at three heights (metres) in turn.
    rig, heights = [], (1.05, 1.75, 0.55)
    for k in range(bodies):
        azimuth = np.radians(360.0 * k / bodies + rng.uniform(-4, 4))
        height = heights[k % len(heights)] + rng.uniform(-0.08, 0.08)
        eye = middle + 3.4 * np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
        eye[1] = height
        camera = _fitted(eye, middle, points, (width, size), rng, f"Cam{k + 1:03d}")
        rig.append(RigCamera(camera, BODY, k in held_out))
    head = 0.5 * (heads.min(axis=0) + heads.max(axis=0))
    square = max(8, round(size * 0.75 / 8) * 8)
    # Face cameras: 1.15 m away, in front and on the subject's left (degrees), where she turns to.
    for k in range(faces):
        azimuth = np.radians((-6.0, 44.0)[k] + rng.uniform(-3, 3))
        eye = head + 1.15 * np.array([np.sin(azimuth), rng.uniform(-0.06, 0.1), np.cos(azimuth)])
        rig.append(RigCamera(_fitted(eye, head, heads, (square, square), rng, f"Face{k + 1}"), FACE, False))
    return rig


def _fitted(
    eye: Float[np.ndarray, " 3"],
    target: Float[np.ndarray, " 3"],
    points: Float[np.ndarray, "P 3"],
    size: tuple[int, int],
    rng: np.random.Generator,
    name: str,
) -> Camera:
    """Return a camera whose image holds `points` with a margin of 6 %, its principal point a pixel off the middle."""
    width, height = size
    camera = Camera.look_at(eye=eye, target=target, fov_y_deg=40.0, width=width, height=height)
    cam = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    # Focal length and principal point follow from the range of x / z and y / z.
    slope = cam[:, :2] / cam[:, 2:]
    low, high = slope.min(axis=0), slope.max(axis=0)
    focal = float(np.min(np.array([width, height]) / (1.06 * (high - low))))
    center = np.array([width, height]) / 2 - focal * 0.5 * (low + high) + rng.uniform(-1, 1, 2)
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1.0]])
    return replace(camera, K=K, name=name)
