"""What the names of keypoints are on a body: joints, and weighted means of a few vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from smplxpp.body import BodyModel

# A regressor of hundreds of vertices is taken at its heaviest ones: within 0.2 mm in any pose and shape.
_MOST_VERTICES = 64
# A finger's tip is the mean of the vertices that lie farthest along its last bone.
_TIP_VERTICES = 4
_TIP_SHARE = 0.5
# What stands for a point on a body whose file does not say where it is.
_INSTEAD = {"nose": "face_30", "left_eye": "left_eye_smplhf", "right_eye": "right_eye_smplhf"}

_Mean = tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]


@dataclass(frozen=True, eq=False)
class LandmarkModel:
    """K points on a posed body: point k is joint `joint_index[k]`, or, where that is -1, the mean of the vertices
    `vertex_index[k]` with the weights `vertex_weight[k]`.

    Attributes:
        names: those that are known, in the order in which they were asked for.
        unknown: those that this body does not have.
        vertex_index: padded with 0. vertex_weight: rows sum to 1, padded with 0; rows of joints are 0.
        joint_index: -1 where a point is made of vertices.
    """

    names: tuple[str, ...]
    unknown: tuple[str, ...]
    vertex_index: Int64[np.ndarray, "K M"]
    vertex_weight: Float64[np.ndarray, "K M"]
    joint_index: Int64[np.ndarray, " K"]

    @staticmethod
    def of(body: BodyModel, names: Sequence[str]) -> LandmarkModel:
        """Find the named points on a body.

        Joints by their names; `coco_*`, nose, eyes, ears, toes, heels and `face_*` by the body's own landmarks; without
        these, `coco_left_hip` and the like are the joints of that name (some centimetres away at hips and shoulders),
        the nose is `face_30`, eyes are their joints. Fingers' tips come from weights and shape.
        """
        joints = {name: k for k, name in enumerate(body.joint_names)}
        known, rows = [], []
        for name in names:
            found = _place(body, joints, name)
            if found is not None:
                known.append(name)
                rows.append(found)
        width = max((len(found[0]) for found in rows if not isinstance(found, int)), default=0)
        index, weight = np.zeros((len(rows), width), dtype=np.int64), np.zeros((len(rows), width))
        joint_index = np.full(len(rows), -1, dtype=np.int64)
        for k, found in enumerate(rows):
            if isinstance(found, int):
                joint_index[k] = found
            else:
                index[k, : len(found[0])], weight[k, : len(found[0])] = found
        unknown = tuple(name for name in names if name not in known)
        return LandmarkModel(tuple(known), unknown, index, weight, joint_index)

    def points(
        self, vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
    ) -> Float64[np.ndarray, "K 3"]:
        """The points of a posed body.

        Args:
            vertices, joints: of one frame, world, metres.
        """
        means = np.einsum("km,kmx->kx", self.vertex_weight, np.asarray(vertices, dtype=np.float64)[self.vertex_index])
        return np.where((self.joint_index >= 0)[:, None], np.asarray(joints)[self.joint_index], means)


def _place(body: BodyModel, joints: dict[str, int], name: str) -> int | _Mean | None:
    if name in joints:
        return joints[name]
    if name in body.landmarks:
        return _lightened(body, *body.landmarks[name])
    if name.endswith("_tip"):
        return _fingertip(body, joints.get(f"{name.removesuffix('_tip')}3"))
    instead = _INSTEAD.get(name, name.removeprefix("coco_"))
    return None if instead == name else _place(body, joints, instead)


def _lightened(body: BodyModel, index: Int64[np.ndarray, " n"], weight: Float64[np.ndarray, " n"]) -> _Mean:
    """The heaviest vertices alone, weights changed in proportion to their size so that the mean on the mean shape stays
    (least squares in the metric of the weights)."""
    if len(index) <= _MOST_VERTICES:
        return index, weight
    heavy = np.sort(np.argsort(-weight, kind="stable")[:_MOST_VERTICES])
    points, kept = body.v_template[index[heavy]], weight[heavy]
    A = np.concatenate([np.ones((1, len(heavy))), points.T])
    target = np.concatenate([[1.0], weight @ body.v_template[index]])
    scaled = A * kept
    kept = kept + scaled.T @ np.linalg.lstsq(scaled @ A.T, target - A @ kept, rcond=None)[0]
    return index[heavy], kept / kept.sum()


def _fingertip(body: BodyModel, joint: int | None) -> _Mean | None:
    """The far end of a finger's last joint, on the mean shape."""
    if joint is None:
        return None
    rest = body.joint_regressor[[joint, body.parents[joint]]] @ body.v_template
    own = np.flatnonzero(body.weights[:, joint] > _TIP_SHARE)
    if not len(own):
        return None
    along = (body.v_template[own] - rest[0]) @ (rest[0] - rest[1])
    far = np.sort(own[np.argsort(-along, kind="stable")[:_TIP_VERTICES]])
    return far.astype(np.int64), np.full(len(far), 1.0 / len(far))
