"""Derive face and stance of a person from a bundle or a template, and the poses of the training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar.runtime.bundle import AvatarBundle, read_motion
from avatar.runtime.skeleton import clothed_template, skeleton_body
from avatar.speech import Face, StandingBody
from smplxpp.body.blendshapes import ARKIT
from smplxpp.body.retarget import Skeleton
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template


def person_of_bundle(bundle: AvatarBundle) -> tuple[Face, StandingBody]:
    """Return the face of a bundle's person and how the body stands.

    Raises:
        InputError: expressions that cannot move a mouth.
    """
    standing = StandingBody.of(
        Skeleton.of(skeleton_body(bundle)),
        _with_expressions(read_motion(bundle), len(bundle.about.expression_names)),
        observed_poses=bundle.tensors.get("poses.known"),
        surface=bundle.tensors["surface.vertices"].astype(np.float64),
    )
    return face_of_bundle(bundle), standing


def face_of_bundle(bundle: AvatarBundle) -> Face:
    """Return the face of a bundle's person.

    Raises:
        InputError: expressions that cannot move a mouth.
    """
    about = bundle.about
    # Numbered expressions have no meaning by name: what they do to the surface is measured.
    body = None if set(ARKIT) & set(about.expression_names) else clothed_template(bundle)[0].body
    return Face.of(about.expression_names, about.joint_names, read_motion(bundle), body=body)


def person_of_template(template: Template, seen: BodyParams | None = None) -> tuple[Face, StandingBody]:
    """Return the face of a template and how its body stands.

    Args:
        template: the clothed body.
        seen: parameters of frames that show how the person stands; None: the T-pose.

    Raises:
        InputError: expressions that cannot move a mouth.
    """
    # Mouth shapes are found by the names of expressions, or by what they do to the surface where names say nothing.
    body = template.body
    face = Face.of(body.expression_names, body.joint_names, seen, body=body)
    frames = _with_expressions(seen, body.num_expressions)
    return face, StandingBody.of(Skeleton.of(body, template.betas), frames, surface=template.vertices)


def _with_expressions(seen: BodyParams | None, expressions: int) -> BodyParams:
    """Return frames padded to all expressions of the body; one frame at rest where there are none."""
    if seen is None:
        return BodyParams.rest(betas=0, expressions=expressions)
    # Later expressions of the body that the frames lack are 0.
    missing = expressions - seen.expression.shape[1]
    return replace(seen.without_shape(), expression=np.pad(seen.expression, ((0, 0), (0, missing))))
