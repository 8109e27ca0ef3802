"""A template's skeleton and skinning weights in glTF's terms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pygltflib
from jaxtyping import Float32, Float64, Int, Integer

from smplxpp.body.layout import OWN_NAMES, names_of_joints
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.export.gltf_buffers import BufferBuilder
from smplxpp.template.template import Template

# glTF names influences four at a time; two sets are what engines that read more than one take.
SET_SIZE = 4
MAX_INFLUENCES = 8


def quantized_influences(weights: SkinWeights) -> tuple[Integer[np.ndarray, "N K"], Float32[np.ndarray, "N K"]]:
    """The strongest influences of every vertex, strongest first, in float32 weights whose rows sum to exactly 1.

    At most 8 joints are kept and renormalised. Weights are rounded to multiples of 2^-24; what a row lacks to 1 goes to
    its strongest joint. Slots without weight name joint 0, as glTF asks.

    Args:
        weights: of N vertices over J joints.

    Returns:
        (N, K) uint8, or uint16 from 257 joints on, and (N, K) float32; K is the most influences any vertex has.
    """
    strongest = SkinWeights.from_dense(weights.dense(), max_influences=MAX_INFLUENCES)
    # Weights are multiples of this: each is exact in float32, and so is any sum of a row.
    weight_step = 2.0**-24
    steps = np.rint(strongest.joint_weights / weight_step).astype(np.int64)
    steps[:, 0] += round(1 / weight_step) - steps.sum(axis=1)
    used = max(1, int((steps > 0).sum(axis=1).max(initial=0)))
    steps = steps[:, :used]
    joints = np.where(steps > 0, strongest.joint_indices[:, :used], 0)
    dtype = np.uint8 if weights.joint_count <= 256 else np.uint16
    return joints.astype(dtype), (steps * weight_step).astype(np.float32)


def influence_sets(
    joints: Integer[np.ndarray, "N K"], weights: Float32[np.ndarray, "N K"]
) -> list[tuple[Integer[np.ndarray, "N 4"], Float32[np.ndarray, "N 4"]]]:
    """Split (N, K) influences into sets of 4 for JOINTS_n and WEIGHTS_n, as many as a vertex among these needs."""
    used = max(1, int((weights > 0).sum(axis=1).max(initial=0)))
    fill = ((0, 0), (0, -used % SET_SIZE))
    joints, weights = np.pad(joints[:, :used], fill), np.pad(weights[:, :used], fill)
    return [(joints[:, k : k + SET_SIZE], weights[:, k : k + SET_SIZE]) for k in range(0, joints.shape[1], SET_SIZE)]


def add_skin(gltf: pygltflib.GLTF2, buffers: BufferBuilder, template: Template) -> Int[np.ndarray, " J"]:
    """Add the skeleton: a root node, a node for each joint at rest, and the skin that binds them.

    A joint's node holds its offset from its parent; its inverse bind matrix is the translation by `-J_j`, so that
    the global transform of the node times it is `posed_from_rest` of `smplxpp.skinning.linear_blend`.

    Returns:
        (J,) indices of the joints' nodes. The skeleton's root node is the one before the first.
    """
    joints, parents = template.joints, template.body.parents
    root = len(gltf.nodes)
    nodes = root + 1 + np.arange(len(parents))
    offsets = rest_offsets(template)
    # Children of the skeleton's root (-1) and of each joint.
    children = [nodes[parents == j].tolist() for j in range(-1, len(parents))]
    gltf.nodes.append(pygltflib.Node(name="skeleton", children=children[0]))
    for name, offset, below in zip(template.body.joint_names, offsets, children[1:], strict=True):
        gltf.nodes.append(pygltflib.Node(name=name, translation=offset.tolist(), children=below))
    inverse_binds = np.tile(np.eye(4, dtype=np.float32), (len(parents), 1, 1))
    inverse_binds[:, :3, 3] = -joints
    gltf.skins.append(
        pygltflib.Skin(
            name="skin", inverseBindMatrices=buffers.add(inverse_binds), joints=nodes.tolist(), skeleton=root
        )
    )
    return nodes


def rest_offsets(template: Template) -> Float64[np.ndarray, "J 3"]:
    """Return the offset of each rest joint from its parent, of a root from the origin; metres."""
    joints, parents = template.joints, template.body.parents
    return joints - np.where(parents[:, None] >= 0, joints[parents], 0.0)


def with_joint_names(template: Template, scheme: str) -> Template:
    """Return the template with its joints named by `smplxpp.body.layout.names_of_joints`.

    Raises:
        InputError: another scheme, or a body without any joint of the SMPL family.
    """
    if scheme == OWN_NAMES:
        return template
    return replace(
        template, body=replace(template.body, joint_names=names_of_joints(template.body.joint_names, scheme))
    )
