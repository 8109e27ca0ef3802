"""Write motions: BVH, the skeleton file of animation programs, and the layout of AMASS."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.body.model import BodyModel
from smplxpp.body.param_layouts import OPEN_BODY
from smplxpp.body.retarget import Skeleton
from smplxpp.body.smpl_joints import is_open_body
from smplxpp.body.smpl_params import rests_like_smpl
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError, matrix_from_rotvec, require_positive, rotvec_from_matrix
from smplxpp.core.files.atomic import atomic_write_bytes, atomic_write_text

UNITS_A_METRE = 100.0
"""BVH has no unit of its own; animation programs take it as centimetres."""
_PLACE, _TURN = "Xposition Yposition Zposition", "Zrotation Xrotation Yrotation"


def write_bvh(
    path: str | Path, body: BodyModel, params: BodyParams, *, joints: Float[np.ndarray, "J 3"] | None = None
) -> None:
    """Write a motion and the skeleton that makes it, whole or not at all.

    The skeleton rests in the T-pose, in centimetres with +Y up; the root has six channels, every other joint three, in
    the order Z X Y (`R = R_z R_x R_y`), degrees, without jumps from frame to frame where that can be. Hands are
    complete. Left out: expressions, and what they and the shape do to the joints.

    Args:
        body: J joints, whose names they get.
        params: T frames, at their `fps` or `DEFAULT_FPS`.
        joints: at rest, metres; None: those of the mean shape.

    Raises:
        InputError: no frames, a rate that is not positive, a body of several roots.
    """
    fps = params.fps or DEFAULT_FPS
    require_positive("frames a second of the motion", fps)
    roots = np.flatnonzero(body.parents < 0)
    if not len(params) or roots.tolist() != [0]:
        received = f"{len(params)} frames, roots {roots.tolist()}"
        raise InputError("motion for BVH", expected="at least one frame, and one root first", received=received)
    rest = body.joint_regressor @ body.v_template if joints is None else np.asarray(joints, np.float64)
    # Offset of each joint from its parent at rest; the root's is its position.
    offsets = UNITS_A_METRE * (rest - np.where(body.parents[:, None] >= 0, rest[body.parents], 0.0))
    order = _depth_first(body)
    lines = ["HIERARCHY", *_node(body, offsets, 0, ""), "MOTION"]
    lines += [f"Frames: {len(params)}", f"Frame Time: {1.0 / fps:.8f}"]
    # Columns in the order of the hierarchy, depth first, as readers of BVH expect them.
    turns = euler_zxy(body.joint_rotations(params))[:, order].reshape(len(params), -1)
    places = UNITS_A_METRE * (rest[0] + params.transl)
    pattern = " ".join(["%.6f"] * (3 + turns.shape[1]))
    lines += [pattern % tuple(row) for row in np.hstack([places, turns]).tolist()]
    atomic_write_text(path, "\n".join(lines) + "\n")


def euler_zxy(rotations: Float[np.ndarray, "T J 3 3"]) -> Float64[np.ndarray, "T J 3"]:
    """Return angles in degrees with `R = R_z(a) R_x(b) R_y(c)`, each frame's nearest to those of the frame before."""
    T, J = rotations.shape[:2]
    upright = rotations.reshape(-1, 3, 3)
    b = np.arcsin(np.clip(upright[:, 2, 1], -1.0, 1.0))
    a = np.arctan2(-upright[:, 0, 1], upright[:, 1, 1])
    c = np.arctan2(-upright[:, 2, 0], upright[:, 2, 2])
    # Where the first and the last axis are one, only their sum counts: the first takes it.
    locked = np.abs(upright[:, 2, 1]) > 1.0 - 1e-9
    a = np.where(locked, np.arctan2(upright[:, 1, 0], upright[:, 0, 0]), a)
    out = np.degrees(np.stack([a, b, np.where(locked, 0.0, c)], axis=1)).reshape(T, J, 3)
    other = out * [1.0, -1.0, 1.0] + 180.0  # the second solution
    for k in range(1, T):
        near = [one + 360.0 * np.rint((out[k - 1] - one) / 360.0) for one in (out[k], other[k])]
        far = [np.abs(one - out[k - 1]).sum(axis=1, keepdims=True) for one in near]
        out[k] = np.where(far[0] <= far[1], near[0], near[1])
    return out


def _depth_first(body: BodyModel) -> list[int]:
    """Return joints as the file's hierarchy has them."""
    order, waiting = [], [0]
    while waiting:
        joint = waiting.pop()
        order.append(joint)
        waiting += np.flatnonzero(body.parents == joint)[::-1].tolist()
    return order


def _node(body: BodyModel, offsets: Float[np.ndarray, "J 3"], joint: int, indent: str) -> list[str]:
    """Return the lines of a joint and all below it."""
    children = np.flatnonzero(body.parents == joint).tolist()
    inner = indent + "  "
    kind, channels = ("JOINT", f"3 {_TURN}") if indent else ("ROOT", f"6 {_PLACE} {_TURN}")
    lines = [f"{indent}{kind} {body.joint_names[joint]}", f"{indent}{{", f"{inner}{_offset(offsets[joint])}"]
    lines.append(f"{inner}CHANNELS {channels}")
    for child in children:
        lines += _node(body, offsets, child, inner)
    # Of the bone that a joint without children ends: as long as so much of the one before it.
    end = 0.6
    if not children:
        lines += [f"{inner}End Site", f"{inner}{{", f"{inner}  {_offset(end * offsets[joint])}", f"{inner}}}"]
    return [*lines, f"{indent}}}"]


def _offset(offset: Float[np.ndarray, " 3"]) -> str:
    return "OFFSET " + " ".join(f"{number:.6f}" for number in offset)


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
