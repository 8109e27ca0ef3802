"""A person who turns before one camera: poses, photographs' masks and keypoints of the open body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, Camera, Keypoints2D, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.raster import rasterize_mesh
from smplxpp.register.landmarks import LandmarkModel

CAMERA = "cam"
NAMES = tuple(
    f"{side}_{joint}"
    for side in ("left", "right")
    for joint in ("hip", "knee", "ankle", "foot", "shoulder", "elbow", "wrist", "collar")
) + ("pelvis", "neck", "head", "nose", "spine2")
# Axis-angle of the held pose, degrees: arms away from the body, a bent elbow, feet apart.
HELD = {
    "left_shoulder": (0, -10, -48),
    "right_shoulder": (0, 6, 40),
    "left_elbow": (0, -25, 0),
    "left_hip": (0, 0, 6),
    "right_hip": (0, 0, -6),
}


@dataclass(frozen=True, eq=False)
class Turn:
    """A turn with what a camera at known distance sees of it.

    Attributes:
        params: a row a frame; the person stands on y = 0.
        camera: true camera.
        keypoints: of the camera, with noise.
        masks: of the naked body, 255 inside.
        stature: height of the person, metres.
    """

    params: BodyParams
    camera: Camera
    keypoints: Keypoints2D
    masks: list[np.ndarray]
    stature: float

    def level_camera(self, focal: float = 1.0) -> Camera:
        """Return a camera at the origin that looks along -z, whose focal length is wrong by a factor."""
        K = self.camera.K.copy()
        K[:2, :2] *= focal
        return Camera(K, np.diag([1.0, -1.0, -1.0, 1.0]), self.camera.width, self.camera.height, name=CAMERA)


def turned_person(body: BodyModel, frames: int, *, sway: float = 4.0, sense: int = 1, height: int = 400) -> Turn:
    """Turn a person once before a camera that looks down by some degrees; limbs sway by `sway` degrees."""
    rng = np.random.default_rng(5)
    names = list(body.joint_names)
    pose = np.zeros((frames, len(names), 3))
    for name, angles in HELD.items():
        pose[:, names.index(name)] = np.radians(angles)
    for name in ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "head"):
        pose[:, names.index(name)] += np.radians(rng.normal(0, sway, (frames, 3)))
    turn = np.zeros((frames, 3))
    turn[:, 1] = sense * 2 * np.pi * np.arange(frames) / frames
    lean = np.radians([4.0, 0.0, 0.0])
    pose[:, 0] = rotvec_from_matrix(matrix_from_rotvec(turn) @ matrix_from_rotvec(lean))
    betas = np.zeros((frames, body.num_betas))
    betas[:, :4] = [0.8, -0.6, 0.5, 0.4]
    params = BodyParams.from_full_pose(
        pose,
        betas=betas,
        expression=np.zeros((frames, body.num_expressions)),
        transl=rng.normal(0, 0.03, (frames, 3)) * [1, 0, 1],
        fps=None,
    )
    posed = body.forward(params)
    transl = params.transl.copy()
    transl[:, 1] -= posed.vertices[:, :, 1].min(axis=1)
    params = BodyParams.from_full_pose(pose, betas=betas, expression=params.expression, transl=transl, fps=None)
    posed = body.forward(params)
    camera = Camera.look_at(
        eye=np.array([0.1, 1.5, 3.2]),
        target=np.array([0.0, 0.85, 0.0]),
        fov_y_deg=42.0,
        width=int(0.75 * height),
        height=height,
    )
    landmarks = LandmarkModel.of(body, NAMES)
    points = np.stack(
        [
            camera.screen_from_world(landmarks.points(v, j))[:, :2]
            for v, j in zip(posed.vertices, posed.joints, strict=True)
        ]
    )
    keypoints = Keypoints2D(
        landmarks.names,
        np.arange(frames),
        points + rng.normal(0, 0.7, points.shape),
        np.ones(points.shape[:2]),
    )
    masks = [255 * rasterize_mesh(body.mesh(v), camera).mask.astype(np.uint8) for v in posed.vertices]
    rest = body.v_template + body.shapedirs @ betas[0]
    return Turn(params, camera, keypoints, masks, float(np.ptp(rest[:, 1])))
