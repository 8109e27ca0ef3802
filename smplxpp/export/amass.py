"""Write a motion in the layout of AMASS."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from smplxpp.body.model import BodyModel
from smplxpp.body.param_layouts import OPEN_BODY
from smplxpp.body.retarget import Skeleton
from smplxpp.body.smpl_joints import is_open_body
from smplxpp.body.smpl_params import rests_like_smpl
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError, matrix_from_rotvec, require_positive, rotvec_from_matrix
from smplxpp.core.files.atomic import atomic_write_bytes

_BETAS = 16
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_FACE = ("jaw_pose", "leye_pose", "reye_pose")


def write_amass(path: str | Path, body: BodyModel, params: BodyParams) -> None:
    """Write a motion as AMASS has them: SMPL-X's "stageii" for 55 joints, SMPL+H for 52; whole or not at all.

    Keys of SMPL-X: `poses (T, 165)`, `root_orient, pose_body, pose_hand, pose_jaw, pose_eye`, `trans`, `betas (16)`,
    `num_betas`, `gender`, `surface_model_type`, `mocap_frame_rate`, `mocap_time_length`; of SMPL+H: `poses (T, 156)`,
    `trans`, `betas`, `dmpls`, `gender`, `mocap_framerate`. Axis-angle in radians, metres, **+Z up**, hands complete
    (without their mean). The turn is about the root joint of this body. `up` states the axis; `body` says "open_body"
    where the parameters are of that and of no model of the family, as our reader understands. Left out: expressions.

    Args:
        body: completes the hands, and says where the root is.
        params: T frames; betas, where they have any, are those
            of their first frame.

    Raises:
        InputError: no frames, a rate that is not positive, a body of other joints, more than 16 betas.
    """
    fps = params.fps or DEFAULT_FPS
    require_positive("frames a second of the motion", fps)
    if not len(params):
        raise InputError("motion for AMASS", expected="at least one frame", received="none")
    if body.joint_count not in (52, 55):
        raise InputError("body", expected="the 55 joints of SMPL-X or the 52 of SMPL+H", received=f"{body.joint_count}")
    given = params.betas.shape[1]
    if given > _BETAS and params.betas[:, _BETAS:].any():
        raise InputError(
            "parameter betas",
            expected=f"at most {_BETAS} numbers",
            received=f"{given}",
            remedy="cut them: `smplxpp params convert --betas 16`",
        )
    betas = np.zeros(_BETAS)
    betas[: min(given, _BETAS)] = params.betas[0, :_BETAS]
    # AMASS has +Z up. The rotation of the world turns the root's orientation, and its translation about the root joint.
    turned = _z_up(body, params)
    # Complete axis-angle vectors in the order of the model's joints: hand PCA and mean hand are expanded here.
    poses = body.axis_angles(turned).reshape(len(params), -1)
    arrays: dict[str, object] = {"up": "z", "gender": "neutral", "trans": turned.transl, "betas": betas, "poses": poses}
    # A bundle's skeleton has no vertices that tell it, but the open body's wide hips.
    if is_open_body(body) or not rests_like_smpl(Skeleton.of(body)):
        arrays["body"] = OPEN_BODY
    if body.joint_count == 52:
        arrays |= {"mocap_framerate": fps, "dmpls": np.zeros((len(params), 8))}
    else:
        face = {name: getattr(turned, name) for name in _FACE}
        arrays |= {
            "surface_model_type": "smplx",
            "num_betas": _BETAS,
            "mocap_frame_rate": fps,
            "mocap_time_length": len(params) / fps,
            "root_orient": poses[:, :3],
            "pose_body": poses[:, 3:66],
            "pose_hand": poses[:, 75:],
            "pose_jaw": face["jaw_pose"],
            "pose_eye": np.hstack([face["leye_pose"], face["reye_pose"]]),
        }
    stream = io.BytesIO()
    np.savez_compressed(stream, **{name: np.asarray(value) for name, value in arrays.items()})  # type: ignore[arg-type]
    atomic_write_bytes(path, stream.getvalue())


def _z_up(body: BodyModel, params: BodyParams) -> BodyParams:
    """Return parameters of the posed body turned about the origin, so that what was +Y is +Z."""
    root = body.rest_joints(replace(params, betas=np.zeros((len(params), 0)), v_shape=None))[:, 0]
    turned = rotvec_from_matrix(_Z_UP_FROM_Y_UP @ matrix_from_rotvec(params.global_orient))
    return replace(params, global_orient=turned, transl=(root + params.transl) @ _Z_UP_FROM_Y_UP.T - root)
