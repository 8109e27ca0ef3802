"""Templates to export: small random ones, and the open body alone."""

from __future__ import annotations

import numpy as np

from smplxpp.body import load_body
from smplxpp.core.params import BodyParams
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.template.template import Template


def random_template(
    *, joint_count: int = 24, expressions: int = 3, influences: int = 8, pose_correctives: bool = False
) -> Template:
    """A body of 40 vertices with an upper garment, shoes and a part without faces; every number random but fixed."""
    rng = np.random.default_rng(joint_count + 100 * expressions)
    body, sizes = 40, (40, 12, 9, 2)
    count = sum(sizes)
    weights = rng.uniform(0, 1, (count, joint_count)) ** 4
    weights[sizes[0] :: 3, 2:] = 0  # some vertices of the parts follow one or two joints alone
    regressor = rng.uniform(0, 1, (joint_count, body)) ** 8
    faces = [_faces(rng, size, start) for size, start in zip(sizes[:3], (0, 40, 52), strict=True)]
    expression_basis = rng.normal(scale=0.05, size=(body, 3, expressions))
    expression_basis[10:, :, :1] = 0  # the first moves a few vertices,
    expression_basis[:, :, 1:2] = 0  # the second none, the third all
    return Template(
        vertices=rng.normal(size=(count, 3)),
        faces=np.concatenate(faces),
        vertex_labels=np.repeat([0, 3, 2, 2], sizes),
        vertex_part=np.repeat(np.arange(4), sizes),
        part_names=("body", "upper", "shoes", "empty"),
        vertex_colors=rng.integers(0, 256, (count, 3)),
        weights=SkinWeights.from_dense(weights, max_influences=influences),
        joint_regressor=regressor / regressor.sum(axis=1, keepdims=True),
        parents=(np.arange(joint_count) - 1) // 2,
        joint_names=tuple(f"joint{j}" for j in range(joint_count)),
        betas=np.zeros(2),
        shape_basis=rng.normal(scale=0.01, size=(body, 3, 2)),
        expression_basis=expression_basis,
        pose_basis=rng.normal(scale=0.01, size=(body, 3, 9 * (joint_count - 1))) if pose_correctives else None,
        left_hand_components=None,
        right_hand_components=None,
        left_hand_mean=rng.normal(scale=0.2, size=45),
        right_hand_mean=rng.normal(scale=0.2, size=45),
        body_labels=np.zeros(body),
        body_label_names=("all",),
        body_index=np.concatenate([np.arange(body), rng.integers(0, body, count - body)]),
        scan_index=np.full(count, -1),
    )


def open_body_template() -> Template:
    """The embedded body without clothes."""
    body = load_body()
    count = body.vertex_count
    rng = np.random.default_rng(0)
    return Template(
        vertices=body.v_template,
        faces=body.faces,
        vertex_labels=np.zeros(count),
        vertex_part=np.zeros(count),
        part_names=("body",),
        vertex_colors=rng.integers(0, 256, (count, 3)),
        weights=SkinWeights.from_dense(body.weights),
        joint_regressor=body.joint_regressor,
        parents=body.parents,
        joint_names=body.joint_names,
        betas=np.zeros(body.num_betas),
        shape_basis=body.shapedirs,
        expression_basis=body.exprdirs,
        pose_basis=body.posedirs,
        left_hand_components=body.left_hand_components,
        right_hand_components=body.right_hand_components,
        left_hand_mean=body.left_hand_mean,
        right_hand_mean=body.right_hand_mean,
        body_labels=body.part_labels,
        body_label_names=body.part_label_names,
        body_index=np.arange(count),
        scan_index=np.full(count, -1),
    )


def random_motion(frames: int, *, expressions: int, fps: float | None = None, seed: int = 0) -> BodyParams:
    """Every joint turned, the face moving, the body walking about."""
    rng = np.random.default_rng(seed)
    return BodyParams.from_full_pose(
        rng.normal(scale=0.4, size=(frames, 55, 3)),
        betas=np.zeros((frames, 2)),
        expression=rng.uniform(0, 1, (frames, expressions)),
        transl=rng.normal(size=(frames, 3)),
        fps=fps,
    )


def _faces(rng: np.random.Generator, count: int, start: int) -> np.ndarray:
    """Triangles of three distinct vertices, each vertex in one at least."""
    order = np.concatenate([rng.permutation(count) for _ in range(3)])
    faces = order[: 3 * (len(order) // 3)].reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return faces[distinct] + start
