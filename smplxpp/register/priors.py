"""Residuals that no image gives: joint ranges, ordinary poses and shapes, a fit to start from, slow change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core.params import DEFAULT_FPS
from smplxpp.core.rotations import rotvec_from_matrix
from smplxpp.register.anatomy import Anatomy
from smplxpp.register.config import RegisterConfig
from smplxpp.register.kinematics import BodyState
from smplxpp.register.normal_equations import Columns, NormalEquations

# Radians: a fit with smaller errors stands for the prior of poses.
_BELIEVED = np.radians(5.0)
# Radians over which a bound is soft.
_BOUND = np.radians(3.0)
_EXPRESSION_SPREAD = 0.35
# More frames than this between two: their motion says nothing of each other.
_LARGEST_GAP = 5


@dataclass(frozen=True, eq=False)
class Start:
    """A fit to start from and how far it is believed.

    Attributes:
        state: what it says. pose: standard deviation of each joint, radians; inf: not believed.
        transl: in metres. shape: in betas.
    """

    state: BodyState
    pose: float
    transl: float
    shape: float


class Priors:
    """Everything known beforehand, of one window of frames.

    Args:
        columns: the unknowns. frames: their numbers.
        start: a fit that is a measurement too, its rows those of the window; None: none.
    """

    def __init__(
        self,
        columns: Columns,
        frames: Int64[np.ndarray, " T"],
        anatomy: Anatomy,
        config: RegisterConfig,
        *,
        start: Start | None = None,
        fps: float | None = None,
    ) -> None:
        self.columns, self.frames, self.config, self.start = columns, np.asarray(frames), config, start
        joints = columns.joints
        self.spread, self.lowest, self.highest = (
            getattr(anatomy, name)[joints].reshape(-1) for name in ("spread", "lowest", "highest")
        )
        self.seconds = 1.0 / (fps or DEFAULT_FPS)

    def add(self, equations: NormalEquations, state: BodyState, *, shape: bool) -> None:
        """Add all of them to the equations of a state.

        Args:
            shape: whether the shape is solved.
        """
        vectors = rotvec_from_matrix(state.rotations[:, self.columns.joints])
        inverse = _left_jacobian_inverse(vectors)
        for row in range(len(state)):
            self._add_pose(equations, row, vectors[row].reshape(-1), inverse[row])
            self._add_expression(equations, row, state.expression[row])
            if self.start is not None:
                self._add_start(equations, row, state)
        if shape:
            self._add_shape(equations, state.betas)
        self._add_smoothness(equations, state)

    def _add_pose(
        self, equations: NormalEquations, row: int, vector: Float64[np.ndarray, " n"], inverse: np.ndarray
    ) -> None:
        over = np.maximum(vector - self.highest, 0.0) + np.minimum(vector - self.lowest, 0.0)
        # A fit that is believed says more of the pose than what poses mostly are.
        believed = self.start is not None and self.start.pose < _BELIEVED
        prior = 0.0 if believed else self.config.pose_prior
        weight = prior / self.spread**2 + (over != 0) / _BOUND**2
        gradient = prior * vector / self.spread**2 + over / _BOUND**2
        for k, jacobian in enumerate(inverse):
            part = slice(3 * k, 3 * k + 3)
            equations.blocks[row, part, part] += jacobian.T @ (weight[part, None] * jacobian)
            equations.gradient[row, part] += jacobian.T @ gradient[part]

    def _add_expression(self, equations: NormalEquations, row: int, expression: Float64[np.ndarray, " E"]) -> None:
        part = self.columns.expression
        index = np.arange(part.start, part.stop)
        if len(index):
            equations.blocks[row, index, index] += 1.0 / _EXPRESSION_SPREAD**2
            equations.gradient[row, part] += expression / _EXPRESSION_SPREAD**2

    def _add_start(self, equations: NormalEquations, row: int, state: BodyState) -> None:
        start = self.start
        assert start is not None
        joints, transl, P = self.columns.joints, self.columns.transl, equations.columns.count
        if np.isfinite(start.pose):
            off = rotvec_from_matrix(
                state.rotations[row, joints] @ start.state.rotations[row, joints].transpose(0, 2, 1)
            )
            jacobian = _left_jacobian_inverse(off)
            # Cauchy's weight: a joint that the start has wrong by a lot is let go.
            weight = 1.0 / (start.pose**2 * (1.0 + (off**2).sum(axis=1) / (3 * start.pose) ** 2))
            for k, (each, vector) in enumerate(zip(jacobian, off, strict=True)):
                part = slice(3 * k, 3 * k + 3)
                equations.blocks[row, part, part] += weight[k] * each.T @ each
                equations.gradient[row, part] += weight[k] * each.T @ vector
        if np.isfinite(start.transl):
            rows = np.zeros((3, P + self.columns.betas))
            rows[:, transl] = np.eye(3) / start.transl
            difference = (state.transl[row] - start.state.transl[row]) / start.transl
            equations.add(row, rows, difference, shape=False)

    def _add_shape(self, equations: NormalEquations, betas: Float64[np.ndarray, " B"]) -> None:
        # Unit betas, or a fit that is believed.
        mean, spread = np.zeros_like(betas), 1.0
        if self.start is not None and np.isfinite(self.start.shape):
            mean, spread = self.start.state.betas, self.start.shape
        index = np.arange(len(betas))
        equations.shape[index, index] += 1.0 / spread**2
        equations.shape_gradient += (betas - mean) / spread**2

    def _add_smoothness(self, equations: NormalEquations, state: BodyState) -> None:
        """Accelerations of rotations and of the translation, Cauchy-weighted so that fast motion is kept."""
        joints, P = self.columns.joints, self.columns.count
        for first in range(len(state) - 2):
            gaps = np.diff(self.frames[first : first + 3])
            if gaps[0] != gaps[1] or gaps[0] > _LARGEST_GAP:
                continue
            seconds = self.seconds * gaps[0]
            turned = state.rotations[first : first + 3, joints]
            speed = rotvec_from_matrix(turned[1:] @ turned[:-1].transpose(0, 1, 3, 2))
            turn, moved = speed[1] - speed[0], np.diff(state.transl[first : first + 3], n=2, axis=0)[0]
            face = np.diff(state.expression[first : first + 3, : self.columns.expressions], n=2, axis=0)[0]
            scale = self.config.acceleration * seconds**2
            length = self.config.transl_acceleration * seconds**2
            weight, difference = np.zeros(P), np.zeros(P)
            of_joint = 1.0 / (scale**2 * (1.0 + (turn**2).sum(axis=1) / (2 * scale) ** 2))
            weight[: 3 * len(joints)] = np.repeat(of_joint, 3)
            difference[: 3 * len(joints)] = turn.reshape(-1)
            weight[self.columns.transl] = 1.0 / (length**2 * (1.0 + (moved**2).sum() / (2 * length) ** 2))
            difference[self.columns.transl] = moved
            weight[self.columns.expression] = 1.0 / (100.0 * seconds**2) ** 2
            difference[self.columns.expression] = face
            equations.add_smoothness(first, weight, difference)


def white_noise(state: BodyState, frames: Int64[np.ndarray, " T"]) -> tuple[float, float] | None:
    """Standard deviations (radians a component, metres) of what is not smooth in a fit; None for less than 8 frames.

    A second difference of white noise has six times its variance; the median over joints and frames ignores real
    accelerations that few of them have.
    """
    triples = np.flatnonzero(np.diff(frames)[1:] == np.diff(frames)[:-1]) if len(frames) > 2 else np.zeros(0, int)
    if len(triples) < 6:
        return None
    speed = rotvec_from_matrix(state.rotations[1:] @ state.rotations[:-1].transpose(0, 1, 3, 2))
    turn = (speed[1:] - speed[:-1])[triples]
    moved = np.diff(state.transl, n=2, axis=0)[triples]
    pose, transl = (float(1.4826 * np.median(np.abs(values)) / np.sqrt(6)) for values in (turn, moved))
    return pose, transl


def _left_jacobian_inverse(vectors: Float64[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 3 3"]:
    """Derivative of `log(exp(d) exp(v))` by d at 0 (Sola et al. 2018, "A micro Lie theory", equation 146)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = np.zeros((*vectors.shape[:-1], 3, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross -= np.swapaxes(cross, -1, -2).copy()
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    factor = np.where(small, 1.0 / 12.0, 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe)))
    return np.eye(3) - 0.5 * cross + factor * (cross @ cross)
