"""Plan gestures in time: beats on stressed syllables, strokes on some of them, holds, and retraction in pauses.

A gesture is prepared, struck, held and retracted, and its stroke falls on a stressed syllable or just ahead of it
(Kendon, Gesture and speech: two aspects of the process of utterance, 1980; McNeill, Hand and Mind, 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avatar.speech.gesture_lexicon import GestureLexicon, largest_rotation, pose_arms, shuffle_recent_last
from avatar.speech.phonemes import SILENCE, VOWELS, Phoneme, Speech
from avatar.speech.standing_body import StandingBody
from avatar.speech.tracks import Track
from smplxpp.core.params import BodyParams

MIN_BEAT_INTERVAL = 0.42
"""Seconds between two beats, at least."""


@dataclass(frozen=True)
class GestureTiming:
    """Timing and size of gestures. The values were set by eye on the embedded body; no measurement backs them.

    Attributes:
        stroke_interval: seconds between strokes, drawn uniformly.
        speed: mean speed of an arm's fastest joint, radians a second.
        min_move: shortest move, seconds.
        lead: seconds between reaching a pose and its beat.
        min_preparation: seconds; a gesture with less time to prepare is left out.
        hold: seconds that a gesture is held, drawn uniformly.
        max_wait: seconds; hands stay up if the next gesture follows within this time, and are retracted otherwise.
        retraction: duration of a retraction, as a multiple of another move's.
        sizes: size of a gesture relative to its lexicon entry, drawn uniformly.
        jitter: standard deviation of each joint's random rotation, radians.
        rise: seconds in which forearms rise before a beat.
        fall: seconds in which they return after it.
        beat_elbow: amplitude of a beat at the elbow, radians.
        beat_wrist: amplitude at the wrist, radians.
        beat_shoulder: amplitude at the shoulder, radians.
        raised: angle from rest above which an arm marks beats, radians.
        memory: seconds of the past that may still be evaluated.
    """

    stroke_interval: tuple[float, float] = (1.5, 2.8)
    speed: float = float(np.radians(150.0))
    min_move: float = 0.4
    lead: float = 0.1
    min_preparation: float = 0.35
    hold: tuple[float, float] = (0.35, 0.8)
    max_wait: float = 2.4
    retraction: float = 1.3
    sizes: tuple[float, float] = (0.85, 1.1)
    jitter: float = float(np.radians(2.0))
    rise: float = 0.22
    fall: float = 0.28
    beat_elbow: float = float(np.radians(8.0))
    beat_wrist: float = float(np.radians(7.0))
    beat_shoulder: float = float(np.radians(2.0))
    raised: float = float(np.radians(25.0))
    memory: float = 60.0


TIMING = GestureTiming()


@dataclass(frozen=True)
class Beat:
    """A stressed syllable that a gesture marks.

    Attributes:
        time: seconds.
        weight: how strongly the syllable is spoken, 0 to 1.
        stroke: whether the stroke of a new gesture falls on it.
    """

    time: float
    weight: float
    stroke: bool = False


def find_beats(speech: Speech, rng: np.random.Generator) -> list[Beat]:
    """Return the beats of a speech in order of time, those with strokes among them.

    Where no vowel is marked as stressed, vowels of at least 60 ms count as stressed. Of two syllables closer than
    `MIN_BEAT_INTERVAL`, the longer one has the beat. Strokes fall on the first beat of a phrase and on some others.
    """
    vowels = [one for one in speech.spoken if one.name in VOWELS]
    stressed = [one for one in vowels if one.stress == 1]
    if not stressed:
        stressed = [one for one in vowels if one.end - one.start >= 0.06]
    if not stressed:
        return []
    # Non-maximum suppression: longest syllables first.
    usual = float(np.median([one.end - one.start for one in stressed]))
    chosen: list[Phoneme] = []
    for one in sorted(stressed, key=lambda one: one.start - one.end):
        if all(abs(one.start - other.start) >= MIN_BEAT_INTERVAL for other in chosen):
            chosen.append(one)
    chosen.sort(key=lambda one: one.start)
    # Strokes: the first beat of a phrase, and the first beat after a random interval.
    starts = _phrase_starts(speech.phonemes)
    out: list[Beat] = []
    last, wait, phrase = -np.inf, 0.0, -1
    for one in chosen:
        # 40 ms after the vowel's onset: its loudness has risen by then.
        time = min(one.start + 0.04, 0.5 * (one.start + one.end))
        own_phrase = int(np.searchsorted(starts, one.start + 1e-6)) - 1
        stroke = time - last >= wait or (own_phrase != phrase and time - last >= TIMING.stroke_interval[0])
        if stroke:
            last, wait, phrase = time, float(rng.uniform(*TIMING.stroke_interval)), own_phrase
        weight = float(np.clip((one.end - one.start) / usual, 0.6, 1.4) / 1.4)
        out.append(Beat(time, weight, stroke))
    return out


def _phrase_starts(phonemes: Sequence[Phoneme], pause: float = 0.2) -> list[float]:
    """Return when phrases begin: after silences of at least `pause` seconds."""
    # A phrase begins with the first phoneme after a long enough silence, and with the first of all.
    out: list[float] = []
    quiet_since = -np.inf
    for one in phonemes:
        if one.name == SILENCE:
            continue
        if one.start - quiet_since >= pause or not out:
            out.append(one.start)
        quiet_since = one.end
    return out


class GesturePlanner:
    """The arms of a person who alternates between talking and waiting.

    Args:
        body: the person.
        size: of gestures, 0 (none) to 1.
        seed: of their order, sizes and pauses.
    """

    def __init__(self, body: StandingBody, *, size: float = 1.0, seed: int = 0) -> None:
        self.lexicon = GestureLexicon.of(body)
        self._size, self._rng = size, np.random.default_rng(seed)
        self._arms = Track(self.lexicon.rest)
        self._raised = Track(np.zeros(2))
        self._beats: list[Beat] = []
        self.strokes: list[tuple[float, tuple[str, str]]] = []
        """Time in seconds and arm poses of every stroke."""
        self._recent: list[int] = []

    def plan(self, speech: Speech, start: float, *, more: bool) -> None:
        """Plan the gestures of a speech from a time on.

        Args:
            speech: the phonemes.
            start: when it begins, seconds.
            more: another speech follows, so that hands stay up at the end.
        """
        self.discard_from(start)
        if not self._size or not self.lexicon.pairs:
            return
        # Beats in the planner's own time; strokes are reached `lead` ahead of theirs.
        rhythm = [Beat(one.time + start, one.weight, one.stroke) for one in find_beats(speech, self._rng)]
        self._beats += rhythm
        strokes = [one.time for one in rhythm if one.stroke]
        free = start
        for k, time in enumerate(strokes):
            arrival = time - TIMING.lead
            held = time + float(self._rng.uniform(*TIMING.hold))
            later = strokes[k + 1] if k + 1 < len(strokes) else np.inf
            if arrival - free < TIMING.min_preparation:
                continue
            self._plan_stroke(arrival, free)
            free = held
            # Retract the hands where the next stroke is far away, or after the last one.
            stays_up = more and later == np.inf
            if not stays_up and later - held > TIMING.max_wait:
                end = max(held, min(start + speech.seconds - 0.2, held + 0.8))
                self.retract(end if later == np.inf else held)
                free = self._arms.end if later - self._arms.end > TIMING.min_preparation else held

    def retract(self, start: float) -> None:
        """Lower the hands to rest from a time on, unless they already rest."""
        away = largest_rotation(self._arms.target, self.lexicon.rest)
        if away < 1e-6:
            return
        # A slightly different rest each time, because people never return to the same pose. The forearms stop marking
        # beats.
        jitter = self._size * 0.5 * TIMING.jitter * self._rng.normal(size=18).clip(-1.5, 1.5)
        rest = self.lexicon.rest + np.concatenate([jitter, np.zeros(4)])
        end = start + max(TIMING.retraction * away / TIMING.speed, 0.8)
        self._arms.move(rest if away > TIMING.raised else self.lexicon.rest, start, end)
        self._raised.move(np.zeros(2), start, start + 0.4)

    @property
    def resting(self) -> bool:
        """Whether the hands rest or are being retracted."""
        return largest_rotation(self._arms.target, self.lexicon.rest) < 4.0 * TIMING.jitter

    def discard_from(self, start: float) -> None:
        """Discard the plan from a time on; a move that has begun is finished unless another begins."""
        for track in (self._arms, self._raised):
            track.discard_from(start)
            track.discard_before(start - TIMING.memory)
        self._beats = [one for one in self._beats if start - TIMING.memory < one.time < start + TIMING.rise]
        self.strokes = [one for one in self.strokes if one[0] < start]

    def at(
        self, standing: BodyParams, times: Float64[np.ndarray, " T"]
    ) -> tuple[BodyParams, Float64[np.ndarray, " T"]]:
        """Return frames of a body with its arms at given times, and the strength of beats there, -1 to 1."""
        states = self._arms(times)
        beat_curve = self._beat_curve(times)
        raised = self._raised(times)
        # Beats move the joints of raised arms on top of their gesture.
        for k, sign in ((0, 1.0), (1, -1.0)):
            beat = beat_curve * raised[:, k] * self._size
            states[:, 9 * k] += TIMING.beat_shoulder * beat
            states[:, 9 * k + 4] += sign * TIMING.beat_elbow * beat
            states[:, 9 * k + 8] -= sign * TIMING.beat_wrist * beat
        return pose_arms(standing, states, self.lexicon.rest), beat_curve * self._size

    def _beat_curve(self, times: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, " T"]:
        """Return a smooth curve that dips before a beat, is its weight at the beat, and falls to 0 after it."""
        out = np.zeros(len(times))
        for one in self._beats:
            # Each beat is a short pulse: a quintic rise with a dip before it, then (1 - u^2)^3.
            before, after = (times - one.time) / TIMING.rise, (times - one.time) / TIMING.fall
            rise = np.where((before > -1.0) & (before <= 0.0), _anticipation(before), 0.0)
            fall = np.where((after > 0.0) & (after < 1.0), (1.0 - after**2) ** 3, 0.0)
            out += one.weight * (rise + fall)
        return np.clip(out, -1.0, 1.0)

    def _plan_stroke(self, arrival: float, free: float) -> None:
        """Plan a move to the next gesture that ends at `arrival` and begins no earlier than `free`."""
        now = self._arms(np.array([free]))[0]
        rest, chosen, goal = self.lexicon.rest, -1, self.lexicon.rest
        # Try gestures until one can be reached in time, on a path clear of the body.
        for k in shuffle_recent_last(len(self.lexicon.pairs), self._recent, self._rng):
            size = self._size * float(self._rng.uniform(*TIMING.sizes))
            target = rest + size * (self.lexicon.states[k] - rest)
            target[:18] += self._size * TIMING.jitter * self._rng.normal(size=18).clip(-1.5, 1.5)
            if largest_rotation(now, target) / TIMING.speed > 1.6 * (arrival - free):
                continue
            if self.lexicon.is_path_clear(now, target):
                chosen, goal = k, target
                break
        if chosen < 0:
            return
        # Start as late as the speed allows, so that the hands rest or hold until then.
        start = max(free, arrival - max(largest_rotation(now, goal) / TIMING.speed, TIMING.min_move))
        self._arms.move(goal, start, arrival)
        far = [np.linalg.norm((goal - rest)[9 * k : 9 * k + 9]) > TIMING.raised for k in (0, 1)]
        self._raised.move(np.array(far, np.float64), start, arrival)
        self._recent = [*self._recent[-200:], chosen]
        self.strokes.append((arrival + TIMING.lead, self.lexicon.pairs[chosen]))


def _anticipation(u: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, " T"]:
    """Return a curve from 0 at -1 down to about -0.4 and up to 1 at 0, with zero slope at both ends."""
    s = np.clip(u + 1.0, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2) - 6.0 * s**2 * (1.0 - s) ** 2
