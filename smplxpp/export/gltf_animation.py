"""glTF animation of a Template's skeleton and expressions."""

from __future__ import annotations

import numpy as np
import pygltflib as gl
from scipy.spatial.transform import Rotation

from smplxpp.core.params import BodyParams
from smplxpp.core.template import Template
from smplxpp.export.gltf_buffer import GltfBuffer

DEFAULT_FPS = 30.0
# Frames posed at a time: only their transforms are kept.
_CHUNK = 32


def add_animation(
    document: gl.GLTF2, buffer: GltfBuffer, template: Template, params: BodyParams, morph_node: int | None
) -> None:
    """Rotations of the joints that move, translation of the root, and weights of the expressions at `morph_node`."""
    rotations, root_positions = _local_motion(template, params)
    times = (np.arange(len(params)) / (params.fps or DEFAULT_FPS)).astype(np.float32)
    animation = gl.Animation(name="motion", samplers=[], channels=[])
    time_accessor = buffer.add(times, bounds=True)

    def add_channel(node: int, path: str, values: np.ndarray) -> None:
        output = buffer.add(values.astype(np.float32))
        animation.samplers.append(gl.AnimationSampler(input=time_accessor, output=output, interpolation="LINEAR"))
        target = gl.AnimationChannelTarget(node=node, path=path)
        animation.channels.append(gl.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))

    root = int(np.argmax(template.parents < 0))
    add_channel(root, "translation", root_positions)
    for joint in range(template.joint_count):
        if not np.allclose(rotations[:, joint], np.eye(3), rtol=0, atol=1e-9):
            add_channel(joint, "rotation", continuous_quaternions(rotations[:, joint]))
    if morph_node is not None:
        weights = np.zeros((len(params), template.expression_basis.shape[2]))
        weights[:, : params.expression.shape[1]] = params.expression
        add_channel(morph_node, "weights", weights.ravel())
    document.animations.append(animation)


def continuous_quaternions(rotations: np.ndarray) -> np.ndarray:
    """(T, 3, 3) -> (T, 4) unit quaternions xyzw, each on its predecessor's side, so that interpolation is short."""
    quaternions = Rotation.from_matrix(rotations).as_quat()
    flips = np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1]) < 0
    sign = np.cumprod(np.where(np.concatenate([[False], flips]), -1.0, 1.0))
    return quaternions * sign[:, None]


def _local_motion(template: Template, params: BodyParams) -> tuple[np.ndarray, np.ndarray]:
    """(T, J, 3, 3) rotations relative to the parents, (T, 3) position of the root joint."""
    transforms = []
    for start in range(0, len(params), _CHUNK):
        transforms.append(template.posed_from_rest(params.select(slice(start, start + _CHUNK))))
    world = np.concatenate(transforms)
    turned, parents = world[..., :3, :3], template.parents
    local = np.where(parents[:, None, None] < 0, turned, turned[:, np.maximum(parents, 0)].swapaxes(-1, -2) @ turned)
    root = int(np.argmax(parents < 0))
    return local, turned[:, root] @ template.joints[root] + world[:, root, :3, 3]
