"""Keypoints of all cameras as residuals in pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core.camera import Camera
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.landmarks import LandmarkModel
from smplxpp.register.normal_equations import NormalEquations

# Beyond this many deviations a keypoint counts less and less (Geman and McClure).
_CUTOFF = 3.0
NEAREST = 0.05
"""Metres before a camera: points nearer, or behind it, are not seen."""


class KeypointTerm:
    """`sum_ck w |project_c(x_k) - u_ck|^2 / s_c^2`, robust.

    Args:
        keypoints: by camera, all with the frames of the registration and the names of `landmarks`, in order; what is
            not there or not believed has confidence 0.
        noise_px: standard deviation of each camera's keypoints.
    """

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
        self.carried, self.mixing = carried_points(body, landmarks)
        self.scale = 1.0

    def used(self, row: int) -> bool:
        """Whether a frame has any keypoint."""
        return bool((self.confidence[:, row] > 0).any())

    def add(
        self, equations: NormalEquations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool
    ) -> None:
        """Add the keypoints of a frame."""
        if not self.used(row):
            return
        motion = kinematics.motion(self.carried, posture)
        points = self.mixing @ motion.points
        information, vector = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for k, camera in enumerate(self.cameras):
            residual, jacobian, seen = projected(camera, points)
            residual = residual - self.points[k, row]
            scale = self.noise[k] * self.scale
            squared = (residual**2).sum(axis=1) / (_CUTOFF * scale) ** 2
            weight = seen * self.confidence[k, row] / (scale**2 * (1.0 + squared) ** 2)
            information += np.einsum("n,nax,nay->nxy", weight, jacobian, jacobian)
            vector += np.einsum("n,nax,na->nx", weight, jacobian, residual)
        kept = np.flatnonzero(np.einsum("nxx->n", information) > 0)
        # Root of the information: three rows a landmark stand for all cameras.
        values, axes = np.linalg.eigh(information[kept])
        values = np.maximum(values, 1e-12 * values[:, -1:])
        root = np.sqrt(values)[:, :, None] * axes.transpose(0, 2, 1)
        target = (axes.transpose(0, 2, 1) @ vector[kept, :, None])[..., 0] / np.sqrt(values)
        rows = root @ self._mixed(equations.columns.jacobian(motion))[kept]
        equations.add(row, rows.reshape(-1, rows.shape[-1]), target.reshape(-1), shape=shape)

    def residual_px(self, row: int, kinematics: Kinematics, posture: Posture) -> float:
        """The median distance of a frame's keypoints, pixels; NaN without any."""
        points = self.mixing @ kinematics.points(self.carried, posture)
        found = []
        for k, camera in enumerate(self.cameras):
            there, _, seen = projected(camera, points)
            use = seen & (self.confidence[k, row] > 0)
            found.append(np.linalg.norm(there - self.points[k, row], axis=1)[use])
        every = np.concatenate(found)
        return float(np.median(every)) if len(every) else float("nan")

    def _mixed(self, jacobian: Float64[np.ndarray, "N 3 P"]) -> Float64[np.ndarray, "K 3 P"]:
        flat = self.mixing @ jacobian.reshape(len(jacobian), -1)
        return np.asarray(flat).reshape(-1, *jacobian.shape[1:])


def carried_points(body: BodyModel, landmarks: LandmarkModel) -> tuple[BodyPoints, sp.csr_matrix]:
    """The vertices and joints that landmarks are made of, and the matrix (K, N) that makes them."""
    joints = np.flatnonzero(landmarks.joint_index >= 0)
    made = np.flatnonzero(landmarks.joint_index < 0)
    used, place = np.unique(landmarks.vertex_index[made], return_inverse=True)
    parts = [
        BodyPoints.of_vertices(body, used),
        BodyPoints.of_joints(body, landmarks.joint_index[joints]),
    ]
    columns = np.concatenate([place.reshape(-1), len(used) + np.arange(len(joints))])
    rows = np.concatenate([np.repeat(made, landmarks.vertex_index.shape[1]), joints])
    values = np.concatenate([landmarks.vertex_weight[made].reshape(-1), np.ones(len(joints))])
    shape = (len(landmarks.names), len(used) + len(joints))
    return BodyPoints.joined(parts), sp.csr_matrix((values, (rows, columns)), shape=shape)


def projected(
    camera: Camera, points: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, "N 2 3"], np.ndarray]:
    """Pixels of points, their derivatives by the points, and which lie before the camera."""
    R, K = camera.cam_from_world[:3, :3], camera.K
    inside = points @ R.T + camera.cam_from_world[:3, 3]
    depth = inside[:, 2]
    seen = depth > NEAREST
    safe = np.where(seen, depth, 1.0)
    pixels = inside[:, :2] / safe[:, None] @ K[:2, :2].T + K[:2, 2]
    by_camera = np.zeros((len(points), 2, 3))
    by_camera[:, :, :2] = K[:2, :2] / safe[:, None, None]
    by_camera[:, :, 2] = -(inside[:, :2] / safe[:, None] ** 2) @ K[:2, :2].T
    return pixels, by_camera @ R, seen


def of_frames(
    keypoints: Mapping[str, Keypoints2D], names: Sequence[str], frames: Sequence[int]
) -> dict[str, Keypoints2D]:
    """Every camera's keypoints with these names and frames."""
    return {camera: found.select(names, frames) for camera, found in keypoints.items()}
