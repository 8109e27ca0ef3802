"""A motion of slow talking and gesturing: a person who stands and speaks, as long as one likes, never twice the same.

Arms and hands go through a vocabulary of gestures in shuffled rounds: each round has every gesture once, so that what
comes late has been shown early, after another gesture, in another size and at another pace. Mouth shapes come in rounds
too. Torso, weight, head, gaze, brows and blinks are tracks of their own. All tracks start neutral and at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from pipelines.synth.gestures import GESTURES, arms_pose, rounds
from pipelines.synth.motion import JAW_DEGREES, relaxed_pose, wander
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core.params import BodyParams
from smplxpp.core.validation import require_positive

# Shapes of the mouth.
_VISEMES: tuple[dict[str, float], ...] = (
    {"jawOpen": 0.34, "mouthLowerDownLeft": 0.25, "mouthLowerDownRight": 0.25},
    {"jawOpen": 0.46, "mouthStretchLeft": 0.15, "mouthStretchRight": 0.15},
    {"jawOpen": 0.12, "mouthFunnel": 0.5, "mouthPucker": 0.2},
    {"jawOpen": 0.18, "mouthPucker": 0.6},
    {"mouthPressLeft": 0.4, "mouthPressRight": 0.4, "mouthRollLower": 0.2, "mouthRollUpper": 0.15},
    {"jawOpen": 0.10, "mouthSmileLeft": 0.5, "mouthSmileRight": 0.48, "cheekSquintLeft": 0.2, "cheekSquintRight": 0.2},
    {"jawOpen": 0.20, "mouthUpperUpLeft": 0.25, "mouthUpperUpRight": 0.25},
    {"jawOpen": 0.14, "mouthRollLower": 0.35, "mouthUpperUpLeft": 0.12, "mouthUpperUpRight": 0.12},
)
_LOOKS: tuple[dict[str, float], ...] = (
    {},
    {"browInnerUp": 0.45},
    {"browOuterUpLeft": 0.45, "browOuterUpRight": 0.45, "eyeWideLeft": 0.15, "eyeWideRight": 0.15},
    {"browDownLeft": 0.35, "browDownRight": 0.35, "eyeSquintLeft": 0.2, "eyeSquintRight": 0.2},
    {"mouthSmileLeft": 0.25, "mouthSmileRight": 0.25, "cheekSquintLeft": 0.15, "cheekSquintRight": 0.15},
)
# Largest turns of the slow tracks in degrees, about x, y, z; shared among the joints by weights.
_TORSO, _HEAD = (4.0, 10.0, 3.0), (9.0, 18.0, 6.0)
_SPINE = {"spine1": 0.3, "spine2": 0.4, "spine3": 0.3}
_NECK = {"neck": 0.4, "head": 0.6}
_GAZE = (6.0, 12.0, 0.0)
# Small turns at any time: standard deviations in degrees.
_SWAY = {"spine2": 0.4, "neck": 0.6, "head": 0.9, "left_wrist": 3.0, "right_wrist": 3.0}
_BEAT = 3.0  # degrees by which the elbows mark what is said
_PACE = 110.0  # degrees a second: the mean speed of a large gesture's fastest joint
_MOVE, _HOLD = (0.5, 0.75), (0.25, 0.75)  # seconds; a large gesture takes longer
_PHRASE, _SILENCE, _SYLLABLE = (1.4, 3.6), (0.35, 0.9), (0.16, 0.30)
_BLINK = ((-0.09, 0.0), (0.0, 1.0), (0.05, 1.0), (0.20, 0.0))  # seconds and how far the lids are closed
_BETWEEN_BLINKS = (1.8, 4.6)
_SIZE = (0.88, 1.12)


@dataclass(frozen=True, eq=False)
class Talking:
    """What a person does who stands and talks, as a function of time.

    Attributes:
        betas: shape.
        expression_names: names of the E expressions.
        seconds: how long it lasts; later instants hold the last pose.
        seed: of everything.

    Raises:
        InputError: no time to talk.
    """

    feet_stay: ClassVar[bool] = True
    betas: Float[np.ndarray, " B"]
    expression_names: tuple[str, ...]
    seconds: float
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("seconds of talking", self.seconds)

    def at(self, times: Float[np.ndarray, " T"], *, fps: float | None = None) -> BodyParams:
        """Return the parameters at `times` in seconds; transl is zero, `fps` is stored as it is given."""
        t = np.clip(np.atleast_1d(np.asarray(times, dtype=np.float64)), 0.0, self.seconds)
        pose = self._arms(t) + self._slow_turns(t) + self._small_turns(t)
        expression = np.clip(self._words(t) + self._looks(t) + self._blinks(t), 0.0, 1.0)
        jaw = expression[:, self.expression_names.index("jawOpen")]
        pose[:, SMPLX_JOINTS.index("jaw"), 0] += np.radians(JAW_DEGREES) * jaw
        return BodyParams.from_full_pose(
            pose,
            betas=np.repeat(self.betas[None], len(t), axis=0),
            expression=expression,
            transl=np.zeros((len(t), 3)),
            fps=fps,
        )

    @cached_property
    def gestures(self) -> tuple[tuple[float, int], ...]:
        """When each gesture is reached, and its number in the vocabulary."""
        return tuple((end, number) for (_, end), number in zip(self._arms.moves, self._order, strict=True))

    @cached_property
    def blink_times(self) -> Float[np.ndarray, " N"]:
        """When the lids close."""
        rng = np.random.default_rng([self.seed, 3])
        times = np.cumsum(rng.uniform(*_BETWEEN_BLINKS, size=int(self.seconds / _BETWEEN_BLINKS[0]) + 2))
        return times[times < self.seconds]

    @cached_property
    def _order(self) -> list[int]:
        rng = np.random.default_rng([self.seed, 0])
        shortest = _MOVE[0] + _HOLD[0]
        return rounds(rng, len(GESTURES), int(self.seconds / shortest) + 2)

    @cached_property
    def _arms(self) -> _Track:
        """Poses (T, 55, 3) in radians: the relaxed pose with the arms and hands of the gestures."""
        rng = np.random.default_rng([self.seed, 1])
        keys, moves, time = [relaxed_pose()], [], 0.0
        moving = (arms_pose("hanging", "hanging", size=1.0) != 0).any(axis=1)[:, None]
        for number in self._order:
            # Of another size each time, and each joint a little elsewhere.
            target = arms_pose(*GESTURES[number], size=rng.uniform(*_SIZE))
            target += moving * np.radians(2.0) * np.clip(rng.normal(size=target.shape), -2, 2)
            way = np.degrees(np.linalg.norm(target - keys[-1], axis=1).max())
            move = max(rng.uniform(*_MOVE), way / _PACE * rng.uniform(0.95, 1.15))
            start = time + rng.uniform(*_HOLD)
            time = start + move
            keys.append(target)
            moves.append((start, time))
        return _Track(np.stack(keys), tuple(moves))

    def _slow_turns(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 55 3"]:
        """Turn torso and head, look somewhere, and stand on one leg more than on the other."""
        rng = np.random.default_rng([self.seed, 2])
        out = np.zeros((len(t), len(SMPLX_JOINTS), 3))
        torso = self._drawn(rng, _TORSO, (0.9, 1.6), (0.4, 1.6))(t)
        head = self._drawn(rng, _HEAD, (0.45, 0.9), (0.3, 1.4))(t)
        gaze = self._drawn(rng, _GAZE, (0.06, 0.09), (0.35, 1.6))(t)
        weight = self._drawn(rng, (1.0, 1.0, 1.0), (1.0, 1.8), (1.2, 3.0))(t)
        for shares, turn in ((_SPINE, torso), (_NECK, head - 0.4 * torso)):
            for name, share in shares.items():
                out[:, SMPLX_JOINTS.index(name)] += np.radians(share * turn)
        for name in ("left_eye_smplhf", "right_eye_smplhf"):
            out[:, SMPLX_JOINTS.index(name)] += np.radians(gaze)
        return out + _stance(weight[:, 0], weight[:, 1])

    def _drawn(
        self,
        rng: np.random.Generator,
        largest: Sequence[float],
        move: tuple[float, float],
        hold: tuple[float, float],
    ) -> _Track:
        """A track (T, 3) between values drawn within `largest`; its moves and holds last as long as is said."""
        keys, moves, time = [np.zeros(3)], [], 0.0
        while time < self.seconds:
            start = time + rng.uniform(*hold)
            time = start + rng.uniform(*move)
            keys.append(np.asarray(largest) * np.clip(0.55 * rng.normal(size=3), -1, 1))
            moves.append((start, time))
        return _Track(np.stack(keys), tuple(moves))

    def _small_turns(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 55 3"]:
        """Breath, small movements of the head, hands that mark what is said; none at the start."""
        rng = np.random.default_rng([self.seed, 4])
        out = np.zeros((len(t), len(SMPLX_JOINTS), 3))
        for name, degrees in _SWAY.items():
            out[:, SMPLX_JOINTS.index(name)] = np.radians(degrees) * wander(t, rng, hertz=0.5) / np.sqrt(2.0)
        beat = np.radians(_BEAT) * wander(t, rng, hertz=0.9)[:, 0] / np.sqrt(2.0)
        out[:, SMPLX_JOINTS.index("left_elbow"), 1] = -beat
        out[:, SMPLX_JOINTS.index("right_elbow"), 1] = beat
        return out * (1.0 - np.exp(-((t / 0.5) ** 2)))[:, None, None]

    @cached_property
    def _words(self) -> Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "T E"]]:
        """Expressions of the mouth: phrases of syllables, silences with the mouth closed."""
        rng = np.random.default_rng([self.seed, 5])
        times, keys = [0.0], [np.zeros(len(self.expression_names))]
        time = rng.uniform(*_SILENCE)
        order: list[int] = []
        while time < self.seconds + 1.0:
            times.append(time)
            keys.append(keys[0])
            end = time + rng.uniform(*_PHRASE)
            while time < end:
                time += rng.uniform(*_SYLLABLE)
                order = order or rounds(rng, len(_VISEMES), len(_VISEMES))
                times.append(time)
                keys.append(self._expression(_VISEMES[order.pop()], rng.uniform(0.75, 1.1)))
            time += rng.uniform(*_SYLLABLE)
            times.append(time)
            keys.append(keys[0])
            time += rng.uniform(*_SILENCE)
        return PchipInterpolator(np.array(times), np.stack(keys))

    @cached_property
    def _looks(self) -> Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "T E"]]:
        """Expressions of brows, cheeks and smiles, which change slowly."""
        rng = np.random.default_rng([self.seed, 6])
        keys, moves, time = [np.zeros(len(self.expression_names))], [], 0.0
        while time < self.seconds:
            for number in rounds(rng, len(_LOOKS), len(_LOOKS)):
                start = time + rng.uniform(0.6, 1.8)
                time = start + rng.uniform(0.25, 0.6)
                keys.append(self._expression(_LOOKS[number], rng.uniform(0.6, 1.1)))
                moves.append((start, time))
        return _Track(np.stack(keys), tuple(moves))

    def _blinks(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T E"]:
        seconds, closed = np.array(_BLINK).T
        shut = sum((np.interp(t - blink, seconds, closed) for blink in self.blink_times), np.zeros(len(t)))
        return shut[:, None] * self._expression({"eyeBlinkLeft": 0.97, "eyeBlinkRight": 0.97}, 1.0)

    def _expression(self, amounts: dict[str, float], size: float) -> Float[np.ndarray, " E"]:
        out = np.zeros(len(self.expression_names))
        for name, amount in amounts.items():
            out[self.expression_names.index(name)] = size * amount
        return out


@dataclass(frozen=True, eq=False)
class _Track:
    """Values that rest at keys and go from one to the next along minimum-jerk curves (Flash and Hogan 1985).

    Never beyond the keys, twice differentiable.

    Attributes:
        keys: one more than there are moves.
        moves: start and end of each way, seconds, ascending.
    """

    keys: Float[np.ndarray, " K *values"]
    moves: tuple[tuple[float, float], ...]

    def __call__(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T *values"]:
        start, end = np.array(self.moves).T
        k = np.clip(np.searchsorted(start, t, side="right") - 1, 0, len(start) - 1)
        u = np.clip((t - start[k]) / (end[k] - start[k]), 0.0, 1.0)
        s = (u**3 * (10.0 - 15.0 * u + 6.0 * u**2)).reshape(-1, *[1] * (self.keys.ndim - 1))
        return (1.0 - s) * self.keys[k] + s * self.keys[k + 1]


def _stance(side: Float[np.ndarray, " T"], turn: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 55 3"]:
    """Weight on one leg: the hip above it rises and moves over it, the other knee gives; feet stay where they are.

    `side` in [-1, 1] is 1 where she stands on her left leg alone, `turn` in [-1, 1] of the hips to her left.
    """
    out = np.zeros((len(side), len(SMPLX_JOINTS), 3))

    def add(name: str, axis: int, degrees: Float[np.ndarray, " T"]) -> None:
        out[:, SMPLX_JOINTS.index(name), axis] += np.radians(degrees)

    roll, lean, yaw = 2.5 * side, 2.2 * side, 5.0 * turn
    add("pelvis", 2, roll)
    add("pelvis", 1, yaw)
    add("spine1", 2, -roll)
    add("spine1", 1, -0.5 * yaw)
    for name, give in (("left", np.maximum(-side, 0.0)), ("right", np.maximum(side, 0.0))):
        add(f"{name}_hip", 2, -roll - lean)
        add(f"{name}_hip", 1, -yaw)
        add(f"{name}_ankle", 2, lean)
        add(f"{name}_hip", 0, -9.0 * give)
        add(f"{name}_knee", 0, 18.0 * give)
        add(f"{name}_ankle", 0, -9.0 * give)
    return out
