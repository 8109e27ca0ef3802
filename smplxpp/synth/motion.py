"""Motions of the fixture person: gestures, talking, a turn with steps, and a turn on the spot before one camera.

A performance is a smooth curve through key poses, defined at every instant, so that cloth can be simulated with shorter
steps than frames. It starts at rest from a relaxed A-pose with a neutral face.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np
from jaxtyping import Float, Float64
from scipy.interpolate import CubicSpline, PchipInterpolator

from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.errors import one_line
from smplxpp.core.params import POSE_BLOCKS

# Axis-angle rotation of each joint in degrees, in the T-pose's world axes (x to the subject's left, y up, z to the
# front). Joints that a pose does not name stay relaxed.
_Angles = dict[str, tuple[float, float, float]]
_RELAXED: _Angles = {
    "left_collar": (0, 0, -4),
    "right_collar": (0, 0, 4),
    "left_shoulder": (0, -6, -46),
    "right_shoulder": (0, 6, 46),
    "left_elbow": (0, -14, 0),
    "right_elbow": (0, 14, 0),
}
_POSES: dict[str, _Angles] = {
    "relaxed": {},
    "explain": {  # both hands before the belly
        "left_shoulder": (10, -40, -52),
        "right_shoulder": (10, 40, 52),
        "left_elbow": (-20, -70, 10),
        "right_elbow": (-10, 55, -5),
        "head": (5, 10, 0),
        "left_wrist": (25, 0, 0),
        "right_wrist": (30, 0, 0),
    },
    "stress": {  # the hands part and fall a little, weight on one leg
        "left_shoulder": (16, -30, -46),
        "right_shoulder": (16, 30, 46),
        "spine1": (0, 0, 3),
        "pelvis": (0, 4, -2),
        "left_elbow": (-20, -60, 6),
        "right_elbow": (-14, 66, -6),
        "head": (-3, -6, 2),
        "left_wrist": (45, 0, 0),
        "right_wrist": (45, 0, 0),
    },
    "step": {  # turning to the left on the right foot
        "pelvis": (0, 34, 0),
        "left_hip": (-36, 10, 3),
        "left_knee": (46, 0, 0),
        "right_hip": (8, -12, 0),
        "left_ankle": (-6, 0, 0),
        "spine2": (0, 6, 0),
        "head": (0, 18, 0),
        "right_shoulder": (0, 26, 50),
        "left_shoulder": (0, 8, -48),
        "right_elbow": (0, 30, 0),
    },
    "turned": {
        "pelvis": (0, 62, 0),
        "left_hip": (-12, 8, 2),
        "left_knee": (10, 0, 0),
        "right_hip": (12, -16, 0),
        "right_knee": (6, 0, 0),
        "right_ankle": (-14, 0, 0),
        "spine2": (0, -6, 0),
        "head": (0, -12, 0),
        "left_shoulder": (0, -30, -40),
        "left_elbow": (0, -40, 0),
        "right_shoulder": (0, 20, 50),
    },
    "point": {  # to her left, looking there
        "pelvis": (0, 48, 0),
        "left_shoulder": (0, -25, -10),
        "left_elbow": (0, -10, 0),
        "head": (0, 26, 0),
        "spine3": (0, 12, 0),
        "neck": (0, 8, 0),
    },
    "twist": {  # back to the right
        "pelvis": (0, 10, 0),
        "spine1": (0, -12, 0),
        "spine2": (0, -16, 0),
        "spine3": (0, -12, 0),
        "head": (0, -15, 0),
        "left_shoulder": (0, -45, -40),
        "right_shoulder": (0, -15, 50),
        "right_hip": (-14, 0, 0),
        "right_knee": (20, 0, 0),
    },
    "overhead": {
        "left_collar": (0, 0, 18),
        "right_collar": (0, 0, -18),
        "left_shoulder": (0, 0, 50),
        "right_shoulder": (0, 0, -50),
        "left_elbow": (0, -8, 8),
        "right_elbow": (0, 8, -8),
        "head": (-8, 0, 0),
    },
}
# Bend of the fingers of the left and of the right hand, degrees; other poses have the relaxed bend.
_FINGERS = {
    "relaxed": (12.0, 12.0),
    "explain": (22.0, 6.0),
    "stress": (4.0, 16.0),
    "point": (3.0, 12.0),
}
# Instants (seconds) and poses of the opening; a longer performance continues with random poses.
_SCRIPT = (
    (0.0, "relaxed"),
    (0.4, "explain"),
    (0.75, "stress"),
    (1.15, "step"),
    (1.6, "turned"),
    (2.3, "twist"),
    (2.9, "overhead"),
    (3.6, "point"),
)

# Mouth shapes while she talks, and looks of the rest of the face, as weights of expressions.
_VISEMES: tuple[dict[str, float], ...] = (
    {"jawOpen": 0.30, "mouthLowerDownLeft": 0.3, "mouthLowerDownRight": 0.3},
    {"jawOpen": 0.10, "mouthFunnel": 0.5, "mouthPucker": 0.2},
    {"mouthPressLeft": 0.4, "mouthPressRight": 0.4, "mouthRollLower": 0.2},
    {"jawOpen": 0.42, "mouthStretchLeft": 0.2, "mouthStretchRight": 0.2},
    {"jawOpen": 0.08, "mouthSmileLeft": 0.6, "mouthSmileRight": 0.55, "cheekSquintLeft": 0.3, "cheekSquintRight": 0.3},
    {"jawOpen": 0.18, "mouthPucker": 0.6},
    {"jawOpen": 0.22, "mouthUpperUpLeft": 0.25, "mouthUpperUpRight": 0.25, "mouthDimpleLeft": 0.2},
)
_LOOKS: tuple[dict[str, float], ...] = (
    {},
    {"browInnerUp": 0.5},
    {"browOuterUpLeft": 0.5, "browOuterUpRight": 0.5, "eyeWideLeft": 0.2, "eyeWideRight": 0.2},
    {"browDownLeft": 0.4, "browDownRight": 0.4, "eyeSquintLeft": 0.25, "eyeSquintRight": 0.25},
)
JAW_DEGREES = 9.0
"""Rotation of the jaw at a weight of 1 of `jawOpen`."""


class Motion(Protocol):
    """The motion of a person as a function of time.

    Attributes:
        feet_stay: whether the feet keep their place on the floor while the hips move over them.
    """

    feet_stay: ClassVar[bool]

    def at(self, times: Float[np.ndarray, " T"], *, fps: float | None = None) -> BodyParams:
        """Return the parameters at `times` in seconds, transl zero."""
        ...


@dataclass(frozen=True, eq=False)
class SeededMotion:
    """A motion of a length, made of a seed.

    Attributes:
        betas: shape coefficients.
        expression_names: names of the E expressions.
        seconds: duration; later instants hold the last pose.
        seed: seed of everything that is drawn at random.
    """

    betas: Float[np.ndarray, " B"]
    expression_names: tuple[str, ...]
    seconds: float
    seed: int = 0

    __repr__ = one_line

    def instants(self, times: Float[np.ndarray, " T"]) -> Float64[np.ndarray, " T"]:
        """Return times cut to the duration, seconds."""
        return np.clip(np.atleast_1d(np.asarray(times, dtype=np.float64)), 0.0, self.seconds)


@dataclass(frozen=True, eq=False)
class Performance(SeededMotion):
    """A performance of gestures, speech and a turn, as a function of time."""

    feet_stay: ClassVar[bool] = False

    __repr__ = one_line

    def at(self, times: Float[np.ndarray, " T"], *, fps: float | None = None) -> BodyParams:
        """Return the parameters at `times` in seconds; transl is zero, `fps` is stored as it is given."""
        t = self.instants(times)
        pose, expression = self._poses(t), np.clip(self._faces(t), 0.0, 1.0)
        pose = pose + self._sway(t)
        pose[:, SMPLX_JOINTS.index("jaw"), 0] += (
            np.radians(JAW_DEGREES) * expression[:, self.expression_names.index("jawOpen")]
        )
        return BodyParams.from_full_pose(
            pose,
            betas=np.repeat(self.betas[None], len(t), axis=0),
            expression=expression,
            transl=np.zeros((len(t), 3)),
            fps=fps,
        )

    @cached_property
    def _poses(self) -> CubicSpline:
        """Spline from instants (T,) to poses (T, 55, 3) in radians, at rest at both ends."""
        rng = np.random.default_rng(self.seed)
        times, names = map(list, zip(*_SCRIPT, strict=True))
        # After the opening, random poses 0.5 to 0.8 s apart.
        while times[-1] < self.seconds + 1.0:
            times.append(times[-1] + rng.uniform(0.5, 0.8))
            names.append(rng.choice([name for name in _POSES if name != names[-1]]))
        keys = np.stack([_pose(_RELAXED | _POSES[name], _FINGERS.get(name, _FINGERS["relaxed"])) for name in names])
        relaxed = keys[0]
        # Each gesture varies by 10 % in size and 40 ms in time.
        size = rng.uniform(0.9, 1.1, size=(len(keys), 1, 1))
        late = rng.uniform(-0.04, 0.04, len(times)) * (np.array(times) > 0)
        return CubicSpline(np.array(times) + late, relaxed + size * (keys - relaxed), bc_type="clamped")

    @cached_property
    def _faces(self) -> PchipInterpolator:
        """Spline from instants (T,) to expressions (T, E): about five mouth shapes a second, looks and blinks.

        It is monotone between keys and so stays within [0, 1].
        """
        rng = np.random.default_rng([self.seed, 1])
        times = np.concatenate([[0.0], 0.12 + np.cumsum(rng.uniform(0.13, 0.26, int(self.seconds / 0.13) + 8))])
        values = np.zeros((len(times), len(self.expression_names)))
        look: dict[str, float] = {}
        for k in range(1, len(times)):
            # The look changes with every third mouth shape; one in eight comes with a blink.
            if k % 3 == 1:
                look = _LOOKS[rng.integers(len(_LOOKS))]
            closed = {"eyeBlinkLeft": 0.95, "eyeBlinkRight": 0.95} if rng.uniform() < 0.12 else {}
            word = _VISEMES[rng.integers(len(_VISEMES))]
            for name, amount in (word | look | closed).items():
                values[k, self.expression_names.index(name)] = amount * rng.uniform(0.8, 1.05)
        return PchipInterpolator(times, values)

    def _sway(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 55 3"]:
        """Return small rotations in radians: breath, small movements of head and eyes; none at the start."""
        rng = np.random.default_rng([self.seed, 2])
        out = np.zeros((len(t), len(SMPLX_JOINTS), 3))
        sizes = {"spine2": 0.6, "neck": 1.2, "head": 1.8, "left_wrist": 3.0, "right_wrist": 3.0}
        for name, degrees in sizes.items():
            out[:, SMPLX_JOINTS.index(name)] = np.radians(degrees) * wander(t, rng, hertz=1.1)
        # Both eyes turn together, without roll.
        gaze = np.radians(2.5) * wander(t, rng, hertz=1.6)
        gaze[:, 2] = 0.0
        for name in ("left_eye_smplhf", "right_eye_smplhf"):
            out[:, SMPLX_JOINTS.index(name)] = gaze
        return out * (1.0 - np.exp(-((t / 0.3) ** 2)))[:, None, None]


def relaxed_pose() -> Float[np.ndarray, "55 3"]:
    """Return the relaxed A-pose with which a performance starts, axis-angle in radians."""
    return _pose(_RELAXED, _FINGERS["relaxed"])


def wander(t: Float[np.ndarray, " T"], rng: np.random.Generator, *, hertz: float) -> Float[np.ndarray, "T 3"]:
    """Return smooth curves of about unit size: the sum of four sines on each axis."""
    frequency = hertz * rng.uniform(0.4, 1.6, size=(4, 3))
    phase = rng.uniform(0, 2 * np.pi, size=(4, 3))
    return np.sin(2 * np.pi * frequency * t[:, None, None] + phase).sum(axis=1) / np.sqrt(2.0)


def _pose(degrees: _Angles, fingers: tuple[float, float]) -> Float[np.ndarray, "55 3"]:
    """Return an axis-angle pose in radians; `fingers` are the bends of the left and right hand in degrees."""
    pose = np.zeros((sum(joints for _, joints in POSE_BLOCKS), 3))
    for j, name in enumerate(SMPLX_JOINTS):
        # Fingers bend about z, mirrored between the hands.
        if name[-1].isdigit() and not name.startswith("spine") and "thumb" not in name:
            pose[j, 2] = -fingers[0] if name.startswith("left") else fingers[1]
    for name, angles in degrees.items():
        pose[SMPLX_JOINTS.index(name)] = angles
    return np.radians(pose)


# Standard deviation of each joint's sway about each axis, degrees.
_SWAY = {
    "spine1": 1.0,
    "spine2": 1.0,
    "neck": 2.0,
    "head": 3.0,
    "left_shoulder": 4.0,
    "right_shoulder": 4.0,
    "left_elbow": 4.0,
    "right_elbow": 4.0,
    "left_wrist": 4.0,
    "right_wrist": 4.0,
    "left_hip": 2.0,
    "right_hip": 2.0,
}
_LEAN_DEGREES, _DRIFT_M = 1.0, 0.03  # standard deviation of the trunk's lean, and of its place on the floor


@dataclass(frozen=True, eq=False)
class Turntable(SeededMotion):
    """One turn to the left on the spot within the duration, arms away from the body, the face neutral.

    The pose is not held still while turning: the arms sway by some degrees, the weight shifts from foot to foot, the
    head looks around. Poses of frames differ by this sway and by the heading.
    """

    feet_stay: ClassVar[bool] = False

    __repr__ = one_line

    def at(self, times: Float[np.ndarray, " T"], *, fps: float | None = None) -> BodyParams:
        """Return the parameters at `times` in seconds; `fps` is stored as it is given."""
        turn_degrees = 345.0  # from the first frame to the last, which therefore do not show the same side
        t = self.instants(times)
        rng = np.random.default_rng([self.seed, 7])
        # The performance begins at rest, so that cloth starts settled; all sway grows within half a second.
        grown = (1.0 - np.exp(-((t / 0.5) ** 2)))[:, None]
        pose = np.repeat(relaxed_pose()[None], len(t), axis=0)
        for name, degrees in _SWAY.items():
            pose[:, SMPLX_JOINTS.index(name)] += np.radians(degrees) * grown * wander(t, rng, hertz=0.5)
        turn = np.radians(turn_degrees) * t / max(self.seconds, 1e-9)
        lean = np.radians(_LEAN_DEGREES) * grown * wander(t, rng, hertz=0.4)
        pose[:, 0] = _rotvec_about_y_then(turn, lean)
        drift = _DRIFT_M * grown * wander(t, rng, hertz=0.2)
        drift[:, 1] = 0.0
        return BodyParams.from_full_pose(
            pose,
            betas=np.repeat(self.betas[None], len(t), axis=0),
            expression=np.zeros((len(t), len(self.expression_names))),
            transl=drift,
            fps=fps,
        )


def _rotvec_about_y_then(turn: Float[np.ndarray, " T"], lean: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Return the rotation vectors of a turn about the vertical that is applied after a small lean."""
    upright = np.zeros((len(turn), 3))
    upright[:, 1] = turn
    return rotvec_from_matrix(matrix_from_rotvec(upright) @ matrix_from_rotvec(lean))
