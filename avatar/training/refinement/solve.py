"""The normal equations of all frames: photographs, prior about the start, smoothness in time, one banded solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.linalg import solveh_banded

from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.variables import Variables
from smplxpp.core import DEFAULT_FPS, rotvec_from_matrix
from smplxpp.register import BodyState


@dataclass(frozen=True, eq=False)
class Normal:
    """Gradient and Gauss-Newton matrices of F frames with P unknowns each, of half a sum of squares.

    Attributes:
        gradient: by the unknowns of each frame.
        curvature: blocks of the frames; frames are coupled by `Smoothness` alone.
    """

    gradient: Float64[np.ndarray, "F P"]
    curvature: Float64[np.ndarray, "F P P"]


def changes(variables: Variables, start: BodyState, state: BodyState) -> Float64[np.ndarray, "F P"]:
    """Return the change since the start: rotation vectors in the parents' frames, translation, expression."""
    # exp(d) R_start = R, so d is the logarithm of R R_start^T.
    turned = rotvec_from_matrix(state.rotations @ start.rotations.swapaxes(-1, -2))
    return variables.packed(turned, state.transl - start.transl, state.expression - start.expression)


def with_prior(normal: Normal, change: Float64[np.ndarray, "F P"], sigma: Float64[np.ndarray, " P"]) -> Normal:
    """Add the Gaussian prior `sum (change / sigma)^2 / 2` about the registered start."""
    curvature = normal.curvature.copy()
    index = np.arange(len(sigma))
    curvature[:, index, index] += 1.0 / sigma**2
    return Normal(normal.gradient + change / sigma**2, curvature)


@dataclass(frozen=True, eq=False)
class Smoothness:
    """The smoothness term linearised: accelerations `a = d_next - 2 d + d_before` and their weights.

    Attributes:
        triple: whether a frame has neighbours one frame before and one after it.
        acceleration: of the current state, 0 elsewhere.
        weight: of each number's squared acceleration, 0 elsewhere; see `smoothness`.
    """

    triple: Bool[np.ndarray, " F"]
    acceleration: Float64[np.ndarray, "F P"]
    weight: Float64[np.ndarray, "F P"]


def smoothness(
    variables: Variables, state: BodyState, frames: tuple[int, ...], config: RefineConfig, fps: float | None
) -> Smoothness:
    """Return accelerations of a state and their weights under Student's t, for reweighted least squares.

    `w = 1 / (sigma^2 (1 + |a|^2 / (tail sigma)^2))`, with |a| over the three numbers of a joint: accelerations above
    `tail` sigma are fast motion and cost little.

    Args:
        variables: the unknowns of a frame.
        state: poses of the frames.
        frames: their numbers, ascending.
        config: sigma of turns, translation and expression.
        fps: frames a second; None counts as `DEFAULT_FPS`.
    """
    tail = 2.0  # multiples of sigma
    reference_fps = 20.0  # frame rate of the configuration's sigma; accelerations a frame fall with its square
    number = np.array(frames)
    F, K = len(number), len(variables.joints)
    # Frames whose two neighbours are known.
    triple = np.zeros(F, dtype=bool)
    triple[1:-1] = (np.diff(number)[:-1] == 1) & (np.diff(number)[1:] == 1)
    # Second differences, of rotations by rotation vectors between consecutive frames.
    acceleration = np.zeros((F, len(variables)))
    if F > 1:
        turns = rotvec_from_matrix(state.rotations[1:] @ state.rotations[:-1].swapaxes(-1, -2))
        speed = variables.packed(turns, np.diff(state.transl, axis=0), np.diff(state.expression, axis=0))
        acceleration[1:-1] = np.where(triple[1:-1, None], np.diff(speed, axis=0), 0.0)
    # Standard deviation of each number at this frame rate.
    slower = (reference_fps / (fps or DEFAULT_FPS)) ** 2
    sigma = slower * np.concatenate(
        [
            np.full(3 * K, np.radians(config.acceleration_sigma)),
            np.full(3, config.translation_acceleration_sigma),
            np.full(variables.expressions, 0.5 * config.expression_sigma),
        ]
    )
    # Weights of Student's t; the three numbers of a joint, and of the translation, share their norm.
    size = np.abs(acceleration)
    for start in range(0, 3 * K + 3, 3):
        size[:, start : start + 3] = np.linalg.norm(acceleration[:, start : start + 3], axis=1, keepdims=True)
    weight = 1.0 / (sigma**2 * (1.0 + (size / (tail * sigma)) ** 2))
    return Smoothness(triple, acceleration, np.where(triple[:, None], weight, 0.0))


def solve(normal: Normal, smooth: Smoothness, damping: Float64[np.ndarray, " F"]) -> Float64[np.ndarray, "F P"]:
    """Return the Levenberg-Marquardt step of every frame, `(H + damping diag H + S) d = -(g + s)`.

    H and g are the frames' blocks, S = D^T W D and s = D^T W a those of the smoothness with D the second difference. S
    couples frames up to two apart, so that the matrix is banded, with half-width 3 P.

    Args:
        normal: gradient and blocks of the frames.
        smooth: accelerations and their weights.
        damping: of each frame.
    """
    F, P = normal.gradient.shape
    band = P * min(F, 3)
    matrix = np.zeros((band, F * P))  # lower form: matrix[i - j, j]
    # Damp the diagonal of every block.
    gradient = normal.gradient.copy()
    blocks = normal.curvature.copy()
    index = np.arange(P)
    blocks[:, index, index] *= 1.0 + damping[:, None]
    # Smoothness of each triple: weight w times the outer product of (1, -2, 1).
    diagonal = np.arange(F * P).reshape(F, P)
    coupling = {1: np.zeros((F, P)), 2: np.zeros((F, P))}
    for t in np.flatnonzero(smooth.triple):
        # The term 1/2 w a^2 with a = d_{t-1} - 2 d_t + d_{t+1} touches three frames: gradient w a (1, -2, 1),
        # curvature on
        # the diagonal w (1, 4, 1), and couplings -2 w between neighbours and w between the two outer ones.
        w, a = smooth.weight[t], smooth.acceleration[t]
        for offset, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            gradient[t + offset] += factor * w * a
            blocks[t + offset, index, index] += factor**2 * w
        coupling[1][t - 1] -= 2.0 * w
        coupling[1][t] -= 2.0 * w
        coupling[2][t - 1] += w
    # Fill the band: diagonals of the blocks, then the couplings of frames one and two apart.
    for k in range(P):
        matrix[k, :].reshape(F, P)[:, : P - k] = blocks[:, index[k:], index[: P - k]]
    for offset, values in coupling.items():
        if offset < F:
            matrix[offset * P, diagonal[: F - offset].ravel()] = values[: F - offset].ravel()
    return -solveh_banded(matrix, gradient.ravel(), lower=True, overwrite_ab=True).reshape(F, P)
