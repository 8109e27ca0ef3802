"""Regress SMPL's joints from the open body's vertices, and make an open body that rotates about them.

The open body's joints come from its rig, SMPL's from training: SMPL's hips are 12 to 14 cm apart, the open body's 23.
Joint errors against SMPL fits, and rotations of SMPL's joints, refer to SMPL's positions. `OFFSETS_MM` is the distance
of these from the open body's own joints; docs/inputs.md has the table and how it was measured.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.model import BodyModel
from smplxpp.core import BodyParams, InputError

BODY_JOINTS: tuple[str, ...] = SMPLX_JOINTS[:22]
"""The joints that SMPL, SMPL-H and SMPL-X share: those of the body without fingers and face."""
OFFSETS_MM: dict[str, tuple[float, float, float]] = {
    "pelvis": (0, -40, 10),
    "hip": (-50, -45, -20),
    "knee": (5, 5, -5),
    "ankle": (-10, 0, 10),
    "foot": (20, -10, 0),
    "spine1": (0, 35, -25),
    "spine2": (0, 100, 5),
    "spine3": (0, 80, 25),
    "neck": (0, 20, 0),
    "head": (0, -30, 15),
    "collar": (60, -40, -45),
    "shoulder": (20, -25, 0),
    "elbow": (10, -10, -10),
    "wrist": (-5, 5, 0),
}
"""SMPL's joint less the open body's own, millimetres of the mean body in the T-pose: x to the left, y up, z forward. Of
joints with two sides the left one's; x of the right one has the other sign."""
_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head", "left_collar", "right_collar")


def is_open_body(body: BodyModel) -> bool:
    """Return whether a body is the open body, in any shape: of its vertices and joints, without PCA of hands."""
    counts = (body.vertex_count, body.joint_count)
    open_vertices = 13_886
    return counts == (open_vertices, len(SMPLX_JOINTS)) and body.left_hand_components is None


def smpl_offsets() -> Float64[np.ndarray, "22 3"]:
    """Return `OFFSETS_MM` of all joints, metres."""
    out = np.zeros((len(BODY_JOINTS), 3))
    for j, name in enumerate(BODY_JOINTS):
        side, _, part = name.rpartition("_")
        out[j] = np.array(OFFSETS_MM[part]) / 1000.0 * ([-1.0, 1.0, 1.0] if side == "right" else [1.0, 1.0, 1.0])
    return out


def smpl_joint_regressor(body: BodyModel) -> Float64[np.ndarray, "22 V"]:
    """Return the rows that give SMPL's joints of the open body's shaped vertices in the rest pose.

    A row has weights `w` of least `|w|^2` on the skin around the joint, a band across the limb or the trunk of 6 cm,
    that sum to 1 and reproduce the joint of the mean body: `w = C^T (C C^T)^-1 (place, 1)` with the vertices'
    coordinates and ones as the rows of C. A change of shape moves the joint with the band.

    Args:
        body: the open body.

    Raises:
        InputError: another body, which has joints of its own.

    Example:
        >>> rows = smpl_joint_regressor(smplxpp.load_body())
        >>> hips = (rows @ smplxpp.load_body().v_template)[1:3]
        >>> bool(0.11 < hips[0, 0] - hips[1, 0] < 0.14)
        True
    """
    if not is_open_body(body):
        raise InputError(
            f"body {body.name!r}",
            expected="the open body, whose joints are not SMPL's",
            received=f"{body.vertex_count} vertices, {body.joint_count} joints",
            remedy="joints of a model of the SMPL family are SMPL's already",
        )
    return _regressor()


@lru_cache(maxsize=1)
def _regressor() -> Float64[np.ndarray, "22 V"]:
    from smplxpp.body.loader import load_body

    # The mean body decides, so that templates, whose mean shape is a person's, share the weights.
    body = load_body()
    # Before tongue, eyes and teeth.
    skin_vertices = 13_380
    vertices, weights = body.v_template[:skin_vertices], body.weights[:skin_vertices]
    own = (body.joint_regressor @ body.v_template)[: len(BODY_JOINTS)]
    trunk = weights[:, [body.joint_names.index(name) for name in _TRUNK]].sum(axis=1)
    rows, offsets = np.zeros((len(BODY_JOINTS), body.vertex_count)), smpl_offsets()
    half_width, least_weight = 0.03, 0.3  # metres; share of a vertex that follows the limb
    for j, name in enumerate(BODY_JOINTS):
        place, parent = own[j] + offsets[j], int(body.parents[j])
        # Bands across the trunk are level; those across a limb are perpendicular to its bone.
        if name in _TRUNK:
            axis, of_part = np.array([0.0, 1.0, 0.0]), trunk
        else:
            axis = own[j] - own[parent]
            axis, of_part = axis / np.linalg.norm(axis), weights[:, j] + weights[:, parent]
        band = np.flatnonzero((of_part > least_weight) & (np.abs((vertices - place) @ axis) < half_width))
        if name.endswith("hip"):  # a level band of its own half, because the pelvis belongs to both legs
            level = np.abs(vertices[:, 1] - place[1]) < half_width
            band = np.flatnonzero(level & (of_part > least_weight) & (vertices[:, 0] * own[j, 0] > 0.0))
        conditions = np.vstack([vertices[band].T, np.ones(len(band))])
        rows[j, band] = np.linalg.lstsq(conditions, np.append(place, 1.0), rcond=None)[0]
    rows.setflags(write=False)
    return rows


def smpl_joints(body: BodyModel, params: BodyParams) -> Float64[np.ndarray, "T 22 3"]:
    """Return SMPL's joints of the posed open body, metres; a joint is rigid with the bone above it, as SMPL's is.

    For comparing with joints of SMPL, SMPL-H and SMPL-X fits; `forward(params).joints` are the open body's own.

    Raises:
        InputError: another body.

    Example:
        >>> smpl_joints(smplxpp.load_body(), smplxpp.BodyParams.rest()).shape
        (1, 22, 3)
    """
    posed = body.forward(params)
    rest = smpl_joint_regressor(body) @ posed.rest_vertices
    above = [max(int(body.parents[j]), 0) for j in range(len(BODY_JOINTS))]
    moved = posed.posed_from_rest[:, above]
    return np.einsum("tjab,tjb->tja", moved[..., :3, :3], rest) + moved[..., :3, 3]


def with_smpl_joints(body: BodyModel) -> BodyModel:
    """Replace the 22 body joints of the open body by SMPL's, so that it rotates about SMPL's positions.

    Rest surface, skin weights, fingers and face stay. Parameters of the open body are not its parameters.

    Raises:
        InputError: another body.
    """
    regressor = body.joint_regressor.copy()
    regressor[: len(BODY_JOINTS)] = smpl_joint_regressor(body)
    return replace(body, name=f"{body.name}_smpl_joints", joint_regressor=regressor)
