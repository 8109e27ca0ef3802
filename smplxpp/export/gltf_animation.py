"""Frames of body parameters as a glTF animation."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pygltflib
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.body.model import BodyModel
from smplxpp.core import DEFAULT_FPS, BodyParams, GeometryWarning, InputError, require_positive
from smplxpp.export.gltf_buffers import BufferBuilder
from smplxpp.export.gltf_skin import rest_offsets
from smplxpp.template.template import Template


def joint_motion(
    template: Template, params: BodyParams
) -> tuple[Float64[np.ndarray, "T J 3 3"], Float64[np.ndarray, "T J 3"]]:
    """Each joint's rotation and translation in its parent's frame, so that glTF's skinning gives the template's pose.

    The inverse bind matrices stand for the neutral joints `J`. An expression moves joints (the jaw's, the eyes') by
    `d`, about which they then turn: with `W_j = G_j [I, J_j; 0, 1]`, the node's global transform, the local
    translation is `J_j - J_parent + (I - R_j) d_j`, and of the root `J_root + transl + (I - R_root) d_root`.

    Args:
        template: J joints.
        params: T frames; betas and `v_shape` are not looked at, as in `Template.pose`.

    Returns:
        (T, J, 3, 3) rotations and (T, J, 3) translations in metres.

    Raises:
        InputError: more expressions than the template has, a skeleton outside the SMPL family, hand coefficients that
            the template cannot expand.
    """
    if template.body.joint_count not in JOINT_NAMES:
        raise InputError(
            "animation",
            expected=f"a template of {', '.join(map(str, sorted(JOINT_NAMES)))} joints, as the parameters",
            received=f"{template.body.joint_count} joints",
            remedy="write the file without an animation",
        )
    posed = _joints_alone(template).forward(params.without_shape())
    global_rotations = posed.posed_from_rest[..., :3, :3]
    parents = template.body.parents
    # Local rotations R_parent^T R_joint. The root's parent is the world.
    above = np.where((parents >= 0)[:, None, None], global_rotations[:, parents], np.eye(3))
    rotations = above.swapaxes(-1, -2) @ global_rotations
    # d_j of the docstring: how far the expression moves a joint at rest.
    moved = posed.rest_joints - template.joints
    translations = rest_offsets(template) + moved - (rotations @ moved[..., None])[..., 0]
    translations[:, parents < 0] += params.transl[:, None]
    return rotations, translations


def add_animation(
    gltf: pygltflib.GLTF2,
    buffers: BufferBuilder,
    template: Template,
    params: BodyParams,
    *,
    joint_nodes: Int[np.ndarray, " J"],
    morph_node: int | None,
) -> None:
    """Add the frames as the animation "motion".

    Every joint has a rotation; roots, and joints that expressions move, a translation; the node of the body's mesh the
    morph weights. Frames are a linear interpolation apart.

    Args:
        gltf: where the animation goes.
        buffers: its buffer.
        template: J joints.
        params: T frames at `params.fps` or `DEFAULT_FPS`; without morph targets the face stays neutral.
        joint_nodes: (J,) indices of the joints' nodes.
        morph_node: the node with the expressions, None where there are none.

    Raises:
        InputError: no frames, a frame rate that is not positive, or what `joint_motion` refuses.

    Warns:
        GeometryWarning: the template has pose correctives, which glTF's skinning leaves out.
    """
    times = _times(params)
    # Without morph targets the expressions must not move the joints either.
    if morph_node is None:
        params = replace(params, expression=np.zeros((len(params), 0)))
    rotations, translations = joint_motion(template, params)
    if template.body.posedirs is not None:
        warnings.warn(
            "animation: the pose correctives of the template are left out, glTF has no place for them",
            GeometryWarning,
            stacklevel=3,
        )
    animation = pygltflib.Animation(name="motion")
    # All channels share one input accessor; glTF demands the bounds of its times.
    clock = buffers.add(times, bounds=True)

    def add_channel(node: int, path: str, values: np.ndarray) -> None:
        target = pygltflib.AnimationChannelTarget(node=int(node), path=path)
        animation.channels.append(pygltflib.AnimationChannel(sampler=len(animation.samplers), target=target))
        output = buffers.add(values.astype(np.float32))
        animation.samplers.append(pygltflib.AnimationSampler(input=clock, output=output, interpolation="LINEAR"))

    # A joint that expressions move by less, in metres, keeps its place at rest.
    still = 1e-6
    # Every joint turns, but few translate: a translation channel is written for roots and for joints that leave their
    # rest offset in some frame, which keeps the file small.
    moved = np.abs(translations - rest_offsets(template)).max(axis=(0, 2)) > still
    for j, (node, quaternions) in enumerate(zip(joint_nodes, _quaternions(rotations), strict=True)):
        add_channel(node, "rotation", quaternions)
        if moved[j] or template.body.parents[j] < 0:
            add_channel(node, "translation", translations[:, j])
    if morph_node is not None:
        # glTF wants a weight for every morph target of the mesh, frame by frame; missing expressions are zero.
        weights = np.zeros((len(params), template.body.num_expressions))
        weights[:, : params.expression.shape[1]] = params.expression
        add_channel(morph_node, "weights", weights.reshape(-1))
    gltf.animations.append(animation)


def _joints_alone(template: Template) -> BodyModel:
    """The body model with its joints as the only vertices; being linear in the vertices, they move as in the model."""
    model, regressor = template.body, template.body.joint_regressor
    # Every base is regressed to the joints once, so that a motion costs J instead of V vertices a frame.
    eye = np.eye(model.joint_count)
    return replace(
        model,
        v_template=template.joints,
        faces=np.zeros((0, 3), np.int64),
        shapedirs=np.tensordot(regressor, model.shapedirs, axes=1),
        exprdirs=np.tensordot(regressor, model.exprdirs, axes=1),
        posedirs=None,
        joint_regressor=eye,
        weights=eye,
        part_labels=np.arange(model.joint_count),
        part_label_names=model.joint_names,
    )


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """(T, J, 3, 3) -> (J, T, 4) xyzw; the sign follows the frame before, so that interpolation takes the short way."""
    frames, joints = rotations.shape[:2]
    quaternions = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat().reshape(frames, joints, 4)
    # q and -q are one rotation: flip the sign where the dot product with the frame before is negative, accumulated over
    # the frames.
    turns = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(turns, axis=0)[..., None]
    return quaternions.swapaxes(0, 1)


def _times(params: BodyParams) -> np.ndarray:
    """The frames' times (T,), float32 seconds."""
    fps = DEFAULT_FPS if params.fps is None else params.fps
    require_positive("animation: fps, frames a second", fps)
    if not len(params):
        raise InputError("animation", expected="at least one frame", received="none")
    return (np.arange(len(params)) / fps).astype(np.float32)
