"""Open a person who turns before one camera for a reconstruction: photographs of all frames, and the body in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.capture import Capture
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec
from smplxpp.reconstruct import PhotoView
from smplxpp.reconstruct.carried import PosedPerson
from smplxpp.register.kinematics import BodyState
from smplxpp.register.landmarks import visible_vertices

_SPREAD_DEGREES = 12.0  # of each leg, which takes knees that touch some 20 cm apart


@dataclass(frozen=True, eq=False)
class TurningPerson:
    """The photographs of a turn and the body in them, row by row.

    Attributes:
        views: a photograph a frame, called by its number.
        person: the body that carries points from the reference pose to these frames.
    """

    views: list[PhotoView]
    person: PosedPerson


def turning_person(capture: Capture, camera: str, frame: int, body: BodyModel) -> tuple[TurningPerson, list[str]]:
    """Read the frames of a turn that are trained on, and pose the body in them, with notes on those left out.

    Args:
        capture: of a person who turns, with a pose a frame.
        camera: its name.
        frame: the reference frame, in whose pose the surface will be.
        body: the model of the poses.

    Raises:
        InputError: no pose of the reference frame.
    """
    frames = [number for number in capture.splits.train_frames if number in set(capture.frames)]
    views, rows, notes = [], [], []
    for number in [frame, *(other for other in frames if other != frame)]:
        try:
            params, opacity = capture.params(number), capture.mask(camera, number)
            color = capture.image(camera, number)
        except InputError as error:
            notes.append(f"frame {number} left out: {error}")
            continue
        if params is None or opacity is None:
            notes.append(f"frame {number} left out: no {'pose' if params is None else 'mask'}")
            continue
        views.append(PhotoView(str(number), capture.cameras[camera], color, opacity))
        rows.append(params)
    if not views or views[0].name != str(frame):
        raise InputError(
            f"capture {capture.name}",
            expected=f"photograph, mask and pose of the reference frame {frame}",
            received="; ".join(notes[:3]) or "none",
            remedy="`smplxpp capture turntable` finds the poses; choose another frame with --frame",
        )
    return TurningPerson(views, posed_person(body, BodyParams.concatenate(rows))), notes


def posed_person(body: BodyModel, params: BodyParams) -> PosedPerson:
    """Return the body in some frames, to carve a surface in the pose of the first of them.

    The surface is carved with the legs of that pose spread further and carried back: thighs that touch would become
    one.
    """
    apart = spread_legs(body, params.frame(0))
    posed, reference = body.forward(params), body.forward(apart)
    transforms = np.asarray(posed.posed_from_rest, dtype=np.float64)
    from_reference = np.linalg.inv(np.asarray(reference.posed_from_rest[0], dtype=np.float64))
    # Joints that the body lacks follow their nearest ancestor that it has.
    carrier = np.arange(body.joint_count)
    # Joints that carry the space around a body; fingers and face follow wrists and head.
    body_joints = 22
    for joint in range(body.joint_count):
        while carrier[joint] >= body_joints:
            carrier[joint] = body.parents[carrier[joint]]
    weights = np.zeros((min(body_joints, body.joint_count), body.vertex_count))
    np.add.at(weights, carrier, body.weights.T)
    moved = (transforms @ from_reference)[:, : len(weights)]
    mesh = body.mesh(np.asarray(reference.vertices[0], dtype=np.float64))
    shown = visible_vertices(body)
    return PosedPerson(mesh.vertices[shown], mesh.vertex_normals[shown], weights.T[shown], moved, moved[0])


def spread_legs(body: BodyModel, params: BodyParams) -> BodyParams:
    """Return one row of parameters with each leg turned outwards at the hip by `_SPREAD_DEGREES`."""
    state = BodyState.of_params(body, params)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        joint = body.joint_names.index(f"{side}_hip")
        outwards = matrix_from_rotvec(np.radians([0.0, 0.0, sign * _SPREAD_DEGREES]))
        state.rotations[:, joint] = outwards @ state.rotations[:, joint]
    return state.to_params(body)
