"""Bring parameters of SMPL, SMPL-H and SMPL-X to the open body without the files of these models.

Rotations and rest positions of the family's joints are published, shape directions are not. Without the model's file
the joint rotations are converted to the open body's rest pose, the pelvis is placed where SMPL's is, and the shape is
the mean shape. The result can start a registration or be retargeted, but it is not a fit.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body.layout import HAND_WIDTH
from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel
from smplxpp.body.param_layouts import Family
from smplxpp.body.retarget import FEET, Skeleton, planted
from smplxpp.body.smpl_joints import BODY_JOINTS, smpl_joint_regressor, smpl_offsets
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix

FAMILY_NAMES: dict[Family, str] = {"smpl": "SMPL", "smplh": "SMPL-H", "smplx": "SMPL-X"}
# Height of the pelvis above the origin in the rest pose of the mean body, metres; x and z are 0 and 2 to 3 cm.
_PELVIS: dict[Family, tuple[float, float, float]] = {
    "smpl": (0.0, -0.223, 0.028),
    "smplh": (0.0, -0.241, 0.029),
    "smplx": (0.003, -0.351, 0.012),
}
# Bones of SMPL's mean body in its rest pose, millimetres from the joint above; the left side, with x to the left.
_BONES_MM: dict[str, tuple[float, float, float]] = {
    "hip": (69, -91, -6),
    "knee": (34, -375, -4),
    "ankle": (-14, -398, -44),
    "foot": (26, -56, 119),
    "spine1": (0, 109, -27),
    "spine2": (0, 135, 1),
    "spine3": (0, 53, 25),
    "neck": (0, 214, -43),
    "head": (0, 65, 51),
    "collar": (79, 122, -34),
    "shoulder": (91, 30, -9),
    "elbow": (260, -13, -27),
    "wrist": (249, 9, -1),
}
# Rotation of a limb from the open body's rest pose to SMPL's: rotation vectors in degrees, world axes, left side (y and
# z change sign on the right). SMPL's legs are spread by 7 degrees more, its feet turned in.
_REST_TURNS: dict[str, tuple[float, float, float]] = {
    "hip": (3, 0, -7),
    "knee": (2, 0, -6),
    "ankle": (0, 4, 3),
    "foot": (0, 4, 3),
    "head": (-6, 0, 0),
}


def smpl_skeleton(family: Family = "smpl") -> Skeleton:
    """Return the joints of the mean body of a family at rest, 22 of them, as published, to a millimetre.

    Example:
        >>> round(float(smpl_skeleton().leg), 2)
        0.78
    """
    places = np.zeros((len(BODY_JOINTS), 3))
    parents = _parents()
    for j, name in enumerate(BODY_JOINTS):
        if not j:
            places[j] = _PELVIS[family]
            continue
        side, _, part = name.rpartition("_")
        bone = np.array(_BONES_MM[part]) / 1000.0
        places[j] = places[parents[j]] + (bone * [-1.0, 1.0, 1.0] if side == "right" else bone)
    return Skeleton(BODY_JOINTS, parents, places)


def from_smpl(params: BodyParams, family: Family, body: BodyModel) -> BodyParams:
    """Bring parameters of SMPL, SMPL-H or SMPL-X to the open body, without the model that they are of.

    With `A_j` the rotation from the open body's limb at rest to SMPL's, `R'_j = A_parent^T R_j A_j`, so that limbs have
    the directions of SMPL's. The translation puts the regressed SMPL pelvis of the open body where SMPL's pelvis is.
    Shape and expression are dropped, and PCA coefficients of hands, because the model's file holds their basis.

    Args:
        params: T frames of the family.
        family: whose they are.
        body: the open body, in any shape.

    Returns:
        T frames without betas and expressions.

    Raises:
        InputError: another body.
    """
    rest = body.v_template
    own, point = (body.joint_regressor @ rest)[0], (smpl_joint_regressor(body) @ rest)[0]
    pelvis = np.array(_PELVIS[family]) + params.transl
    return _placed(_turned(params), pelvis, own, point)


def retarget_smpl(params: BodyParams, family: Family, target: Skeleton) -> BodyParams:
    """Return a motion of SMPL, SMPL-H or SMPL-X for another skeleton with the open body's rest pose.

    Rotations are those of `from_smpl`. The path of SMPL's pelvis is scaled by the ratio of leg lengths, that of the
    target measured between SMPL's joints. Planted feet stay planted, as in `retarget`. The motion's shape is not known
    without its model, so that steps are scaled from those of the mean body.

    Args:
        params: T frames of the family.
        family: whose they are.
        target: skeleton to move, such as `Skeleton.of(body)` of the open body or of a template.
    """
    source = smpl_skeleton(family)
    like = Skeleton(BODY_JOINTS, source.parents, smpl_places(target))
    scale = like.leg / source.leg
    # Scale the pelvis' path about its first position on the floor.
    theirs = source.pose(params)
    pelvis, feet = theirs[:, 0], theirs[:, source.at(*FEET)]
    floor = float(feet[..., 1].min())
    start = pelvis[0] * [1.0, 0.0, 1.0] + [0.0, floor, 0.0]
    moved = _placed(_turned(params), start + scale * (pelvis - start), target.places[0], like.places[0])
    return planted(moved, scale * feet, target, floor)


def smpl_places(skeleton: Skeleton) -> Float64[np.ndarray, "22 3"]:
    """Return SMPL's joints at rest of a skeleton like the open body's, by `OFFSETS_MM` in the scale of its legs.

    Where there are vertices, `smpl_joint_regressor` gives them more exactly.
    """
    own = skeleton.places[skeleton.at(*BODY_JOINTS)]
    return own + smpl_offsets() * (skeleton.leg / _open_leg())


def rests_like_smpl(skeleton: Skeleton) -> bool:
    """Return whether a skeleton has SMPL's joints and rest pose: its hips are near each other.

    Their distance is .18 of a leg in the family's models and .26 in the open body. A skeleton without legs has not.
    """
    if not skeleton.has_legs:
        return False
    left, right = skeleton.places[skeleton.at("left_hip", "right_hip")]
    return bool(np.linalg.norm(left - right) < 0.21 * skeleton.leg)


def _turned(params: BodyParams) -> BodyParams:
    """Return joint rotations for the open body's rest pose, without shape and expression, before translation."""
    parents, count = _parents(), len(params)
    turns = matrix_from_rotvec(np.concatenate([params.global_orient, params.body_pose], 1).reshape(count, -1, 3))
    at_rest = rest_turns()
    out = np.empty_like(turns)
    for j in range(len(BODY_JOINTS)):
        above = at_rest[parents[j]] if j else np.eye(3)
        out[:, j] = above.T @ turns[:, j] @ at_rest[j]
    vectors = rotvec_from_matrix(out).reshape(count, -1)
    hands = {name: getattr(params, name) for name in ("left_hand_pose", "right_hand_pose")}
    if any(values.shape[1] != HAND_WIDTH for values in hands.values()):
        hands = {name: np.zeros((count, HAND_WIDTH)) for name in hands}
    return replace(
        params.without_shape(),
        global_orient=vectors[:, :3],
        body_pose=vectors[:, 3:],
        expression=np.zeros((count, 0)),
        flat_hand_mean=True,
        **hands,
    )


def _placed(
    params: BodyParams,
    pelvis: Float64[np.ndarray, "T 3"],
    own: Float64[np.ndarray, " 3"],
    point: Float64[np.ndarray, " 3"],
) -> BodyParams:
    """Choose translations that put the regressed SMPL pelvis at `pelvis`; it rotates about the body's own pelvis."""
    turned = (matrix_from_rotvec(params.global_orient) @ (point - own)[:, None])[..., 0]
    return replace(params, transl=pelvis - own - turned)


def rest_turns() -> Float64[np.ndarray, "22 3 3"]:
    """Return the rotation of each limb from the open body's rest pose to SMPL's, in world axes."""
    vectors = np.zeros((len(BODY_JOINTS), 3))
    for j, name in enumerate(BODY_JOINTS):
        side, _, part = name.rpartition("_")
        turn = np.radians(_REST_TURNS.get(part, (0.0, 0.0, 0.0)))
        vectors[j] = turn * [1.0, -1.0, -1.0] if side == "right" else turn
    return matrix_from_rotvec(vectors)


def _parents() -> Int64[np.ndarray, " 22"]:
    return np.asarray(load_body().parents[: len(BODY_JOINTS)])


@lru_cache(maxsize=1)
def _open_leg() -> float:
    return Skeleton.of(load_body()).leg
