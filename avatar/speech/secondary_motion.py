"""Secondary motion of a standing person: blinks, gaze, head motion, breathing and postural sway, all from one seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from avatar.speech.standing_body import StandingBody
from avatar.speech.tracks import RandomTrack
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix


def blinks(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, " T"]:
    """Return how far the eyes are closed by blinks, 0 to 1.

    Intervals between blinks are exponential with a mean of 3.5 s and at least 0.8 s.
    """
    mean_interval, min_interval = 3.5, 0.8
    closing, closed, opening = 0.07, 0.04, 0.15  # seconds: the phases of a blink
    out = np.zeros(len(times))
    at = float(rng.uniform(min_interval, mean_interval))
    while len(times) and at < times[-1]:
        since = times - at
        # Closing and opening are ramps in time; their product is a trapezoid, and overlapping blinks take the larger
        # one.
        falls = np.clip(since / closing, 0.0, 1.0)
        rises = np.clip((since - closing - closed) / opening, 0.0, 1.0)
        out = np.maximum(out, falls * (1.0 - rises))
        at += min_interval + float(rng.exponential(mean_interval - min_interval))
    return out


def gaze(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, "T 3"]:
    """Return rotation vectors of both eyes: fixations between saccades, every other one on the viewer."""
    mean_fixation, saccade = 1.6, 0.04  # seconds
    spread = np.radians([1.2, 2.5, 0.0])  # standard deviation of a glance about x and y
    out = np.zeros((len(times), 3))
    at, now, away = 0.0, np.zeros(3), True
    while len(times) and at < times[-1]:
        at += 0.3 + float(rng.exponential(mean_fixation - 0.3))
        # Alternate between a glance aside and the viewer (zero); each saccade adds its step as a short ramp.
        goal = rng.normal(size=3).clip(-2.0, 2.0) * spread if away else np.zeros(3)
        out += np.clip((times - at) / saccade, 0.0, 1.0)[:, None] * (goal - now)
        now, away = goal, not away
    return out


def head_motion(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, "T 3"]:
    """Return rotation vectors of head and neck together: a sum of slow sines of random phase, zero at time 0."""
    amplitude = np.radians([1.6, 2.0, 0.8])  # about x, y and z
    out = np.zeros((len(times), 3))
    for hertz, share in ((0.13, 0.6), (0.31, 0.3), (0.73, 0.15)):
        # The value at time 0 is subtracted, so that the motion starts without a jump.
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        speed = 2.0 * np.pi * hertz * rng.uniform(0.85, 1.15, 3)
        out += share * amplitude * (np.sin(times[:, None] * speed + phase) - np.sin(phase))
    return out


def nods(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, " T"]:
    """Return the lowering of a listener's head, radians: one or two nods every few seconds."""
    interval, duration, depth = (1.5, 5.0), 0.5, np.radians(5.0)
    out = np.zeros(len(times))
    at = float(rng.uniform(*interval))
    while len(times) and at < times[-1]:
        # A second nod has 0.6 of the first one's depth.
        for k in range(int(rng.integers(1, 3))):
            u = np.clip((times - at - k * duration) / duration, 0.0, 1.0)
            out += depth * 0.6**k * np.sin(np.pi * u) ** 2
        at += 2.0 * duration + float(rng.uniform(*interval))
    return out


class PosturalSway:
    """Breathing, shifts of weight between the legs and rotations of the trunk, on planted feet.

    Args:
        body: the person.
        size: of all motion, 1 as designed.
        seed: of times and amplitudes.
    """

    def __init__(self, body: StandingBody, *, size: float = 1.0, seed: int = 0) -> None:
        self.body, self._size = body, size
        streams = [np.random.default_rng((seed, k)) for k in range(3)]
        self._phase = float(streams[0].uniform(0.0, 2.0 * np.pi))

        def draw_trunk(rng: np.random.Generator) -> Float64[np.ndarray, " 3"]:
            return (0.6 * rng.normal(size=3)).clip(-1.0, 1.0)

        def draw_weight(rng: np.random.Generator) -> Float64[np.ndarray, " 3"]:
            # Side of the leg that bears the weight, then yaw and fore shift, all in [-1, 1].
            side = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.0)
            return np.array([side, *draw_trunk(rng)[:2]])

        self._weight = RandomTrack(streams[1], draw_weight, np.zeros(3), moves=(1.2, 2.2), holds=(1.8, 5.5))
        self._trunk = RandomTrack(streams[2], draw_trunk, np.zeros(3), moves=(0.9, 1.7), holds=(0.4, 2.0))

    def at(
        self, frames: BodyParams, times: Float64[np.ndarray, " T"], activity: Float64[np.ndarray, " T"]
    ) -> tuple[BodyParams, Float64[np.ndarray, "T 3"]]:
        """Return frames that sway on planted feet, and the total rotation of the trunk, radians.

        Args:
            frames: the body with its arms.
            times: of the frames, seconds.
            activity: factor of the trunk's motion, 1 while the person talks.
        """
        # Amplitudes, set by eye: hips' shift to the side and forth in metres, hips' roll and yaw with all weight on one
        # leg, the spine about x, y, z, chest and collars in a breath.
        side_shift, fore_shift = 0.022, 0.006
        roll_size, yaw_size = np.radians([1.6, 3.0])
        trunk_size = np.radians([2.0, 4.0, 1.5])
        chest_size, collar_size = np.radians([0.5, 0.7])
        for one in (self._weight, self._trunk):
            one.discard_before(float(times[0]) - 60.0)
        # Random curves in [-1, 1], scaled to the amplitudes above; the trunk moves less while the person is silent.
        side, yaw, fore = (self._size * self._weight(times)).T
        trunk = self._size * activity[:, None] * trunk_size * self._trunk(times)
        # The hips turn and shift over the feet.
        turn = np.stack([0.0 * yaw, yaw_size * yaw, roll_size * side], axis=1)
        root = matrix_from_rotvec(np.asarray(frames.global_orient)) @ matrix_from_rotvec(turn)
        shift = np.stack([side_shift * side, 0.0 * side, fore_shift * fore], axis=1)
        # Shifts are given in the body's frame; only their horizontal part moves the root, the feet stay on the floor.
        facing = matrix_from_rotvec(np.asarray(frames.global_orient))
        level = np.einsum("tij,tj->ti", facing, shift) * [1.0, 0.0, 1.0]
        pose = np.array(frames.body_pose).reshape(len(frames), -1, 3)

        def add(name: str, vectors: Float64[np.ndarray, "T 3"]) -> None:
            row = SMPLX_JOINTS.index(name) - 1
            pose[:, row] = rotvec_from_matrix(matrix_from_rotvec(pose[:, row]) @ matrix_from_rotvec(vectors))

        # A breath takes 3.6 s; breathing in takes less of it than breathing out.
        angle = 2.0 * np.pi * times / 3.6 + self._phase
        breath = self._size * np.sin(angle + 0.35 * np.sin(angle))
        # The spine counters the hips' rotation, so that the shoulders stay nearly level.
        counter = trunk - turn * [0.0, 0.6, 1.0]
        for name, share in (("spine1", 0.3), ("spine2", 0.4), ("spine3", 0.3)):
            add(name, share * counter - (name == "spine3") * chest_size * breath[:, None] * [1.0, 0.0, 0.0])
        for name, sign in (("left_collar", 1.0), ("right_collar", -1.0)):
            add(name, sign * collar_size * breath[:, None] * [0.0, 0.0, 1.0])
        moved = replace(
            frames,
            global_orient=rotvec_from_matrix(root),
            transl=frames.transl + level,
            body_pose=pose.reshape(len(frames), -1),
        )
        return self.body.plant_feet(moved), trunk + turn * [0.0, 0.4, 0.0]
