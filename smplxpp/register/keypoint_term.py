"""Prepare the keypoints of all cameras and add them to the normal equations as residuals in pixels.

The term of a frame is `sum_ck w_ck GM(|project_c(x_k) - u_ck|; 3 s_c) / s_c^2` over cameras c and keypoints k, with the
body's landmark x_k, the detected keypoint u_ck, its confidence w_ck, and the camera's noise s_c. GM is the kernel of
Geman and McClure. While a fit starts, s_c is multiplied by a scale that falls to 1, so that far keypoints still pull.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core import Camera, Keypoints2D
from smplxpp.register.keypoint_faults import exchanged, sides_are_exchanged
from smplxpp.register.kinematics import Kinematics, Posture
from smplxpp.register.landmarks import LandmarkModel, LandmarkPoints
from smplxpp.register.normal_equations import Equations
from smplxpp.register.observations import Observations, RegisterConfig
from smplxpp.register.triangulate import Reprojection, triangulate


@dataclass(frozen=True, eq=False)
class PreparedKeypoints:
    """Keypoints that are known to the body and on which the views agree, with their noise.

    Attributes:
        landmarks: the named points of the body.
        keypoints: by camera, with the names of `landmarks` and all frames; keypoints that contradict the other views
            have confidence 0.
        noise_px: standard deviation of each camera's keypoints, pixels.
        points: triangulated, metres; NaN where they are not.
        reprojection: reprojection error of each camera.
        notes: sentences about faults and what was done about them.
    """

    landmarks: LandmarkModel
    keypoints: Mapping[str, Keypoints2D]
    noise_px: Mapping[str, float]
    points: Float64[np.ndarray, "T K 3"]
    reprojection: Mapping[str, Reprojection] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def prepare_keypoints(body: BodyModel, observed: Observations, config: RegisterConfig) -> PreparedKeypoints | None:
    """Triangulate the keypoints, estimate their noise and drop those that the views contradict; None without any."""
    # Keep the keypoints that the body has as landmarks.
    given = {name: k for name, k in observed.keypoints.items() if name in observed.cameras}
    if not given:
        return None
    asked = tuple(dict.fromkeys(name for k in given.values() for name in k.names))
    landmarks = LandmarkModel.of(body, asked)
    notes = []
    if landmarks.unknown:
        shown = ", ".join(landmarks.unknown[:8]) + (", ..." if len(landmarks.unknown) > 8 else "")
        notes.append(f"keypoints that the body {body.name!r} does not have are left out: {shown}")
    # The noise of one camera cannot be measured: it is taken for three pixels of an image 640 pixels high.
    height, single_px = 640.0, 3.0
    frames, names = observed.frames, landmarks.names
    floor = {name: config.keypoint_px * observed.cameras[name].height / height for name in given}
    if len(given) < 2:
        keypoints = {name: k.select(names, frames) for name, k in given.items()}
        noise = {name: max(floor[name], single_px * observed.cameras[name].height / height) for name in given}
        nothing = np.full((len(frames), len(names), 3), np.nan)
        return PreparedKeypoints(landmarks, keypoints, noise, nothing, notes=tuple(notes))
    # Triangulate; if the result faces backwards, all views have exchanged left and right.
    found = triangulate(given, observed.cameras, names=names, frames=frames)
    if sides_are_exchanged(found.names, found.points):
        notes.append("left and right are exchanged in all views: feet and face would point backwards; exchanged back")
        found = triangulate(exchanged(given), observed.cameras, names=names, frames=frames)
    # Keypoints of triangulated points that are no inliers lose their confidence.
    agreed = {}
    known = np.isfinite(found.points).all(axis=2)
    for k, name in enumerate(found.cameras):
        if name in found.keypoints:
            one = found.keypoints[name]
            confidence = np.where(known & ~found.inliers[..., k], 0.0, one.confidence)
            agreed[name] = Keypoints2D(one.names, one.frames, one.points, confidence)
    return PreparedKeypoints(
        landmarks,
        agreed,
        {name: max(floor[name], found.noise_px[name]) for name in agreed},
        found.points,
        found.by_camera,
        (*notes, *found.notes),
    )


class KeypointTerm:
    """Reprojection errors of keypoints; see the module's docstring.

    Args:
        body: the body model.
        landmarks: the named points of the body.
        cameras: by name.
        keypoints: by camera, all with the frames of the registration and the names of `landmarks`, in order; missing
            and rejected keypoints have confidence 0.
        noise_px: standard deviation of each camera's keypoints, pixels.
    """

    cutoff = 3.0
    """Standard deviations at which the robust weight is a quarter."""

    def __init__(
        self,
        body: BodyModel,
        landmarks: LandmarkModel,
        cameras: Mapping[str, Camera],
        keypoints: Mapping[str, Keypoints2D],
        noise_px: Mapping[str, float],
    ) -> None:
        names = [name for name in keypoints if name in cameras]
        self.names, self.cameras = names, [cameras[name] for name in names]
        self.points = np.stack([keypoints[name].points for name in names])
        self.confidence = np.stack([keypoints[name].confidence for name in names])
        self.noise = np.array([noise_px[name] for name in names])
        self.landmarks = LandmarkPoints.of(body, landmarks)
        self.scale = 1.0

    def used(self, row: int) -> bool:
        """Return whether a frame has any keypoint."""
        return bool((self.confidence[:, row] > 0).any())

    def add(self, equations: Equations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool) -> None:
        """Add the keypoints of one frame to the normal equations."""
        if not self.used(row):
            return
        motion, points = self.landmarks.motion(kinematics, posture)
        # Sum the information J^T W J and the gradient J^T W r of every landmark over the cameras.
        information, vector = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for k, camera in enumerate(self.cameras):
            residual, jacobian, seen = projected(camera, points)
            residual = residual - self.points[k, row]
            # Geman-McClure weight by the pixel distance, times the detector's confidence; 0 for points behind the
            # camera.
            scale = self.noise[k] * self.scale
            squared = (residual**2).sum(axis=1) / (self.cutoff * scale) ** 2
            weight = seen * self.confidence[k, row] / (scale**2 * (1.0 + squared) ** 2)
            information += np.einsum("n,nax,nay->nxy", weight, jacobian, jacobian)
            vector += np.einsum("n,nax,na->nx", weight, jacobian, residual)
        # Landmarks that no camera sees carry no information.
        kept = np.flatnonzero(np.einsum("nxx->n", information) > 0)
        # With information H = V L V^T and gradient g, the three rows `L^1/2 V^T` with the residuals `L^-1/2 V^T g` give
        # the same normal equations as all cameras' rows, which saves multiplying the body's Jacobian once a camera.
        values, axes = np.linalg.eigh(information[kept])
        # With one camera the depth is not observed and its eigenvalue is 0; the floor only avoids the division by it.
        values = np.maximum(values, 1e-12 * values[:, -1:])
        root = np.sqrt(values)[:, :, None] * axes.transpose(0, 2, 1)
        target = (axes.transpose(0, 2, 1) @ vector[kept, :, None])[..., 0] / np.sqrt(values)
        rows = root @ self.landmarks.combined(equations.columns.jacobian(motion))[kept]
        equations.add(row, rows.reshape(-1, rows.shape[-1]), target.reshape(-1), shape=shape)

    def residual_px(self, row: int, kinematics: Kinematics, posture: Posture) -> float:
        """Return the median reprojection error of a frame's keypoints, pixels; NaN without any."""
        points = self.landmarks.points(kinematics, posture)
        found = []
        for k, camera in enumerate(self.cameras):
            there, _, seen = projected(camera, points)
            use = seen & (self.confidence[k, row] > 0)
            found.append(np.linalg.norm(there - self.points[k, row], axis=1)[use])
        # The median over all cameras together, because a single camera may see few points.
        every = np.concatenate(found)
        return float(np.median(every)) if len(every) else float("nan")


def projected(
    camera: Camera, points: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, "N 2 3"], np.ndarray]:
    """Project points and return their pixels, the derivatives by the points, and which lie before the camera.

    Points nearer than 5 cm to the plane of the camera, or behind it, count as not visible.
    """
    R, K = camera.cam_from_world[:3, :3], camera.K
    inside = points @ R.T + camera.cam_from_world[:3, 3]
    depth = inside[:, 2]
    seen = depth > 0.05
    safe = np.where(seen, depth, 1.0)
    pixels = inside[:, :2] / safe[:, None] @ K[:2, :2].T + K[:2, 2]
    # Derivative of the pinhole projection u = K (X / Z, Y / Z): K / Z by X and Y, -K (X, Y) / Z^2 by Z, and the
    # rotation of the camera for world coordinates.
    by_camera = np.zeros((len(points), 2, 3))
    by_camera[:, :, :2] = K[:2, :2] / safe[:, None, None]
    by_camera[:, :, 2] = -(inside[:, :2] / safe[:, None] ** 2) @ K[:2, :2].T
    return pixels, by_camera @ R, seen
