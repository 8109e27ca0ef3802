"""One step of all frames together: photographs, trust in the start, and smoothness in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.linalg import solveh_banded

from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.variables import Variables
from smplxpp.core.params import DEFAULT_FPS
from smplxpp.core.rotations import rotvec_from_matrix
from smplxpp.register import BodyState

TAIL = 2.0
"""Multiples of the trusted acceleration from which an acceleration counts as motion."""
REFERENCE_FPS = 20.0
"""Frames per second to which `RefineConfig.acceleration_sigma` refers."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of F frames.

    Attributes:
        gradient: of half the sum of squares. curvature: its second derivative within a frame.
    """

    gradient: Float64[np.ndarray, "F P"]
    curvature: Float64[np.ndarray, "F P P"]


def changes(variables: Variables, start: BodyState, state: BodyState) -> Float64[np.ndarray, "F P"]:
    """What has changed since the start: rotation vectors in the parents' frames, translation, expression."""
    turned = rotvec_from_matrix(state.rotations @ start.rotations.swapaxes(-1, -2))
    return variables.packed(turned, state.transl - start.transl, state.expression - start.expression)


def with_trust(normal: Normal, change: Float64[np.ndarray, "F P"], sigma: Float64[np.ndarray, " P"]) -> Normal:
    """Add `sum (change / sigma)^2 / 2`: each number stays near its registered start."""
    curvature = normal.curvature.copy()
    index = np.arange(len(sigma))
    curvature[:, index, index] += 1.0 / sigma**2
    return Normal(normal.gradient + change / sigma**2, curvature)


@dataclass(frozen=True, eq=False)
class Smoothness:
    """Accelerations of every three frames in a row, `a = d_next - 2 d + d_before`, and how much each counts.

    Attributes:
        triple: whether a frame has neighbours one frame before and after it.
        acceleration: of the state as it is, 0 elsewhere.
        weight: by number; Student's t with `TAIL`: `1 / (sigma^2 (1 + |a|^2 / (TAIL sigma)^2))` a joint.
    """

    triple: Bool[np.ndarray, " F"]
    acceleration: Float64[np.ndarray, "F P"]
    weight: Float64[np.ndarray, "F P"]


def smoothness(
    variables: Variables, state: BodyState, frames: tuple[int, ...], config: RefineConfig, fps: float | None
) -> Smoothness:
    """Look at how unevenly a state moves.

    Args:
        frames: their numbers, ascending. fps: None counts as `DEFAULT_FPS`.
    """
    number = np.array(frames)
    F, K = len(number), len(variables.joints)
    triple = np.zeros(F, dtype=bool)
    triple[1:-1] = (np.diff(number)[:-1] == 1) & (np.diff(number)[1:] == 1)
    acceleration = np.zeros((F, len(variables)))
    if F > 1:
        turns = rotvec_from_matrix(state.rotations[1:] @ state.rotations[:-1].swapaxes(-1, -2))
        speed = variables.packed(turns, np.diff(state.transl, axis=0), np.diff(state.expression, axis=0))
        acceleration[1:-1] = np.where(triple[1:-1, None], np.diff(speed, axis=0), 0.0)
    slower = (REFERENCE_FPS / (fps or DEFAULT_FPS)) ** 2
    sigma = slower * np.concatenate(
        [
            np.full(3 * K, np.radians(config.acceleration_sigma)),
            np.full(3, config.translation_acceleration_sigma),
            np.full(variables.expressions, 0.5 * config.expression_sigma),
        ]
    )
    size = np.abs(acceleration)
    for start in range(0, 3 * K + 3, 3):  # the three numbers of a joint count together
        size[:, start : start + 3] = np.linalg.norm(acceleration[:, start : start + 3], axis=1, keepdims=True)
    weight = 1.0 / (sigma**2 * (1.0 + (size / (TAIL * sigma)) ** 2))
    return Smoothness(triple, acceleration, np.where(triple[:, None], weight, 0.0))


def solve(normal: Normal, smooth: Smoothness, damping: Float64[np.ndarray, " F"]) -> Float64[np.ndarray, "F P"]:
    """Return the step of every frame, `(H + damping diag H + S) d = -(g + s)`, one banded system.

    Args:
        damping: Levenberg and Marquardt's, by frame.
    """
    F, P = normal.gradient.shape
    band = P * min(F, 3)
    matrix = np.zeros((band, F * P))  # lower form: matrix[i - j, j]
    gradient = normal.gradient.copy()
    blocks = normal.curvature.copy()
    index = np.arange(P)
    blocks[:, index, index] *= 1.0 + damping[:, None]
    diagonal = np.arange(F * P).reshape(F, P)
    coupling = {1: np.zeros((F, P)), 2: np.zeros((F, P))}
    for t in np.flatnonzero(smooth.triple):
        w, a = smooth.weight[t], smooth.acceleration[t]
        for offset, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            gradient[t + offset] += factor * w * a
            blocks[t + offset, index, index] += factor**2 * w
        coupling[1][t - 1] -= 2.0 * w
        coupling[1][t] -= 2.0 * w
        coupling[2][t - 1] += w
    for k in range(P):
        matrix[k, :].reshape(F, P)[:, : P - k] = blocks[:, index[k:], index[: P - k]]
    for offset, values in coupling.items():
        if offset < F:
            matrix[offset * P, diagonal[: F - offset].ravel()] = values[: F - offset].ravel()
    return -solveh_banded(matrix, gradient.ravel(), lower=True, overwrite_ab=True).reshape(F, P)
