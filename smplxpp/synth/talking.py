"""A motion of slow talking and gesturing, of any length and without repetition: a person who stands and speaks.

Arms and hands perform a vocabulary of gestures in shuffled rounds. Each round has every gesture once, so that late
gestures have been seen early, after another gesture, at another size and pace. Mouth shapes come in rounds too. Torso,
weight, head, gaze, brows and blinks are tracks of their own. All tracks start neutral and at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.named_poses import ARM_JOINTS, ARM_POSES, MIRROR, ArmPose
from smplxpp.core import BodyParams, require_positive
from smplxpp.core.errors import one_line
from smplxpp.synth.motion import JAW_DEGREES, SeededMotion, relaxed_pose, wander

# Mouth shapes, and looks of the rest of the face, as weights of expressions.
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
# The gestures: pose of the left arm and of the right arm.
GESTURES = (
    ("hanging", "hanging"),
    ("belly", "belly"),
    ("front", "front"),
    ("offered", "offered"),
    ("wide", "wide"),
    ("raised", "low"),
    ("low", "raised"),
    ("belly", "offered"),
    ("front", "belly"),
    ("counting", "belly"),
    ("hanging", "chest"),
    ("wide", "hanging"),
)


@dataclass(frozen=True)
class _Tempo:
    """Durations in seconds, drawn uniformly between two bounds. They were set by eye for a calm speaker.

    Attributes:
        move: duration of a gesture's movement; a large one takes longer.
        hold: duration of the rest after it.
        phrase: duration of a phrase.
        silence: pause between phrases.
        syllable: duration of one mouth shape.
        between_blinks: time from blink to blink.
        degrees_per_second: mean speed of a large gesture's fastest joint.
    """

    move: tuple[float, float] = (0.5, 0.75)
    hold: tuple[float, float] = (0.25, 0.75)
    phrase: tuple[float, float] = (1.4, 3.6)
    silence: tuple[float, float] = (0.35, 0.9)
    syllable: tuple[float, float] = (0.16, 0.30)
    between_blinks: tuple[float, float] = (1.8, 4.6)
    degrees_per_second: float = 110.0


_TEMPO = _Tempo()


@dataclass(frozen=True, eq=False)
class Talking(SeededMotion):
    """The motion of a person who stands and talks, as a function of time.

    Raises:
        InputError: a duration that is not above 0.
    """

    feet_stay: ClassVar[bool] = True

    __repr__ = one_line

    def __post_init__(self) -> None:
        require_positive("seconds of talking", self.seconds)

    def at(self, times: Float[np.ndarray, " T"], *, fps: float | None = None) -> BodyParams:
        """Return the parameters at `times` in seconds; transl is zero, `fps` is stored as it is given."""
        t = self.instants(times)
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
        """Instant at which each gesture is reached, seconds, and its number in `GESTURES`."""
        return tuple((end, number) for (_, end), number in zip(self._arms.moves, self._order, strict=True))

    @cached_property
    def blink_times(self) -> Float[np.ndarray, " N"]:
        """Instants at which the eyelids close, seconds."""
        rng = np.random.default_rng([self.seed, 3])
        times = np.cumsum(rng.uniform(*_TEMPO.between_blinks, size=int(self.seconds / _TEMPO.between_blinks[0]) + 2))
        return times[times < self.seconds]

    @cached_property
    def _order(self) -> list[int]:
        rng = np.random.default_rng([self.seed, 0])
        # As many gestures as fit if all were the fastest.
        shortest = _TEMPO.move[0] + _TEMPO.hold[0]
        return rounds(rng, len(GESTURES), int(self.seconds / shortest) + 2)

    @cached_property
    def _arms(self) -> _Track:
        """Track of poses (T, 55, 3) in radians: the relaxed pose with the arms and hands of the gestures."""
        rng = np.random.default_rng([self.seed, 1])
        keys, moves, time = [relaxed_pose()], [], 0.0
        moving = (arms_pose("hanging", "hanging", size=1.0) != 0).any(axis=1)[:, None]
        for number in self._order:
            # Size varies, and each joint by 2 degrees, so that no gesture is repeated exactly.
            target = arms_pose(*GESTURES[number], size=rng.uniform(0.88, 1.12))
            target += moving * np.radians(2.0) * np.clip(rng.normal(size=target.shape), -2, 2)
            # The largest rotation of a joint sets the least duration.
            angle = np.degrees(np.linalg.norm(target - keys[-1], axis=1).max())
            move = max(rng.uniform(*_TEMPO.move), angle / _TEMPO.degrees_per_second * rng.uniform(0.95, 1.15))
            start = time + rng.uniform(*_TEMPO.hold)
            time = start + move
            keys.append(target)
            moves.append((start, time))
        return _Track(np.stack(keys), tuple(moves))

    def _slow_turns(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 55 3"]:
        """Return slow rotations in radians: of torso, head and gaze, and of the weight from leg to leg."""
        # Largest angles about x, y, z in degrees; spine and neck share them among their joints.
        rng = np.random.default_rng([self.seed, 2])
        out = np.zeros((len(t), len(SMPLX_JOINTS), 3))
        torso = self._drawn(rng, (4.0, 10.0, 3.0), (0.9, 1.6), (0.4, 1.6))(t)
        head = self._drawn(rng, (9.0, 18.0, 6.0), (0.45, 0.9), (0.3, 1.4))(t)
        gaze = self._drawn(rng, (6.0, 12.0, 0.0), (0.06, 0.09), (0.35, 1.6))(t)
        weight = self._drawn(rng, (1.0, 1.0, 1.0), (1.0, 1.8), (1.2, 3.0))(t)
        spine, neck = {"spine1": 0.3, "spine2": 0.4, "spine3": 0.3}, {"neck": 0.4, "head": 0.6}
        for shares, turn in ((spine, torso), (neck, head - 0.4 * torso)):
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
        """Return a track (T, 3) between values drawn within `largest`, with the given ranges of durations."""
        keys, moves, time = [np.zeros(3)], [], 0.0
        while time < self.seconds:
            start = time + rng.uniform(*hold)
            time = start + rng.uniform(*move)
            # Normal deviates, clipped so that none exceeds the largest value.
            keys.append(np.asarray(largest) * np.clip(0.55 * rng.normal(size=3), -1, 1))
            moves.append((start, time))
        return _Track(np.stack(keys), tuple(moves))

    def _small_turns(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 55 3"]:
        """Return small rotations in radians: breath, head and beats of the hands; none at the start."""
        # Standard deviations in degrees.
        sway = {"spine2": 0.4, "neck": 0.6, "head": 0.9, "left_wrist": 3.0, "right_wrist": 3.0}
        rng = np.random.default_rng([self.seed, 4])
        out = np.zeros((len(t), len(SMPLX_JOINTS), 3))
        for name, degrees in sway.items():
            out[:, SMPLX_JOINTS.index(name)] = np.radians(degrees) * wander(t, rng, hertz=0.5) / np.sqrt(2.0)
        # Elbows mark speech with beats of 3 degrees.
        beat = np.radians(3.0) * wander(t, rng, hertz=0.9)[:, 0] / np.sqrt(2.0)
        out[:, SMPLX_JOINTS.index("left_elbow"), 1] = -beat
        out[:, SMPLX_JOINTS.index("right_elbow"), 1] = beat
        return out * (1.0 - np.exp(-((t / 0.5) ** 2)))[:, None, None]

    @cached_property
    def _words(self) -> Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "T E"]]:
        """Track of mouth expressions: phrases of syllables, and silences with the mouth closed."""
        rng = np.random.default_rng([self.seed, 5])
        times, keys = [0.0], [np.zeros(len(self.expression_names))]
        time = rng.uniform(*_TEMPO.silence)
        order: list[int] = []
        while time < self.seconds + 1.0:
            times.append(time)
            keys.append(keys[0])
            end = time + rng.uniform(*_TEMPO.phrase)
            # Mouth shapes come in shuffled rounds as well.
            while time < end:
                time += rng.uniform(*_TEMPO.syllable)
                order = order or rounds(rng, len(_VISEMES), len(_VISEMES))
                times.append(time)
                keys.append(self._expression(_VISEMES[order.pop()], rng.uniform(0.75, 1.1)))
            time += rng.uniform(*_TEMPO.syllable)
            times.append(time)
            keys.append(keys[0])
            time += rng.uniform(*_TEMPO.silence)
        return PchipInterpolator(np.array(times), np.stack(keys))

    @cached_property
    def _looks(self) -> Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "T E"]]:
        """Track of slowly changing brows, cheeks and smiles."""
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
        # Seconds from the blink, and how far the lids are closed.
        seconds, closed = np.array(((-0.09, 0.0), (0.0, 1.0), (0.05, 1.0), (0.20, 0.0))).T
        # Blinks add up; the sum is clipped with the other expressions.
        shut = sum((np.interp(t - blink, seconds, closed) for blink in self.blink_times), np.zeros(len(t)))
        return shut[:, None] * self._expression({"eyeBlinkLeft": 0.97, "eyeBlinkRight": 0.97}, 1.0)

    def _expression(self, amounts: dict[str, float], size: float) -> Float[np.ndarray, " E"]:
        out = np.zeros(len(self.expression_names))
        for name, amount in amounts.items():
            out[self.expression_names.index(name)] = size * amount
        return out


@dataclass(frozen=True, eq=False)
class _Track:
    """Values that rest at keys and move between them along minimum-jerk curves (Flash and Hogan 1985).

    The curve is twice differentiable and stays between its keys.

    Attributes:
        keys: values, one more than there are moves.
        moves: start and end of each move, seconds, ascending.
    """

    keys: Float[np.ndarray, " K *values"]
    moves: tuple[tuple[float, float], ...]

    def __call__(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T *values"]:
        start, end = np.array(self.moves).T
        # The move that has started last; u runs from 0 to 1 within it.
        k = np.clip(np.searchsorted(start, t, side="right") - 1, 0, len(start) - 1)
        u = np.clip((t - start[k]) / (end[k] - start[k]), 0.0, 1.0)
        s = (u**3 * (10.0 - 15.0 * u + 6.0 * u**2)).reshape(-1, *[1] * (self.keys.ndim - 1))
        return (1.0 - s) * self.keys[k] + s * self.keys[k + 1]


def _stance(side: Float[np.ndarray, " T"], turn: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 55 3"]:
    """Return rotations that put the weight on one leg: its hip rises and moves over it, the other knee bends.

    Args:
        side: from -1 (right leg alone) to 1 (left leg alone).
        turn: rotation of the hips, from -1 to 1 (to her left).
    """
    out = np.zeros((len(side), len(SMPLX_JOINTS), 3))

    def add(name: str, axis: int, degrees: Float[np.ndarray, " T"]) -> None:
        out[:, SMPLX_JOINTS.index(name), axis] += np.radians(degrees)

    # Degrees; ankles and spine compensate, so that feet and shoulders stay.
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


def rounds(rng: np.random.Generator, count: int, least: int) -> list[int]:
    """Return shuffled rounds of 0 .. count - 1, at least `least` numbers, none twice in succession."""
    out: list[int] = []
    while len(out) < least:
        some = rng.permutation(count).tolist()
        if out and some[0] == out[-1]:
            some = some[1:] + some[:1]
        out += some
    return out


def arms_pose(left: str, right: str, *, size: float) -> Float[np.ndarray, "55 3"]:
    """Return the relaxed pose with arms in named poses; `size` scales their difference from hanging arms."""
    pose = relaxed_pose()
    for side, name in (("left", left), ("right", right)):
        for joint, turn in _arm_turns(ARM_POSES[name], ARM_POSES["hanging"], size).items():
            pose[SMPLX_JOINTS.index(f"{side}_{joint}")] = turn if side == "left" else turn * MIRROR
    return pose


def _arm_turns(arm: ArmPose, hanging: ArmPose, size: float) -> dict[str, Float[np.ndarray, " 3"]]:
    """Return axis-angle rotations of the left arm's joints, radians, by name without the side."""

    def sized(name: str) -> float:
        at_rest = float(getattr(hanging, name))
        return at_rest + size * (float(getattr(arm, name)) - at_rest)

    down, forward, inward, bend, palm = map(sized, ("down", "forward", "inward", "bend", "palm"))
    out = dict(zip(ARM_JOINTS, ArmPose(down, forward, inward, bend, palm).rotations, strict=True))
    for finger in ("index", "middle", "ring", "pinky"):
        bend = np.radians(arm.fingers[0 if finger == "index" else 1])
        out |= {f"{finger}{k}": np.array([0.0, 0.0, -bend]) for k in (1, 2, 3)}
    return out
