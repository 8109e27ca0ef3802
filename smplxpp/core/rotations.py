"""Convert rotations between axis-angle vectors and matrices, for numpy arrays and torch tensors, and read others."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from smplxpp.core.errors import InputError

Array: TypeAlias = Any
"""A numpy array or a torch tensor; functions return the kind that they receive."""


def array_namespace(array: Array) -> ModuleType:
    """Return the module torch for a tensor, derived classes included, else numpy, without importing torch."""
    is_tensor = any(kind.__module__.partition(".")[0] == "torch" for kind in type(array).__mro__)
    return sys.modules["torch"] if is_tensor else np


def matrix_from_rotvec(rotvec: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    """Return the rotation matrices of axis-angle vectors (Rodrigues), differentiable at zero.

    `R = I + a K + b K^2` with K the cross-product matrix of the vector, `a = sin(t) / t` and
    `b = (1 - cos t) / t^2 = (sin(t/2) / (t/2))^2 / 2`, the latter form without cancellation.

    Args:
        rotvec: radians.

    Returns:
        An array of the same kind, type and device.
    """
    xp = array_namespace(rotvec)
    squared = (rotvec * rotvec).sum(-1)
    a = _sinc(xp, squared)
    b = 0.5 * _sinc(xp, 0.25 * squared) ** 2
    x, y, z = rotvec[..., 0], rotvec[..., 1], rotvec[..., 2]
    c = 1.0 - b * squared
    if xp is np:
        # The same products, each once, in place: a search calls this for single vectors a hundred thousand times.
        bx, by, ax, ay, az = b * x, b * y, a * x, a * y, a * z
        xy, xz, yz = bx * y, bx * z, by * z
        out = np.empty((*c.shape, 3, 3), dtype=c.dtype)
        out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = c + bx * x, xy - az, xz + ay
        out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = xy + az, c + by * y, yz - ax
        out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = xz - ay, yz + ax, c + b * z * z
        return out
    rows = (
        (c + b * x * x, b * x * y - a * z, b * x * z + a * y),
        (b * x * y + a * z, c + b * y * y, b * y * z - a * x),
        (b * x * z - a * y, b * y * z + a * x, c + b * z * z),
    )
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def rotvec_from_matrix(matrix: Float[np.ndarray, "*N 3 3"]) -> Float64[np.ndarray, "*N 3"]:
    """Return the axis-angle vectors of rotation matrices, accurate near 0 and pi (through quaternions).

    Args:
        matrix: rotation matrices.

    Returns:
        Vectors of length at most pi.
    """
    matrix = np.array(matrix, dtype=np.float64)  # a copy: scipy takes no read-only arrays
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-2] + (3,))


def axis_angle_rows(value: np.ndarray, counts: Sequence[int], *, subject: str) -> np.ndarray:
    """Return rotations of joints as one row of axis-angle vectors a frame, from whichever form a file has them in.

    Read are (..., J, 3) vectors and matrices (..., J, 3, 3), (..., J, 9) or (..., 9 J), of one joint without its axis,
    too: a lone (3, 3) is a matrix if it is a rotation, else three vectors. Arrays of other shapes are returned as they
    are.

    Args:
        value: of one or more frames.
        counts: numbers of joints J that it may have.
        subject: name of the array, for messages.

    Raises:
        InputError: matrices that are no rotations; six or four numbers a joint, whose order a file does not tell.

    Example:
        >>> axis_angle_rows(np.eye(3), [1], subject="parameter global_orient")
        array([[0., 0., 0.]])
    """
    value = np.asarray(value)
    for joints in counts:
        if (value.ndim > 2 and value.shape[-2:] == (joints, 3)) or (joints > 1 and value.shape == (joints, 3)):
            return value.reshape(-1, 3 * joints)
        stacked = value.shape[-3:] == (joints, 3, 3) or (joints == 1 and value.ndim == 3 and value.shape[1:] == (3, 3))
        lone = joints == 1 and value.shape == (3, 3) and _are_rotations(value)
        if stacked or lone or _numbers_a_joint(value, joints, 9):
            matrices = value.astype(np.float64).reshape(-1, joints, 3, 3)
            if not _are_rotations(matrices):
                raise InputError(
                    subject,
                    expected="rotation matrices, orthonormal with determinant 1, or axis-angle vectors",
                    received=f"other matrices of shape {value.shape}",
                )
            return rotvec_from_matrix(matrices).reshape(-1, 3 * joints)
        for numbers, kind, reason in (
            (6, "six numbers", "some mean the first two columns of the matrix, others its first two rows"),
            (4, "four numbers", "some write quaternions with w first, others with w last"),
        ):
            if _numbers_a_joint(value, joints, numbers):
                raise InputError(
                    subject,
                    expected="axis-angle vectors or rotation matrices",
                    received=f"{kind} a joint, shape {value.shape}",
                    remedy=f"convert them with the program that wrote them: {reason}, and the file does not tell which",
                )
    return value


def _numbers_a_joint(value: np.ndarray, joints: int, numbers: int) -> bool:
    """Whether an array has so many numbers for each joint, with an axis for the joints or in one row."""
    return value.shape[-1:] == (joints * numbers,) or (value.ndim > 1 and value.shape[-2:] == (joints, numbers))


def _are_rotations(matrices: np.ndarray) -> bool:
    """Whether all matrices (..., 3, 3) are rotations, within the rounding of float16."""
    square = np.swapaxes(matrices, -1, -2) @ matrices
    return bool(np.abs(square - np.eye(3)).max(initial=0.0) < 1e-2 and (np.linalg.det(matrices) > 0).all())


def rotation_between(source: Float[np.ndarray, "P 3"], target: Float[np.ndarray, "P 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation R that minimises |source R - target|^2 for centred points (Kabsch 1976)."""
    left, _, right = np.linalg.svd(np.asarray(source, np.float64).T @ target)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return left @ turn @ right


def _sinc(xp: ModuleType, squared: Array) -> Array:
    """Return sin(t) / t as a function of t^2; both branches stay finite, so that gradients are defined at zero."""
    # Below this squared angle the series is exact to float64's last bit (next term: t^6 / 5040 < 2e-16).
    small = squared < 1e-4
    angle = xp.sqrt(xp.where(small, xp.ones_like(squared), squared))
    return xp.where(small, 1.0 - squared / 6.0 * (1.0 - squared / 20.0), xp.sin(angle) / angle)
