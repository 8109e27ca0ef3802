"""Who talks: the face and the stance of a run's or a bundle's person, of what training saw of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.commands.templates import load_run_template
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import PARAMS
from smplxpp.body.retarget import Skeleton
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams

if TYPE_CHECKING:
    from avatar.runtime import AvatarBundle
    from avatar.speech import Face, StandingBody


def person_of_bundle(bundle: AvatarBundle) -> tuple[Face, StandingBody]:
    """Return the face of a bundle's person and how the body stands, of what training saw."""
    from avatar.runtime.skeleton import skeleton_body
    from avatar.speech import StandingBody

    standing = StandingBody.of(
        Skeleton.of(skeleton_body(bundle)),
        _whole(_motion_of(bundle), len(bundle.about.expression_names)),
        observed_poses=bundle.tensors.get("poses.known"),
        surface=bundle.tensors["surface.vertices"].astype(np.float64),
    )
    return face_of_bundle(bundle), standing


def face_of_bundle(bundle: AvatarBundle) -> Face:
    """Return the face of a bundle's person, of what training saw.

    Raises:
        InputError: expressions by which no mouth can be moved.
    """
    from avatar.runtime.skeleton import clothed_template
    from avatar.speech import Face
    from avatar.speech.curves import ARKIT

    about = bundle.about
    # Only of numbered expressions is the surface asked what they do.
    body = None if set(ARKIT) & set(about.expression_names) else clothed_template(bundle)[0].body
    return Face.of(about.expression_names, about.joint_names, _motion_of(bundle), body=body)


def live_lips(bundle: AvatarBundle) -> bytes | None:
    """Return what moves a bundle's mouth by live sound in a page; None for a face without a mouth that speaks."""
    from pipelines.web.page import lips_of

    try:
        return lips_of(face_of_bundle(bundle))
    except InputError:
        return None


def person_of_run(run: Path) -> tuple[Face, StandingBody]:
    """Return the face of a run's template and how its body stands, of the reference frame alone."""
    from avatar.speech import Face, StandingBody

    template = load_run_template(run)
    body = template.body
    seen = load_params_of_run(run) if (run / PARAMS).is_file() else None
    face = Face.of(body.expression_names, body.joint_names, seen, body=body)
    frames = _whole(seen, body.num_expressions)
    return face, StandingBody.of(Skeleton.of(body, template.betas), frames, surface=template.vertices)


def _motion_of(bundle: AvatarBundle) -> BodyParams | None:
    if not bundle.motion:
        return None
    arrays = {name: np.asarray(value, np.float64) for name, value in bundle.motion.items()}
    return BodyParams.from_mapping(arrays, source="motion of the bundle")


def _whole(seen: BodyParams | None, expressions: int) -> BodyParams:
    """Frames with all expressions of the body; one at rest where there are none."""
    if seen is None:
        return BodyParams.rest(betas=0, expressions=expressions)
    missing = expressions - seen.expression.shape[1]
    return replace(seen.without_shape(), expression=np.pad(seen.expression, ((0, 0), (0, missing))))
