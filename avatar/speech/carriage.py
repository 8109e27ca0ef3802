"""How a body that stands moves of itself: breath, weight from leg to leg, a turn of the trunk; feet stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from avatar.speech.stance import Stance
from avatar.speech.tracks import Wandering
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix

_BREATH = 3.6  # seconds of a breath
_SIDE, _FORE = 0.022, 0.006  # metres that hips go to a side, and forth, over the feet
_ROLL, _YAW = np.radians([1.6, 3.0])  # of the hips, with all weight on one leg
_TRUNK = np.radians([2.0, 4.0, 1.5])  # of the spine about x, y, z, while one talks
_SPINE = {"spine1": 0.3, "spine2": 0.4, "spine3": 0.3}
_CHEST, _COLLAR = np.radians([0.5, 0.7])  # of a breath
_SPREAD = 0.6  # standard deviation of what is drawn, of the largest
_KEEP = 60.0


class Carriage:
    """Breath, weight and trunk of one body through time.

    Args:
        size: of all that, 1 as designed. seed: when and how far.
    """

    def __init__(self, stance: Stance, *, size: float = 1.0, seed: int = 0) -> None:
        self.stance, self._size = stance, size
        streams = [np.random.default_rng((seed, k)) for k in range(3)]
        self._phase = float(streams[0].uniform(0.0, 2.0 * np.pi))

        def drawn(rng: np.random.Generator) -> Float64[np.ndarray, " 3"]:
            return (_SPREAD * rng.normal(size=3)).clip(-1.0, 1.0)

        def leg(rng: np.random.Generator) -> Float64[np.ndarray, " 3"]:
            side = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.0)
            return np.array([side, *drawn(rng)[:2]])

        self._weight = Wandering(streams[1], leg, np.zeros(3), moves=(1.2, 2.2), holds=(1.8, 5.5))
        self._trunk = Wandering(streams[2], drawn, np.zeros(3), moves=(0.9, 1.7), holds=(0.4, 2.0))

    def at(
        self, frames: BodyParams, times: Float64[np.ndarray, " T"], activity: Float64[np.ndarray, " T"]
    ) -> tuple[BodyParams, Float64[np.ndarray, "T 3"]]:
        """Return the frames with feet planted under a body that lives, and how far the trunk turns in all, radians.

        Args:
            activity: of the trunk, 1 while one talks.
        """
        for one in (self._weight, self._trunk):
            one.forget(float(times[0]) - _KEEP)
        side, yaw, fore = (self._size * self._weight(times)).T
        trunk = self._size * activity[:, None] * _TRUNK * self._trunk(times)
        turn = np.stack([0.0 * yaw, _YAW * yaw, _ROLL * side], axis=1)
        root = matrix_from_rotvec(np.asarray(frames.global_orient)) @ matrix_from_rotvec(turn)
        way = np.stack([_SIDE * side, 0.0 * side, _FORE * fore], axis=1)
        facing = matrix_from_rotvec(np.asarray(frames.global_orient))
        level = np.einsum("tij,tj->ti", facing, way) * [1.0, 0.0, 1.0]
        pose = np.array(frames.body_pose).reshape(len(frames), -1, 3)

        def add(name: str, vectors: Float64[np.ndarray, "T 3"]) -> None:
            row = SMPLX_JOINTS.index(name) - 1
            pose[:, row] = rotvec_from_matrix(matrix_from_rotvec(pose[:, row]) @ matrix_from_rotvec(vectors))

        # Breathing in takes less time than breathing out.
        angle = 2.0 * np.pi * times / _BREATH + self._phase
        breath = self._size * np.sin(angle + 0.35 * np.sin(angle))
        counter = trunk - turn * [0.0, 0.6, 1.0]
        for name, share in _SPINE.items():
            add(name, share * counter - (name == "spine3") * _CHEST * breath[:, None] * [1.0, 0.0, 0.0])
        for name, sign in (("left_collar", 1.0), ("right_collar", -1.0)):
            add(name, sign * _COLLAR * breath[:, None] * [0.0, 0.0, 1.0])
        moved = replace(
            frames,
            global_orient=rotvec_from_matrix(root),
            transl=frames.transl + level,
            body_pose=pose.reshape(len(frames), -1),
        )
        return self.stance.planted(moved), trunk + turn * [0.0, 0.4, 0.0]
