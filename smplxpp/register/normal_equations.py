"""Accumulate and solve the normal equations of a sequence: a dense block a frame, smoothness, one shared shape.

One Gauss-Newton step minimises `sum_i |r_i + J_i x|^2` over the update x of all unknowns, where residuals r and
Jacobians J are already divided by their standard deviations and multiplied by the root of their robust weights
(iteratively reweighted least squares). The unknowns of a frame are rotation vectors of its free joints, its translation
and, where it is free, its expression; the shape is shared by all frames and comes last. The equations `H x = -g` have

    H = [ D + S    C ]      D block-diagonal (one block a frame), S the second differences of the smoothness term,
        [   C^T    B ]      C the coupling of frames and shape, B the shape alone.

S couples an unknown only with the same unknown of the next two frames, so that D + S is banded. The system is solved
by a banded Cholesky factorisation of D + S and the Schur complement `B - C^T (D + S)^-1 C` of the shape, in
O(T P^3) for T frames of P unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.linalg import cho_solve, cho_solve_banded, cholesky, cholesky_banded

from smplxpp.register.kinematics import PointsMotion


@dataclass(frozen=True, eq=False)
class Columns:
    """The order of a frame's unknowns: rotation vectors of joints, translation, expression.

    Attributes:
        joints: indices of the joints that are free to rotate.
        joint_count: number of joints of the body.
        expressions: number of free coefficients of the expression, all of the body's or none.
        expression_count: number of coefficients of the expression that the body has.
        betas: number of coefficients of the shape.
    """

    joints: Int64[np.ndarray, " n"]
    joint_count: int
    expressions: int
    expression_count: int
    betas: int

    @property
    def count(self) -> int:
        """The number of unknowns of a frame."""
        return 3 * len(self.joints) + 3 + self.expressions

    @property
    def transl(self) -> slice:
        """Return the columns of the translation in the system."""
        return slice(3 * len(self.joints), 3 * len(self.joints) + 3)

    @property
    def expression(self) -> slice:
        """Return the columns of the expression in the system."""
        return slice(3 * len(self.joints) + 3, self.count)

    def jacobian(self, motion: PointsMotion) -> Float64[np.ndarray, "N 3 _"]:
        """Return the derivatives of points by a frame's unknowns, followed by those by the shape."""
        points = len(motion.points)
        # A motion of exactly these joints needs no selection, which would copy most of it.
        pose = motion.pose if motion.joints is self.joints else motion.pose[:, :, self._places(motion)]
        parts = [
            pose.reshape(points, 3, -1),
            np.broadcast_to(np.eye(3), (points, 3, 3)),
            motion.expression[..., : self.expressions],
            motion.shape,
        ]
        return np.concatenate(parts, axis=2)

    def _places(self, motion: PointsMotion) -> Int64[np.ndarray, " _"]:
        """Return where the free joints stand among the joints of a motion."""
        places = np.full(self.joint_count, -1)
        places[motion.joints] = np.arange(len(motion.joints))
        if (places[self.joints] < 0).any():
            raise ValueError("the motion lacks derivatives by joints that are free")
        return places[self.joints]


@dataclass(frozen=True, eq=False)
class Step:
    """An update of all unknowns of T frames.

    Attributes:
        rotvecs: rotation vectors, radians, in the frames of the joints' parents; zero for joints that are not free.
        transl: metres.
        betas: shared by all frames.
        expression: coefficients.
    """

    rotvecs: Float64[np.ndarray, "T J 3"]
    transl: Float64[np.ndarray, "T 3"]
    betas: Float64[np.ndarray, " B"]
    expression: Float64[np.ndarray, "T E"]

    def limited(self, *, angle: float, length: float) -> Step:
        """Return the step with each frame shortened until no joint rotates by more than `angle` radians and the body
        moves by at most `length` metres; the shape is shortened as much as the most shortened frame."""
        # One factor a frame scales all unknowns of that frame, which keeps the direction of its step. The shape belongs
        # to all frames and takes the smallest factor.
        turn = np.linalg.norm(self.rotvecs, axis=2).max(axis=1)
        move = np.linalg.norm(self.transl, axis=1)
        share = 1.0 / np.maximum(1.0, np.maximum(turn / angle, move / length))
        least = share.min()
        return Step(
            self.rotvecs * share[:, None, None],
            self.transl * share[:, None],
            self.betas * least,
            self.expression * share[:, None],
        )


class Products:
    """Products of the rows that terms add for a frame, kept one by one.

    Args:
        columns: order of the P unknowns of a frame and of the B of the shape.

    Attributes:
        terms: of each added term `g = J^T r` (P) and `J^T J` (P, P) of the frame; and where it may change the shape,
            the coupling of frame and shape (P, B), the shape's own block (B, B) and its gradient (B).
    """

    def __init__(self, columns: Columns) -> None:
        self.columns = columns
        self.terms: list[tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray] | None]] = []

    def add(
        self, frame: int, rows: Float[np.ndarray, "M _"], residuals: Float[np.ndarray, " M"], *, shape: bool = True
    ) -> None:
        """Add `|residuals + rows x|^2`, whose rows are already weighted and end with the columns of the shape.

        Args:
            frame: whose rows they are.
            rows: derivatives of the residuals.
            residuals: the residuals.
            shape: whether the term may change the shape; else the columns of the shape are ignored.
        """
        # H += J^T J and g += J^T r, split into the frame's own block, the coupling C of frame and shape, and the block
        # of the shape. A frame that must not tell the shape contributes only the first.
        P = self.columns.count
        of_shape = None
        if shape:
            of_shape = rows[:, :P].T @ rows[:, P:], rows[:, P:].T @ rows[:, P:], rows[:, P:].T @ residuals
        self.terms.append((rows[:, :P].T @ residuals, rows[:, :P].T @ rows[:, :P], of_shape))


class NormalEquations:
    """The matrix and gradient of a sum of squares over T frames, to which terms are added row by row.

    Args:
        columns: order of the unknowns.
        frames: their number T.
    """

    def __init__(self, columns: Columns, frames: int) -> None:
        P, B = columns.count, columns.betas
        self.columns, self.frames = columns, frames
        self.blocks, self.gradient = np.zeros((frames, P, P)), np.zeros((frames, P))
        self.shape_blocks = np.zeros((frames, P, B))
        self.shape, self.shape_gradient = np.zeros((B, B)), np.zeros(B)
        # The band of S: how unknown c of frame t is coupled with itself in frames t, t + 1 and t + 2.
        self.smooth = np.zeros((3, frames, P))

    def add(
        self, frame: int, rows: Float[np.ndarray, "M _"], residuals: Float[np.ndarray, " M"], *, shape: bool = True
    ) -> None:
        """Add `|residuals + rows x|^2`, see `Products.add`."""
        products = Products(self.columns)
        products.add(frame, rows, residuals, shape=shape)
        self.add_products(frame, products)

    def add_products(self, frame: int, products: Products) -> None:
        """Add the terms of a frame, in the order in which they were added to `products`."""
        for gradient, block, of_shape in products.terms:
            self.gradient[frame] += gradient
            self.blocks[frame] += block
            if of_shape is not None:
                coupling, both, shape_gradient = of_shape
                self.shape_blocks[frame] += coupling
                self.shape += both
                self.shape_gradient += shape_gradient

    def add_smoothness(
        self, first: int, weight: Float[np.ndarray, " P"], second_difference: Float[np.ndarray, " P"]
    ) -> None:
        """Add `w |a + x_t - 2 x_{t+1} + x_{t+2}|^2` for each unknown, with t = `first` and a its present value."""
        kernel = (1.0, -2.0, 1.0)
        # J^T J of one row (1, -2, 1) is the outer product of the kernel with itself. It is stored by the distance of
        # the two frames, 0 to 2; H is symmetric, so that only the later frame of a pair is kept.
        for k, value in enumerate(kernel):
            self.gradient[first + k] += value * weight * second_difference
            for later in range(k, 3):
                self.smooth[later - k, first + k] += value * kernel[later] * weight

    def solve(self, *, damping: float, solve_shape: bool) -> Step:
        """Solve `(H + damping (diag H + 1)) x = -g` for the step (Levenberg-Marquardt with fixed damping)."""
        P, T, B = self.columns.count, self.frames, self.columns.betas
        # D + diag S, damped: relative to the diagonal, and absolutely so that unobserved unknowns stay where they are.
        blocks = self.blocks.copy()
        diagonal = np.einsum("tpp->tp", blocks)
        diagonal += self.smooth[0]
        diagonal += damping * (diagonal + 1.0)
        # Lower banded storage, banded[i - j, j]: blocks reach P - 1 below the diagonal, smoothness reaches 2 P.
        width = 2 * P if T > 1 else P - 1
        banded = np.zeros((width + 1, T * P))
        view = banded.reshape(width + 1, T, P)
        # Entry (i, j) of a frame's block goes to row i - j of the band, in the column of unknown j.
        for column in range(P):
            view[: P - column, :, column] = blocks[:, column:, column].T
        if T > 1:
            # An unknown of frame t and the same one of frame t + 1 lie P apart, those of t and t + 2 lie 2 P apart.
            view[P] += self.smooth[1]
            view[2 * P] += self.smooth[2]
        factor = cholesky_banded(banded, lower=True, overwrite_ab=True, check_finite=False)
        if not solve_shape:
            x = -cho_solve_banded((factor, True), self.gradient.reshape(-1), check_finite=False).reshape(T, P)
            return self._step(x, np.zeros(B))
        # Eliminate the frames: (D + S)^-1 applied to the gradient and to C leaves a small system of the shape alone.
        right = np.concatenate([self.gradient.reshape(-1, 1), self.shape_blocks.reshape(T * P, B)], axis=1)
        solved = cho_solve_banded((factor, True), right, check_finite=False)
        coupling = self.shape_blocks.reshape(T * P, B)
        schur = self.shape + damping * np.diag(np.diag(self.shape) + 1.0) - coupling.T @ solved[:, 1:]
        reduced = self.shape_gradient - coupling.T @ solved[:, 0]
        betas = -cho_solve((cholesky(schur, lower=True), True), reduced)
        # Back-substitute the shape into the frames.
        x = -solved[:, 0] - solved[:, 1:] @ betas
        return self._step(x.reshape(T, P), betas)

    def covariance(self, frame: int) -> Float64[np.ndarray, "P P"]:
        """Return the covariance of a frame's unknowns with all others held fixed, which is the inverse of its block."""
        # The small ridge makes unobserved unknowns invertible; their variance is then so large that their confidence is
        # 0.
        block = self.blocks[frame] + np.diag(self.smooth[0, frame] + 1e-9)
        return np.linalg.inv(block)

    def _step(self, x: np.ndarray, betas: np.ndarray) -> Step:
        c = self.columns
        # Joints and coefficients that are not unknowns get a step of zero.
        rotvecs = np.zeros((self.frames, c.joint_count, 3))
        rotvecs[:, c.joints] = x[:, : 3 * len(c.joints)].reshape(self.frames, -1, 3)
        expression = np.zeros((self.frames, c.expression_count))
        expression[:, : c.expressions] = x[:, c.expression]
        return Step(rotvecs, x[:, c.transl], betas, expression)


def geman_mcclure(
    residual: Float[np.ndarray, " N"], cutoff: Float[np.ndarray, " N"] | float
) -> Float64[np.ndarray, " N"]:
    """Return the weights of iteratively reweighted least squares for the kernel of Geman and McClure.

    The kernel `r^2 / (1 + (r / c)^2)` has the weight `1 / (1 + (r / c)^2)^2`, which is 1 near 0, a quarter at the
    cutoff c, and 1 everywhere for c = inf.
    """
    return 1.0 / (1.0 + (residual / cutoff) ** 2) ** 2


Equations = Products | NormalEquations
"""What a term of a frame is added to."""
