"""Hair that follows the head with a little lag: a damped rotational spring."""

from __future__ import annotations

import numpy as np

from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix


class HairLag:
    """The rotation by which hair trails behind its head.

    `w' = -stiffness a - damping w - gain (head's angular acceleration)`, `a' = w`, with `a` the lag as a rotation
    vector in the world; semi-implicit steps.

    Args:
        head: (3, 3) world_from_head at the start, at rest.
    """

    STIFFNESS, DAMPING, GAIN, LARGEST = 260.0, 9.0, 0.55, np.radians(9.0)

    def __init__(self, head: np.ndarray) -> None:
        self._head, self._spin = head, np.zeros(3)
        self._angle, self._rate = np.zeros(3), np.zeros(3)

    def advance(self, head: np.ndarray, seconds: float) -> None:
        """Follow the head to `head` within `seconds`."""
        spin = rotvec_from_matrix(head @ self._head.T) / seconds
        push = self.GAIN * (spin - self._spin)
        self._rate += -push - seconds * (self.STIFFNESS * self._angle + self.DAMPING * self._rate)
        self._angle = self._angle + seconds * self._rate
        length = np.linalg.norm(self._angle)
        if length > self.LARGEST:
            self._angle *= self.LARGEST / length
        self._head, self._spin = head, spin

    def applied(self, points: np.ndarray, looseness: np.ndarray, pivot: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the hair turned about `pivot` by their share `looseness` (N,) of the lag."""
        turned = matrix_from_rotvec(looseness[:, None] * self._angle)
        return pivot + np.einsum("nij,nj->ni", turned, points - pivot)
