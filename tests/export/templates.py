"""Templates to export: small random ones, and the open body alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from smplxpp.body import load_body
from smplxpp.core import BodyParams, SkinWeights
from smplxpp.template.template import Template
from tests.template.bodies import small_body


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
    exprdirs = rng.normal(scale=0.05, size=(body, 3, expressions))
    exprdirs[10:, :, :1] = 0  # the first moves a few vertices,
    exprdirs[:, :, 1:2] = 0  # the second none, the third all
    vertices = rng.normal(size=(count, 3))
    vertex_colors = rng.integers(0, 256, (count, 3))
    shapedirs = rng.normal(scale=0.01, size=(body, 3, 2))
    posedirs = rng.normal(scale=0.01, size=(body, 3, 9 * (joint_count - 1))) if pose_correctives else None
    hand_means = rng.normal(scale=0.2, size=(2, 45))
    return Template(
        vertices=vertices,
        faces=np.concatenate(faces),
        vertex_labels=np.repeat([0, 3, 2, 2], sizes),
        vertex_part=np.repeat(np.arange(4), sizes),
        part_names=("body", "upper", "shoes", "empty"),
        vertex_colors=vertex_colors,
        weights=SkinWeights.from_dense(weights, max_influences=influences),
        body=small_body(
            joint_regressor=regressor / regressor.sum(axis=1, keepdims=True),
            parents=(np.arange(joint_count) - 1) // 2,
            joint_names=tuple(f"joint{j}" for j in range(joint_count)),
            shapedirs=shapedirs,
            exprdirs=exprdirs,
            posedirs=posedirs,
            hand_means=hand_means,
        ),
        betas=np.zeros(2),
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
        body=body,
        betas=np.zeros(body.num_betas),
        body_index=np.arange(count),
        scan_index=np.full(count, -1),
    )


def with_part(template: Template, name: str, label: int, faces: np.ndarray, offset: float) -> Template:
    """The template with faces of its body once more, a part of their own so far off the skin, with its weights."""
    used, local = np.unique(faces, return_inverse=True)
    count = template.vertex_count
    per_vertex = ("joint_indices", "joint_weights", "matched", "distance", "angle", "component")
    weights = {key: getattr(template.weights, key) for key in per_vertex}
    moved = template.vertices[used] + offset * template.mesh.vertex_normals[used]
    return replace(
        template,
        vertices=np.concatenate([template.vertices, moved]),
        faces=np.concatenate([template.faces, local.reshape(-1, 3) + count]),
        vertex_labels=np.concatenate([template.vertex_labels, np.full(len(used), label)]),
        vertex_part=np.concatenate([template.vertex_part, np.full(len(used), len(template.part_names))]),
        part_names=(*template.part_names, name),
        vertex_colors=np.concatenate([template.vertex_colors, template.vertex_colors[used]]),
        weights=replace(template.weights, **{key: np.concatenate([x, x[used]]) for key, x in weights.items()}),
        body_index=np.concatenate([template.body_index, used]),
        scan_index=np.concatenate([template.scan_index, np.full(len(used), -1)]),
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
