"""A body in a few poses, seen by a ring of cameras: what registrations are tested on."""

from __future__ import annotations

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, Camera, Keypoints2D, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.raster import rasterize_mesh

JOINTS = 55


def moving(body: BodyModel, frames: int, seed: int = 0) -> BodyParams:
    """A person who waves smoothly; arms lowered, a shape of her own."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)[:, None, None]
    swing = rng.normal(0, 0.12, (1, JOINTS, 3)) * np.sin(2 * np.pi * (time + rng.uniform(0, 1, (1, JOINTS, 1))))
    swing[:, 22:] *= 0.3
    swing[:, 22] = 0  # the jaw, which keypoints of joints do not show
    names = list(body.joint_names)
    swing[:, names.index("left_shoulder"), 2] -= 0.9
    swing[:, names.index("right_shoulder"), 2] += 0.9
    return BodyParams.from_full_pose(
        swing,
        betas=rng.normal(0, 0.8, (1, body.num_betas)),
        expression=np.zeros((1, body.num_expressions)),
        transl=np.array([0.1, 0.05, -0.2]) + 0.1 * time[:, 0] * np.array([1.0, 0.0, 0.3]),
        fps=20.0,
    )


def disturbed(params: BodyParams, *, degrees: float, metres: float, betas: float, seed: int = 1) -> BodyParams:
    """The parameters with errors of these standard deviations."""
    rng = np.random.default_rng(seed)
    turns = matrix_from_rotvec(rng.normal(0, np.radians(degrees), params.full_pose.shape))
    return BodyParams.from_full_pose(
        rotvec_from_matrix(turns @ matrix_from_rotvec(params.full_pose)),
        betas=params.betas[:1] + rng.normal(0, betas, (1, params.betas.shape[1])),
        expression=params.expression,
        transl=params.transl + rng.normal(0, metres, params.transl.shape),
        fps=params.fps,
    )


def ring(count: int, *, height: int = 480) -> dict[str, Camera]:
    """Cameras around the person, all of her in each."""
    out = {}
    for k in range(count):
        angle = 2 * np.pi * k / count
        eye = np.array([3.0 * np.sin(angle), 0.9 + 0.3 * (k % 2), 3.0 * np.cos(angle)])
        camera = Camera.look_at(eye=eye, target=np.array([0.0, 0.0, 0.0]), fov_y_deg=46.0, width=height, height=height)
        out[f"C{k}"] = Camera(camera.K, camera.cam_from_world, height, height, name=f"C{k}")
    return out


def keypoints(
    body: BodyModel, params: BodyParams, cameras: dict[str, Camera], *, px: float = 0.0, seed: int = 2
) -> dict[str, Keypoints2D]:
    """All joints through all cameras, with noise."""
    rng, joints = np.random.default_rng(seed), body.forward(params).joints
    out = {}
    for name, camera in cameras.items():
        points = np.stack([camera.screen_from_world(frame)[:, :2] for frame in joints])
        points += rng.normal(0, px, points.shape) if px else 0.0
        out[name] = Keypoints2D(
            tuple(body.joint_names), np.arange(len(params)), points, np.ones((len(params), body.joint_count))
        )
    return out


def masks(body: BodyModel, params: BodyParams, cameras: dict[str, Camera]) -> dict[tuple[str, int], np.ndarray]:
    """The naked body's opacity in every view, antialiased four by four."""
    vertices = body.forward(params).vertices
    out = {}
    for name, camera in cameras.items():
        fine = camera.resized(4 * camera.width, 4 * camera.height)
        for frame, points in enumerate(vertices):
            hit = rasterize_mesh(body.mesh(points), fine).mask.astype(np.float32)
            share = hit.reshape(camera.height, 4, camera.width, 4).mean(axis=(1, 3))
            out[name, frame] = np.round(255 * share).astype(np.uint8)
    return out


def vertex_error_mm(body: BodyModel, fitted: BodyParams, true: BodyParams) -> float:
    """Mean distance of the body's vertices, millimetres."""
    return float(1e3 * np.linalg.norm(body.forward(fitted).vertices - body.forward(true).vertices, axis=2).mean())
