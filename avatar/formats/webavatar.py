"""Write WebAvatar's published npz: the Gaussians of an avatar at rest, skinned."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8
from scipy.spatial.transform import Rotation

from avatar.runtime import AvatarPlayer, WorldSplats
from smplxpp.core import BodyParams, InputError
from smplxpp.core.files.atomic import atomic_write_bytes

NOT_FILLED = (
    "the displacement field is a network, or linear in more coefficients than 16: `ctrl_pt_basis` and "
    "`ctrl_pt_offsets` are zero, and cloth follows the joints alone",
    "blend shapes move every Gaussian, fade far from known poses, and are driven by the jaw; a feature network of "
    "leaky ReLUs over pose and expression cannot be that: `layers`, `color_basis`, `scaling_basis` and "
    "`rotation_basis` are zero",
    "harmonics above degree 0 have no field; loose clothes are not simulated",
)
"""What an export leaves out, in sentences."""
_INFLUENCES, _SHAPES = 4, 16  # the format's joints a Gaussian, and blend shapes


def write_webavatar(path: str | Path, player: AvatarPlayer) -> None:
    """Write the arrays that WebAvatar's Unity reader requires; a failed write leaves no file.

    Filled: `_xyz`, `_scaling` (logarithms), `_rotation` (wxyz), `_sh0` (colour less 0.5), float16, and `opacity`
    (8 bits), so that the avatar equals the student in a typical pose of the training; `t_joints`; `weights_idx`,
    `weights_val` (8 bits), each Gaussian's four strongest joints by its triangle's corners. Its player also requires
    one feature network, one control point and one Gaussian with bases, which are zero. See `NOT_FILLED`.

    Raises:
        InputError: an avatar whose skeleton is not SMPL-X's.
    """
    t, sizes = player.bundle.tensors, player.bundle.sizes
    if sizes["J"] != 55:
        raise InputError("avatar", expected="the 55 joints of SMPL-X", received=f"{sizes['J']}")
    weights, joints = _influences(player)
    shown = typical_pose(player)
    posed = player.pose(shown)
    # Undo the reader's skinning for a typical training pose, so
    # that the avatar is exact there and errors stay small near it.
    means, quats = _at_rest(player, shown, posed, weights / 255.0, joints)
    N = len(means)
    arrays: dict[str, np.ndarray] = {
        "_xyz": means.astype(np.float16),
        "_scaling": np.log(posed.scales).astype(np.float16),
        "_rotation": quats.astype(np.float16),
        "_sh0": (posed.dc - 0.5).astype(np.float16)[:, None],
        "opacity": np.rint(255.0 * posed.opacities).astype(np.uint8),
        "t_joints": t["skeleton.joints"].astype(np.float16),
        "weights_idx": joints,
        "weights_val": weights,
        "num_xyz_ft_head": np.ones(1, np.uint32),
        "gs_feat_knn": np.zeros(N, np.uint16),
        "ctrl_feat_knn": np.zeros(1, np.uint16),
        "ctrl_pt_offsets": np.zeros((1, 3), np.float32),
        "ctrl_pt_basis": np.zeros((1, 3, _SHAPES), np.float16),
        "gs_ctrl_knn": np.zeros((N, 3), np.uint16),
        "gs_ctrl_knn_weights": np.full((N, 3), 1.0 / 3.0, np.float16),
    }
    for name, width in (("rot", 4), ("scale", 3), ("color", 3)):
        basis = {"rot": "rotation_basis", "scale": "scaling_basis", "color": "color_basis"}[name]
        arrays |= {f"{name}_idxs": np.zeros(1, np.uint32), basis: np.zeros((1, width, _SHAPES), np.float16)}
    # The feature network from pose and expression to coefficients.
    for k, (inputs, outputs) in enumerate(((80, 32), (32, 32), (32, 32), (32, 2 * _SHAPES))):
        arrays[f"layers.{2 * k}.weight"] = np.zeros((outputs, 1, inputs), np.float16)
        arrays[f"layers.{2 * k}.bias"] = np.zeros((outputs, 1), np.float16)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    atomic_write_bytes(path, stream.getvalue())


def typical_pose(player: AvatarPlayer) -> BodyParams:
    """Return the pose of the training nearest to the mean of all, at the origin; without any the rest pose."""
    poses = player.bundle.tensors.get("poses.known")
    if poses is None:
        return rest_pose()
    nearest = np.square(poses - poses.mean(axis=0)).sum(axis=1).argmin()
    return replace(BodyParams.rest(betas=0, expressions=0), body_pose=poses[[nearest]])


def rest_pose() -> BodyParams:
    """Return the pose in which WebAvatar keeps its Gaussians: the T-pose with hips turned 25 degrees outward."""
    standing = BodyParams.rest(betas=0, expressions=0)
    theta = np.zeros((1, 63))
    theta[0, 2], theta[0, 5] = np.radians(25.0), -np.radians(25.0)
    return replace(standing, body_pose=theta)


def _at_rest(
    player: AvatarPlayer,
    params: BodyParams,
    posed: WorldSplats,
    weights: Float[np.ndarray, "N 4"],
    joints: UInt8[np.ndarray, "N 4"],
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 4"]]:
    """Return positions and rotations (wxyz) at rest that its skinning maps to the student's in a given pose.

    Its shaders blend positions by the mean of the joints' transforms, and rotations by the mean of their quaternions.
    """
    # Transforms from the reader's rest pose to the shown pose: both are known relative to the T-pose.
    to_pose, to_rest = (_square(player.joints(one)[0]) for one in (params, rest_pose()))
    own = (to_pose @ np.linalg.inv(to_rest))[joints]
    mean = np.einsum("nk,nkij->nij", weights, own)
    # Linear blend skinning is x = M p + t with the weighted mean (M, t): solve for p.
    positions = np.linalg.solve(mean[:, :3, :3], (posed.means - mean[:, :3, 3])[..., None])[..., 0]
    turns = Rotation.from_matrix(own[:, :, :3, :3].reshape(-1, 3, 3)).as_quat().reshape(len(own), _INFLUENCES, 4)
    # Mean quaternion, with the signs aligned.
    total = weights[:, :1] * turns[:, 0]
    for k in range(1, _INFLUENCES):
        sign = np.where(np.sum(total * turns[:, k], axis=1, keepdims=True) < 0, -1.0, 1.0)
        total = total + weights[:, k : k + 1] * sign * turns[:, k]
    # SciPy's quaternions are xyzw, ours wxyz: roll by one place. q = blend^-1 q_world.
    quats = (Rotation.from_quat(total).inv() * Rotation.from_quat(np.roll(posed.quats, -1, axis=1))).as_quat()
    return positions, np.roll(quats, 1, axis=1)


def _square(transforms: Float[np.ndarray, "J 3 4"]) -> Float64[np.ndarray, "J 4 4"]:
    out = np.tile(np.eye(4), (len(transforms), 1, 1))
    out[:, :3] = transforms
    return out


def _influences(player: AvatarPlayer) -> tuple[UInt8[np.ndarray, "N 4"], UInt8[np.ndarray, "N 4"]]:
    """Return weights, which sum to 255, and joints of every Gaussian, the strongest first."""
    t, sizes = player.bundle.tensors, player.bundle.sizes
    # Skin weights of a Gaussian are those of its triangle's corners, blended by its barycentrics.
    dense: Float[np.ndarray, "V J"] = np.zeros((sizes["V"], sizes["J"]), np.float32)
    rows = np.repeat(np.arange(sizes["V"]), t["surface.joint_indices"].shape[1])
    np.add.at(dense, (rows, t["surface.joint_indices"].ravel()), t["surface.joint_weights"].ravel())
    faces = t["surface.faces"][np.repeat(np.arange(sizes["F"]), t["gaussians.per_face"])]
    u, v = t["gaussians.barycentric"].T
    blended = sum(share[:, None] * dense[faces[:, k]] for k, share in enumerate((u, v, 1.0 - u - v)))
    # The four strongest joints, with weights in steps of 1/255 that sum to 1 exactly: rounding goes to the strongest.
    joints = np.argsort(-blended, axis=1, kind="stable")[:, :_INFLUENCES]
    shares = np.maximum(np.take_along_axis(blended, joints, axis=1), 0.0)
    steps = np.rint(255.0 * shares / shares.sum(axis=1, keepdims=True)).astype(np.int64)
    steps[:, 0] += 255 - steps.sum(axis=1)
    return steps.astype(np.uint8), joints.astype(np.uint8)
