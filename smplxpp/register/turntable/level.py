"""Move a registered turn to a world that stands on its floor, and say what one camera left open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, Camera, matrix_from_rotvec
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.turntable.fit import TurntableFit


def leveled(found: TurntableFit, body: BodyModel) -> tuple[BodyParams, Camera]:
    """Return poses and camera in a world with +Y up, the floor at y = 0 and the person about the vertical axis.

    The floor is the median over frames of the lowest point of the body.

    Args:
        found: a registered turn.
        body: the model of its poses.

    Example:
        >>> params, camera = leveled(register_turntable(body, observed), body)  # doctest: +SKIP
    """
    state = BodyState.of_params(body, found.fit.params)
    kinematics = Kinematics(body)
    root = int(np.flatnonzero(body.parents < 0)[0])
    # Rotate the vertical to +Y, about the root of each frame: x' = R x + d moves the pelvis p to R p + d.
    turn = _between(found.up, np.array([0.0, 1.0, 0.0]))
    rest = kinematics.rest_joints[root] + kinematics.joint_dirs[root] @ state.betas
    pelvis = (state.transl + rest) @ turn.T
    rotations = state.rotations.copy()
    rotations[:, root] = turn @ rotations[:, root]
    moved = replace(state, rotations=rotations, transl=pelvis - rest).to_params(body, fps=found.fit.params.fps)
    # Put the floor at y = 0 and the mean place of the pelvis over the origin.
    floor = float(np.median(np.asarray(body.forward(moved).vertices)[:, :, 1].min(axis=1)))
    shift = -np.array([pelvis[:, 0].mean(), floor, pelvis[:, 2].mean()])
    old_from_new = np.eye(4)
    old_from_new[:3, :3], old_from_new[:3, 3] = turn.T, -turn.T @ shift
    camera = replace(found.camera, cam_from_world=found.camera.cam_from_world @ old_from_new)
    return replace(moved, transl=moved.transl + shift), camera


def turn_notes(found: TurntableFit, body: BodyModel, *, stature: float | None) -> tuple[str, ...]:
    """Say what the frames of a turn do not determine: scale, lens, sides that are missing, limbs that moved.

    Args:
        found: a registered turn.
        body: the model of its poses.
        stature: height that was told, metres; None where it was not.
    """
    out = []
    if stature is None:
        out.append(
            "the person's size is a guess of the shape prior, within some 4 percent: one camera sees twice the size "
            "at twice the distance alike; state --height"
        )
    if found.focal_spread > 0.02:
        share = 100 * found.focal_spread
        out.append(f"focal length {found.camera.K[0, 0]:.0f} px, known to {share:.0f} percent: state --focal-mm")
    # Directions from which the camera sees the body, about the vertical.
    state = BodyState.of_params(body, found.fit.params)
    root = int(np.flatnonzero(body.parents < 0)[0])
    gap = widest_unseen(state.rotations[:, root], found.up)
    # Degrees between neighbouring views from which a side of the person is not seen well.
    wide_gap = 75.0
    if gap > wide_gap:
        out.append(f"neighbouring views are up to {gap:.0f} degrees apart: turn all around, with more frames")
    # Limbs that moved against the mean pose: their frames tell little about the others.
    mean = state.rotations.mean(axis=0)
    cosine = (np.einsum("tjxy,jxy->tj", state.rotations, mean) - 1.0) / 2.0
    away = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    away[:, root] = 0.0
    # Degrees that a joint may depart from the mean pose without a note.
    loose_limb = 15.0
    loose = [(int(row), int(joint)) for row, joint in np.argwhere(away > loose_limb) if joint < 22]
    if loose:
        names = sorted({body.joint_names[joint] for _, joint in loose})
        frames = sorted({found.fit.frames[row] for row, _ in loose})
        out.append(
            f"the pose was not held in {len(frames)} of {len(found.fit.frames)} frames, first in frame {frames[0]}: "
            f"{', '.join(names[:4])}"
        )
    return (*out, "soles, armpits, the inner sides of arms and legs and the crown are seen by hardly any frame")


def widest_unseen(roots: Float64[np.ndarray, "T 3 3"], up: Float64[np.ndarray, " 3"]) -> float:
    """Return the widest angle about the vertical between neighbouring views of the body, degrees."""
    east = np.cross(up, [0.0, 0.0, 1.0])
    east /= np.linalg.norm(east)
    north = np.cross(east, up)
    angles = np.sort(np.degrees(np.arctan2(roots[:, :, 2] @ east, roots[:, :, 2] @ north)))
    return float(np.diff(np.append(angles, angles[0] + 360.0)).max())


def _between(source: Float64[np.ndarray, " 3"], target: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation of one unit vector to another."""
    axis, cosine = np.cross(source, target), float(source @ target)
    sine = np.linalg.norm(axis)
    return matrix_from_rotvec(axis / max(sine, 1e-12) * np.arctan2(sine, cosine))
