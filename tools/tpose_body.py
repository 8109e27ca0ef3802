"""Bring the kept part of the base mesh into the T-pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, Int16

from tools.anny_base import BODY_VERTEX_COUNT, BaseMesh

# OBJ groups kept, with the name of each in `vertex_label_names`.
KEPT_GROUPS = {
    "body": "body",
    "helper-l-eye": "left_eye",
    "helper-r-eye": "right_eye",
    "helper-upper-teeth": "upper_teeth",
    "helper-lower-teeth": "lower_teeth",
    "helper-tongue": "tongue",
}


@dataclass(frozen=True, eq=False)
class TPoseBody:
    """The kept part of the base mesh in the T-pose, at the precision that is stored.

    Attributes:
        full_index: which of the base mesh's vertices are kept.
        directions: shape directions, then those of the expressions.
        labels: indices into the values of `KEPT_GROUPS`.
    """

    full_index: Int[np.ndarray, " V"]
    vertices: Float32[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    uvs: Float[np.ndarray, "T 2"]
    face_uvs: Int[np.ndarray, "F 3"]
    directions: Float32[np.ndarray, "V 3 D"]
    weights: Float32[np.ndarray, "V 55"]
    labels: Int16[np.ndarray, " V"]
    joints: Float[np.ndarray, "55 3"]
    joint_shape_dirs: Float[np.ndarray, "55 3 K"]


def reduce_to_body(base: BaseMesh) -> TPoseBody:
    """Drop the helpers, bake the T-pose, round to what the file stores."""
    faces_kept = np.isin(base.face_group, list(KEPT_GROUPS))
    faces, face_uvs = base.faces[faces_kept], base.face_uvs[faces_kept]
    kept = np.union1d(np.arange(BODY_VERTEX_COUNT), faces)
    kept_uvs = np.unique(face_uvs)
    directions = np.concatenate([base.tpose_shape_dirs(), base.tpose_expression_dirs()], axis=-1)[kept]
    weights = np.round(base.weights[kept], 5)
    labels = np.zeros(len(kept), dtype=np.int16)
    for label, group in enumerate(KEPT_GROUPS):
        labels[base.vertex_group[kept] == group] = label
    columns = [base.tpose_joints(base.joint_shape_dirs[..., k]) for k in range(base.shape_dirs.shape[-1])]
    return TPoseBody(
        full_index=kept,
        vertices=base.tpose_vertices(base.vertices, base.joints)[kept].astype(np.float32),
        faces=np.searchsorted(kept, faces),
        uvs=base.uvs[kept_uvs],
        face_uvs=np.searchsorted(kept_uvs, face_uvs),
        # float16 values in float32 arrays: they compress to half and load without a cast.
        directions=directions.astype(np.float16).astype(np.float32),
        weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        labels=labels,
        joints=base.tpose_joints(base.joints),
        joint_shape_dirs=np.stack(columns, axis=-1),
    )
