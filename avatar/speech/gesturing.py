"""What arms do in time: strokes planned on the beats of a speech, held, taken back in pauses; beats laid over them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from avatar.speech.arms import Vocabulary, posed, shuffled, turned_between
from avatar.speech.phonemes import Speech
from avatar.speech.rhythm import Beat, beats
from avatar.speech.stance import Stance
from avatar.speech.tracks import Track
from smplxpp.core.params import BodyParams

_PACE = np.radians(150.0)  # a second: the mean speed of an arm's fastest joint
_SHORTEST, _REACHED = 0.4, 0.1  # seconds of a move; by which a shape is reached before its beat, which is struck in it
_LATEST = 0.35  # seconds: a gesture that could not be prepared in so many is left out
_HOLD, _PATIENCE = (0.35, 0.8), 2.4  # seconds a gesture is held; hands stay up if the next one comes within so many
_BACK = 1.3  # times as long as another move takes, hands are taken back in
_SIZES = (0.85, 1.1)  # of a shape, of its way from rest
_JITTER = np.radians(2.0)  # by which joints are elsewhere each time
_UP, _DOWN = 0.22, 0.28  # seconds before and behind a beat in which forearms rise and come back
_ELBOW, _WRIST, _SHOULDER = np.radians([8.0, 7.0, 2.0])  # of a beat
_KEEP = 60.0  # seconds of the past that may still be asked for
_RAISED = np.radians(25.0)  # from rest: an arm counts as raised, and marks beats


class Gesturing:
    """The arms of somebody who talks now and then.

    Args:
        size: of gestures, 0 (none) to 1. seed: of their order, sizes and pauses.
    """

    def __init__(self, stance: Stance, *, size: float = 1.0, seed: int = 0) -> None:
        self.vocabulary = Vocabulary.of(stance)
        self._size, self._rng = size, np.random.default_rng(seed)
        self._arms = Track(self.vocabulary.rest)
        self._raised = Track(np.zeros(2))
        self._beats: list[Beat] = []
        self.strokes: list[tuple[float, tuple[str, str]]] = []
        """When gestures were struck, seconds, and which."""
        self._recent: list[int] = []

    def plan(self, speech: Speech, start: float, *, more: bool) -> None:
        """Plan the gestures of a speech from a time on; `more`: another one follows, hands stay up at its end."""
        self.drop(start)
        if not self._size or not self.vocabulary.pairs:
            return
        rhythm = [Beat(one.time + start, one.weight, one.stroke) for one in beats(speech, self._rng)]
        self._beats += rhythm
        strokes = [one.time for one in rhythm if one.stroke]
        free = start
        for k, time in enumerate(strokes):
            arrival = time - _REACHED
            held = time + float(self._rng.uniform(*_HOLD))
            later = strokes[k + 1] if k + 1 < len(strokes) else np.inf
            if arrival - free < _LATEST:
                continue
            self._stroke(arrival, free)
            free = held
            ends = more and later == np.inf
            if not ends and later - held > _PATIENCE:
                self.rest(max(held, min(start + speech.seconds - 0.2, held + 0.8)) if later == np.inf else held)
                free = self._arms.end if later - self._arms.end > _LATEST else held

    def rest(self, start: float) -> None:
        """Take the hands back from a time on, unless they rest."""
        away = turned_between(self._arms.target, self.vocabulary.rest)
        if away < 1e-6:
            return
        jitter = self._size * 0.5 * _JITTER * self._rng.normal(size=18).clip(-1.5, 1.5)
        rest = self.vocabulary.rest + np.concatenate([jitter, np.zeros(4)])
        end = start + max(_BACK * away / _PACE, 0.8)
        self._arms.move(rest if away > _RAISED else self.vocabulary.rest, start, end)
        self._raised.move(np.zeros(2), start, start + 0.4)

    @property
    def resting(self) -> bool:
        """Whether the hands are on their way back, or rest."""
        return turned_between(self._arms.target, self.vocabulary.rest) < 4.0 * _JITTER

    def drop(self, start: float) -> None:
        """Forget what was planned from a time on; a move under way is finished unless another begins."""
        for track in (self._arms, self._raised):
            track.drop(start)
            track.forget(start - _KEEP)
        self._beats = [one for one in self._beats if start - _KEEP < one.time < start + _UP]
        self.strokes = [one for one in self.strokes if one[0] < start]

    def at(self, still: BodyParams, times: Float64[np.ndarray, " T"]) -> tuple[BodyParams, Float64[np.ndarray, " T"]]:
        """Return frames of a body with its arms at times, and how strongly beats are marked then, -1 to 1."""
        states = self._arms(times)
        mark = self._marks(times)
        up = self._raised(times)
        for k, sign in ((0, 1.0), (1, -1.0)):
            beat = mark * up[:, k] * self._size
            states[:, 9 * k] += _SHOULDER * beat
            states[:, 9 * k + 4] += sign * _ELBOW * beat
            states[:, 9 * k + 8] -= sign * _WRIST * beat
        return posed(still, states, self.vocabulary.rest), mark * self._size

    def _marks(self, times: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, " T"]:
        """The beats' curve: back before a beat, 1 at a strong one, 0 again behind it; smooth."""
        out = np.zeros(len(times))
        for one in self._beats:
            before, behind = (times - one.time) / _UP, (times - one.time) / _DOWN
            rise = np.where((before > -1.0) & (before <= 0.0), _bump(before), 0.0)
            fall = np.where((behind > 0.0) & (behind < 1.0), (1.0 - behind**2) ** 3, 0.0)
            out += one.weight * (rise + fall)
        return np.clip(out, -1.0, 1.0)

    def _stroke(self, arrival: float, free: float) -> None:
        """Reach the next gesture at a time, having begun no earlier than allowed."""
        now = self._arms(np.array([free]))[0]
        rest, chosen, goal = self.vocabulary.rest, -1, self.vocabulary.rest
        for k in shuffled(len(self.vocabulary.pairs), self._recent, self._rng):
            size = self._size * float(self._rng.uniform(*_SIZES))
            target = rest + size * (self.vocabulary.states[k] - rest)
            target[:18] += self._size * _JITTER * self._rng.normal(size=18).clip(-1.5, 1.5)
            if turned_between(now, target) / _PACE > 1.6 * (arrival - free):
                continue  # no time to get there
            if self.vocabulary.clear(now, target):
                chosen, goal = k, target
                break
        if chosen < 0:
            return
        start = max(free, arrival - max(turned_between(now, goal) / _PACE, _SHORTEST))
        self._arms.move(goal, start, arrival)
        far = [np.linalg.norm((goal - rest)[9 * k : 9 * k + 9]) > _RAISED for k in (0, 1)]
        self._raised.move(np.array(far, np.float64), start, arrival)
        self._recent = [*self._recent[-200:], chosen]
        self.strokes.append((arrival + _REACHED, self.vocabulary.pairs[chosen]))


def _bump(u: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, " T"]:
    """From 0 at -1 down to about -0.4 and up to 1 at 0, flat at both ends."""
    s = np.clip(u + 1.0, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2) - 6.0 * s**2 * (1.0 - s) ** 2
