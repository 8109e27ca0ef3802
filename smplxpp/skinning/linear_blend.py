"""Compute forward kinematics and linear blend skinning, written once for numpy arrays and torch tensors.

The type of the result is the type of the arguments; in torch everything is differentiable.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from smplxpp.core.rotations import Array, array_namespace


def forward_kinematics(
    rest_joints: Float[Array, "... J 3"],
    parents: Integer[np.ndarray, " J"],
    rotations: Float[Array, "... J 3 3"],
    *,
    transl: Float[Array, "... 3"] | None = None,
) -> tuple[Float[Array, "... J 4 4"], Float[Array, "... J 3"]]:
    """Compute the transforms of a skeleton's joints from their local rotations.

    With `L_j = [R_j, J_j - J_parent; 0, 1]` (the root's offset is `J_root + transl`) and `G_j = G_parent L_j`, the
    returned transform is `G_j [I, -J_j; 0, 1]`, which maps a point of the rest pose to the posed one (Loper et al.
    2015, equations 3 and 4). The root rotates about its own joint; the translation comes last.

    Args:
        rest_joints: joints in the rest pose, metres.
        parents: index of each joint's parent, -1 at the root; the order of the joints is free.
        rotations: rotation of each joint relative to its parent's frame.
        transl: translation of the whole body, metres.

    Returns:
        posed_from_rest: transform of each joint.
        joints: positions of the joints in the pose, metres.
    """
    # Offsets from each joint's parent; the root starts at its own place and the translation.
    xp = array_namespace(rotations)
    above = tuple(np.asarray(parents).tolist())
    device = None if xp is np else rotations.device
    (own, *places), levels, back = _levels(above, device)
    offsets = rest_joints - rest_joints[..., own, :]
    root = levels[0]
    root_position = rest_joints[..., root, :]
    if transl is not None:
        root_position = root_position + transl[..., None, :]
    # One batched product for each level of the tree; the results are put back in joint order at the end.
    turned, moved = [rotations[..., root, :, :]], [root_position]
    for level, parent in zip(levels[1:], places, strict=True):
        parent_turned = turned[-1][..., parent, :, :]
        turned.append(parent_turned @ rotations[..., level, :, :])
        moved.append(moved[-1][..., parent, :] + (parent_turned @ offsets[..., level, :, None])[..., 0])
    turned = xp.concatenate(turned, -3)[..., back, :, :]
    joints = xp.concatenate(moved, -2)[..., back, :]
    # G_j [I, -J_j]: the rotation stays, the translation is joint - R J.
    shift = joints - (turned @ rest_joints[..., None])[..., 0]
    upper = xp.concatenate([turned, shift[..., None]], -1)
    last = xp.zeros_like(upper[..., :1, :])
    last[..., 3] = 1.0
    return xp.concatenate([upper, last], -2), joints


def blend_transforms(
    weights: Float[Array, "N J"], posed_from_rest: Float[Array, "... J 4 4"]
) -> Float[Array, "... N 4 4"]:
    """Return each point's sum of the joints' transforms, weighted by its skin weights."""
    flat = posed_from_rest.reshape(posed_from_rest.shape[:-2] + (16,))
    return (weights @ flat).reshape(flat.shape[:-2] + (weights.shape[0], 4, 4))


def skin(
    vertices: Float[Array, "... V 3"], weights: Float[Array, "V J"], posed_from_rest: Float[Array, "... J 4 4"]
) -> Float[Array, "... V 3"]:
    """Pose vertices by linear blend skinning, `x = sum_j w_j G_j x_rest`.

    Args:
        vertices: rest positions.
        weights: skin weights of each vertex over the joints; rows sum to 1.
        posed_from_rest: transforms of the joints.

    Returns:
        Posed positions.
    """
    xp = array_namespace(posed_from_rest)
    batch, joint_count = tuple(posed_from_rest.shape[:-3]), posed_from_rest.shape[-3]
    # The 12 numbers of each joint's transform are blended for all frames in one product, with vertices last, so that
    # sums run along memory.
    rows = xp.moveaxis(posed_from_rest[..., :3, :], -3, -1).reshape(-1, joint_count)
    blended = (rows @ weights.T).reshape((*batch, 3, 4, weights.shape[0]))
    x, y, z = (vertices[..., axis] for axis in range(3))
    posed = [b[..., 0, :] * x + b[..., 1, :] * y + b[..., 2, :] * z + b[..., 3, :] for b in xp.moveaxis(blended, -3, 0)]
    return xp.stack(posed, -1)


@lru_cache(maxsize=64)
def _levels(parents: tuple[int, ...], device: Any) -> tuple[list[Any], list[Any], Any]:
    """Return indices for a tree of joints: arrays, or tensors on a device, which a GPU need not wait for.

    Returns:
        places: each joint's parent (the root's is a joint of no effect); then, from the second group on, the place of
            each joint's parent in the group above.
        levels: joints grouped by their depth in the tree.
        back: the order that puts the groups' joints back.
    """
    above = np.array(parents)
    levels = [[int(j) for j in np.flatnonzero(above < 0)]]
    while sum(map(len, levels)) < len(parents):
        level = [int(j) for j in np.flatnonzero(np.isin(above, levels[-1]))]
        assert level, "the joints do not form a tree"
        levels.append(level)
    places = [[upper.index(parents[j]) for j in level] for upper, level in pairwise(levels)]
    back = np.argsort([j for level in levels for j in level])
    if device is None:
        return [np.maximum(above, 0), *places], levels, back
    # Indices that are made in inference mode could not take part in autograd later.
    torch = sys.modules["torch"]
    with torch.inference_mode(False):
        moved = [torch.tensor(one, device=device) for one in (np.maximum(above, 0), *places, *levels, back)]
    return moved[: len(levels)], moved[len(levels) : -1], moved[-1]
