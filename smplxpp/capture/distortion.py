"""Lens distortion in OpenCV's model, and undistortion of images."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.native import native_library

_NEWTON_STEPS = 12


@dataclass(frozen=True)
class Distortion:
    """Radial and tangential distortion (OpenCV's rational model; Brown 1966 with k4..k6 = 0).

    With x, y on the plane z = 1 and r^2 = x^2 + y^2:
    `q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`,
    `x_d = x q + 2 p1 x y + p2 (r^2 + 2 x^2)`, `y_d = y q + p1 (r^2 + 2 y^2) + 2 p2 x y`.

    Attributes:
        radial: k1..k6. tangential: p1, p2.
    """

    radial: tuple[float, float, float, float, float, float]
    tangential: tuple[float, float]

    @staticmethod
    def from_opencv(coefficients: Sequence[float], *, subject: str) -> Distortion | None:
        """Read OpenCV's order k1, k2, p1, p2[, k3[, k4, k5, k6]]; None where all are zero.

        Raises:
            InputError: another number of coefficients (thin prism and tilt: any beyond the eighth that is not zero).
        """
        values = np.asarray(coefficients, dtype=np.float64).ravel()
        if len(values) not in (0, 4, 5, 8, 12, 14) or not np.isfinite(values).all() or values[8:].any():
            raise InputError(
                f"{subject}: distortion",
                expected="4, 5 or 8 finite coefficients k1 k2 p1 p2 k3 k4 k5 k6",
                received=str(values.tolist()),
                remedy="calibrate without thin prism and tilt, or undistort the images beforehand",
            )
        if not values.any():
            return None
        full = np.zeros(8)
        full[: min(len(values), 8)] = values[:8]
        k1, k2, p1, p2, k3, k4, k5, k6 = full.tolist()
        return Distortion((k1, k2, k3, k4, k5, k6), (p1, p2))

    def distort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Where the lens puts points on the plane z = 1 of the pinhole camera."""
        x, y = np.asarray(xy, dtype=np.float64).T
        (k1, k2, k3, k4, k5, k6), (p1, p2) = self.radial, self.tangential
        r2 = x * x + y * y
        q = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.stack(
            [x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1
        )

    def undistort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Where the pinhole would have put points that the lens has put at `xy`: the inverse of `distort`, by Newton.

        Far outside of the picture, where a lens's polynomial folds back, there is no inverse and the result means
        nothing.
        """
        target = np.asarray(xy, dtype=np.float64)
        found, step = target.copy(), 1e-6
        for _ in range(_NEWTON_STEPS):
            value = self.distort(found)
            columns = [(self.distort(found + shift) - value) / step for shift in step * np.eye(2)]
            (a, c), (b, d) = (column.T for column in columns)
            determinant = a * d - b * c
            determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
            u, v = (target - value).T
            found = found + np.stack([d * u - b * v, a * v - c * u], axis=1) / determinant[:, None]
        return found


def undistort(
    image: UInt8[np.ndarray, "H W *C"],
    distortion: Distortion,
    *,
    source_K: Float[np.ndarray, "3 3"],
    target_K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    nearest: bool = False,
) -> UInt8[np.ndarray, "h w *C"]:
    """The image that a pinhole camera would have taken; bilinear, black where the source does not reach.

    Args:
        image: (H, W) or (H, W, 3) uint8, as the lens drew it.
        distortion: the lens.
        source_K: (3, 3) intrinsics of `image`, pixel centres at +0.5.
        target_K: (3, 3) intrinsics of the result.
        size: width and height of the result.
        nearest: take the nearest pixel, for labels.
    """
    image = np.ascontiguousarray(image, dtype=np.uint8)
    channels = 1 if image.ndim == 2 else image.shape[2]
    width, height = size
    out = np.empty((height, width, *image.shape[2:]), dtype=np.uint8)
    inverse = np.ascontiguousarray(np.linalg.inv(target_K)[:2], dtype=np.float64)
    K = np.ascontiguousarray(np.asarray(source_K)[:2], dtype=np.float64)
    lens = np.array([*distortion.radial, *distortion.tangential])

    def pointer(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    native_library().smplxpp_undistort(
        pointer(image),
        image.shape[1],
        image.shape[0],
        channels,
        pointer(inverse),
        pointer(K),
        pointer(lens),
        int(nearest),
        pointer(out),
        width,
        height,
    )
    return out
