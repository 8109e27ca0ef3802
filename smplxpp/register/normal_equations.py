"""The normal equations of a sequence: a dense block a frame, smoothness between frames, one shape for all.

Unknowns of a frame are the turns of its free joints, its translation and, where it is free, its expression; those of
the shape come last and are shared. `H x = -g` with

    H = [ D + S    C ]      D block-diagonal, S the smoothness (it couples a column of one frame with the same column of
        [   C^T    B ]      the two next ones alone, so that D + S is banded), C and B from the shape.

It is solved by a banded Cholesky factorisation and the Schur complement of the shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.linalg import cho_solve, cho_solve_banded, cholesky, cholesky_banded

from smplxpp.register.kinematics import PointsMotion


@dataclass(frozen=True, eq=False)
class Columns:
    """Which unknowns a frame has, in which order: turns, translation, expression.

    Attributes:
        joints: those that turn. joint_count: of the body.
        expressions: how many coefficients are free: all of the body's or none. expression_count: of the body.
        betas: of the body.
    """

    joints: Int64[np.ndarray, " n"]
    joint_count: int
    expressions: int
    expression_count: int
    betas: int

    @property
    def count(self) -> int:
        """Unknowns of a frame."""
        return 3 * len(self.joints) + 3 + self.expressions

    @property
    def transl(self) -> slice:
        """Of the translation."""
        return slice(3 * len(self.joints), 3 * len(self.joints) + 3)

    @property
    def expression(self) -> slice:
        """Of the expression."""
        return slice(3 * len(self.joints) + 3, self.count)

    def jacobian(self, motion: PointsMotion) -> Float64[np.ndarray, "N 3 _"]:
        """Derivatives of points by a frame's unknowns, then by the shape's."""
        points = len(motion.points)
        parts = [
            motion.pose[:, :, self.joints].reshape(points, 3, -1),
            np.broadcast_to(np.eye(3), (points, 3, 3)),
            motion.expression[..., : self.expressions],
            motion.shape,
        ]
        return np.concatenate(parts, axis=2)


@dataclass(frozen=True, eq=False)
class Step:
    """What a solution asks for.

    Attributes:
        turns: radians, zero for joints that do not turn. transl: metres.
    """

    turns: Float64[np.ndarray, "T J 3"]
    transl: Float64[np.ndarray, "T 3"]
    betas: Float64[np.ndarray, " B"]
    expression: Float64[np.ndarray, "T E"]

    def limited(self, *, angle: float, length: float) -> Step:
        """No turn above `angle` radians and no move above `length` metres: a frame's step is shortened as a whole."""
        turn = np.linalg.norm(self.turns, axis=2).max(axis=1)
        move = np.linalg.norm(self.transl, axis=1)
        share = 1.0 / np.maximum(1.0, np.maximum(turn / angle, move / length))
        least = share.min()
        return Step(
            self.turns * share[:, None, None],
            self.transl * share[:, None],
            self.betas * least,
            self.expression * share[:, None],
        )


class NormalEquations:
    """Sums of squares of T frames, added row by row.

    Args:
        columns: the unknowns. frames: T.
    """

    def __init__(self, columns: Columns, frames: int) -> None:
        P, B = columns.count, columns.betas
        self.columns, self.frames = columns, frames
        self.blocks, self.gradient = np.zeros((frames, P, P)), np.zeros((frames, P))
        self.shape_blocks = np.zeros((frames, P, B))
        self.shape, self.shape_gradient = np.zeros((B, B)), np.zeros(B)
        # Smoothness: the coupling of column c at t with itself at t, t + 1, t + 2.
        self.smooth = np.zeros((3, frames, P))

    def add(
        self, frame: int, rows: Float[np.ndarray, "M _"], residuals: Float[np.ndarray, " M"], *, shape: bool = True
    ) -> None:
        """Add `|residuals + rows x|^2`; the rows are weighted already and end with the shape's columns.

        Args:
            shape: whether the frame may tell the shape; else its shape columns are left out.
        """
        P = self.columns.count
        self.gradient[frame] += rows[:, :P].T @ residuals
        self.blocks[frame] += rows[:, :P].T @ rows[:, :P]
        if shape:
            self.shape_blocks[frame] += rows[:, :P].T @ rows[:, P:]
            self.shape += rows[:, P:].T @ rows[:, P:]
            self.shape_gradient += rows[:, P:].T @ residuals

    def add_smoothness(
        self, first: int, weight: Float[np.ndarray, " P"], second_difference: Float[np.ndarray, " P"]
    ) -> None:
        """Add `w |a + x_{t} - 2 x_{t+1} + x_{t+2}|^2` for each column, t = `first`."""
        kernel = (1.0, -2.0, 1.0)
        for k, value in enumerate(kernel):
            self.gradient[first + k] += value * weight * second_difference
            for later in range(k, 3):
                self.smooth[later - k, first + k] += value * kernel[later] * weight

    def solve(self, *, damping: float, solve_shape: bool) -> Step:
        """Solve for the step; `damping` is added to the diagonal, relative to it and, a little, absolutely."""
        P, T, B = self.columns.count, self.frames, self.columns.betas
        blocks = self.blocks.copy()
        diagonal = np.einsum("tpp->tp", blocks)
        diagonal += self.smooth[0]
        diagonal += damping * (diagonal + 1.0)
        width = 2 * P if T > 1 else P - 1
        banded = np.zeros((width + 1, T * P))  # lower form: banded[i - j, j]
        view = banded.reshape(width + 1, T, P)
        for column in range(P):
            view[: P - column, :, column] = blocks[:, column:, column].T
        if T > 1:
            view[P] += self.smooth[1]
            view[2 * P] += self.smooth[2]
        factor = cholesky_banded(banded, lower=True, overwrite_ab=True, check_finite=False)
        if not solve_shape:
            x = -cho_solve_banded((factor, True), self.gradient.reshape(-1), check_finite=False).reshape(T, P)
            return self._step(x, np.zeros(B))
        right = np.concatenate([self.gradient.reshape(-1, 1), self.shape_blocks.reshape(T * P, B)], axis=1)
        solved = cho_solve_banded((factor, True), right, check_finite=False)
        coupling = self.shape_blocks.reshape(T * P, B)
        schur = self.shape + damping * np.diag(np.diag(self.shape) + 1.0) - coupling.T @ solved[:, 1:]
        reduced = self.shape_gradient - coupling.T @ solved[:, 0]
        betas = -cho_solve((cholesky(schur, lower=True), True), reduced)
        x = -solved[:, 0] - solved[:, 1:] @ betas
        return self._step(x.reshape(T, P), betas)

    def covariance(self, frame: int) -> Float64[np.ndarray, "P P"]:
        """Of a frame's unknowns with everything else held: the inverse of its block."""
        block = self.blocks[frame] + np.diag(self.smooth[0, frame] + 1e-9)
        return np.linalg.inv(block)

    def _step(self, x: np.ndarray, betas: np.ndarray) -> Step:
        c = self.columns
        turns = np.zeros((self.frames, c.joint_count, 3))
        turns[:, c.joints] = x[:, : 3 * len(c.joints)].reshape(self.frames, -1, 3)
        expression = np.zeros((self.frames, c.expression_count))
        expression[:, : c.expressions] = x[:, c.expression]
        return Step(turns, x[:, c.transl], betas, expression)
