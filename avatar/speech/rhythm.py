"""When somebody who speaks gestures: beats on stressed syllables, strokes of gestures on some of them, rest in pauses.

A gesture is prepared, struck, held and taken back, and its stroke falls on a stressed syllable or just ahead of it
(Kendon, Gesture and speech: two aspects of the process of utterance, 1980; McNeill, Hand and Mind, 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avatar.speech.phonemes import SILENCE, VOWELS, Phoneme, Speech

BETWEEN_BEATS = 0.42
"""Seconds between beats, at least."""
_STROKES = (1.5, 2.8)  # seconds between strokes of gestures: drawn from these
_PAUSE = 0.2  # seconds of silence that part phrases
_ONSET = 0.04  # seconds of a vowel until its beat: loudness has risen by then
_LONG = 0.06  # seconds: shorter vowels carry no beat where nobody says what is stressed


@dataclass(frozen=True)
class Beat:
    """A stressed syllable that is marked.

    Attributes:
        time: seconds. weight: 0 to 1: how strongly it is spoken. stroke: a new gesture is reached here.
    """

    time: float
    weight: float
    stroke: bool = False


def beats(speech: Speech, rng: np.random.Generator) -> list[Beat]:
    """Return the beats of a speech in order of time, those of strokes among them.

    Where no vowel says that it is stressed, long ones count as if they were. Of syllables that are too close, the one
    that is spoken longer has the beat. Strokes are at the first beat of a phrase and at some of the others.
    """
    vowels = [one for one in speech.spoken if one.name in VOWELS]
    stressed = [one for one in vowels if one.stress == 1]
    if not stressed:
        stressed = [one for one in vowels if one.end - one.start >= _LONG]
    if not stressed:
        return []
    usual = float(np.median([one.end - one.start for one in stressed]))
    chosen: list[Phoneme] = []
    for one in sorted(stressed, key=lambda one: one.start - one.end):
        if all(abs(one.start - other.start) >= BETWEEN_BEATS for other in chosen):
            chosen.append(one)
    chosen.sort(key=lambda one: one.start)
    starts = _phrase_starts(speech.phonemes)
    out: list[Beat] = []
    last, wait, phrase = -np.inf, 0.0, -1
    for one in chosen:
        time = min(one.start + _ONSET, 0.5 * (one.start + one.end))
        mine = int(np.searchsorted(starts, one.start + 1e-6)) - 1
        stroke = time - last >= wait or (mine != phrase and time - last >= _STROKES[0])
        if stroke:
            last, wait, phrase = time, float(rng.uniform(*_STROKES)), mine
        weight = float(np.clip((one.end - one.start) / usual, 0.6, 1.4) / 1.4)
        out.append(Beat(time, weight, stroke))
    return out


def _phrase_starts(phonemes: Sequence[Phoneme]) -> list[float]:
    """When phrases begin: behind silences."""
    out: list[float] = []
    quiet_since = -np.inf
    for one in phonemes:
        if one.name == SILENCE:
            continue
        if one.start - quiet_since >= _PAUSE or not out:
            out.append(one.start)
        quiet_since = one.end
    return out
