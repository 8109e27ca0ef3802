"""Derive face and stance of a person from a bundle or a template, and the poses of the training."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
from jaxtyping import Float32

from avatar.runtime.bundle import AvatarBundle, read_motion
from avatar.runtime.skeleton import clothed_template, skeleton_body
from avatar.speech import Face, SpeechAnimator, StandingBody, TalkConfig
from avatar.speech.gesture_lexicon import GestureLexicon
from avatar.speech.gesture_planner import MIN_BEAT_INTERVAL, TIMING
from smplxpp.body.blendshapes import ARKIT
from smplxpp.body.model import BodyModel
from smplxpp.body.retarget import Skeleton
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template


def person_of_bundle(bundle: AvatarBundle) -> tuple[Face, StandingBody]:
    """Return the face of a bundle's person and how the body stands.

    Raises:
        InputError: expressions that cannot move a mouth.
    """
    known = bundle.tensors.get("poses.known")
    standing = StandingBody.of(
        Skeleton.of(skeleton_body(bundle)),
        _with_expressions(read_motion(bundle), len(bundle.about.expression_names)),
        observed_poses=None if known is None else known.astype(np.float64),
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


def stance_of(face: Face, body: StandingBody, model: BodyModel) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return how a person stands and gestures, as tables for players that have no `SpeechAnimator`.

    Args:
        face: the person's face. body: how the person stands. model: the joints of the rows.

    Returns:
        Tensors, and frames a second. `idle` (T, C) is a loop of `SpeechAnimator.idle` in half floats: columns `columns`
        (C) of `rows_of`; `standing` (R) is a whole row. `rest` (22), `states` (P, 22) and `clear` (P + 1, P + 1) are
        those of `GestureLexicon`; the numbers of `gesture_planner.TIMING` are beside the rate.
    """
    fps, seconds, seam = 15.0, 24, 2  # halves of these are 60 kB; nobody sees a loop of 24 s repeat
    idle = SpeechAnimator(face, body, TalkConfig(fps=fps)).idle(seconds + seam)
    rows = rows_of(model, idle)
    # The seam goes over from the frames behind the loop's end to those of its beginning.
    count, over = int(seconds * fps), int(seam * fps)
    share = np.linspace(0.0, 1.0, over + 1, dtype=np.float32)[:over, None]
    rows[:over] += (1.0 - share**2 * (3.0 - 2.0 * share)) * (rows[count:] - rows[:over])
    columns = np.flatnonzero(np.ptp(rows[:count], axis=0) > 1e-5)
    lexicon = GestureLexicon.of(body)
    tensors = {
        "columns": columns.astype(np.int32),
        "idle": rows[:count, columns].astype(np.float16),
        "standing": rows[0],
        "rest": lexicon.rest,
        "states": lexicon.states,
        "clear": lexicon.clear_paths(),
    }
    return tensors, {**asdict(TIMING), "min_beat_interval": MIN_BEAT_INTERVAL, "fps": fps}


def rows_of(body: BodyModel, motion: BodyParams) -> Float32[np.ndarray, "T W"]:
    """Return frames as rows for a page: axis-angle vectors of all joints, translation, expressions."""
    rotations = body.axis_angles(motion).reshape(len(motion), -1)
    return np.concatenate([rotations, motion.transl, motion.expression], axis=1).astype(np.float32)


def _with_expressions(seen: BodyParams | None, expressions: int) -> BodyParams:
    """Return frames padded to all expressions of the body; one frame at rest where there are none."""
    if seen is None:
        return BodyParams.rest(betas=0, expressions=expressions)
    # Later expressions of the body that the frames lack are 0.
    missing = expressions - seen.expression.shape[1]
    return replace(seen.without_shape(), expression=np.pad(seen.expression, ((0, 0), (0, missing))))
