"""Lens models, in OpenCV's parameters: where a lens puts points of the plane z = 1, and undistortion of images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Float64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_numbers
from smplxpp.core.validation import require_choice
from smplxpp.native import address, check_size, native_library

OPENCV, FISHEYE, FOV = LENS_MODELS = ("opencv", "fisheye", "fov")
"""Names of the models, as `dist_model` of cameras.json says them."""

_NEWTON_STEPS = 12
_BISECTIONS = 60
# The farthest from the axis that a pinhole is asked to show: at 90 degrees its picture would have no end.
_WIDEST = np.radians(89.0)
# A telephoto lens has large ones, since its radii are small.
_LARGEST = 1e12
_NO_LENS_REMEDY = "calibrate without thin prism and tilt, or undistort the images beforehand"


class Distortion(ABC):
    """A lens, between points of the plane z = 1 of the pinhole camera and points of the same plane as it draws them.

    Attributes:
        native_id: number of the model in the native library.
    """

    native_id: ClassVar[int]

    @abstractmethod
    def distort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Where the lens puts points on the plane z = 1 of the pinhole camera; NaN where it does not show them."""

    @abstractmethod
    def undistort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Where the pinhole would have put points that the lens has put at `xy`: the inverse of `distort`.

        NaN for what no pinhole sees (89 degrees from the axis and more).
        """

    @abstractmethod
    def native_parameters(self) -> Float64[np.ndarray, " P"]:
        """The numbers that the native library takes for this model."""

    @staticmethod
    def from_opencv(coefficients: Any, *, subject: str, model: str = OPENCV) -> Distortion | None:
        """Read coefficients in OpenCV's order, nested or not; None where the lens is a pinhole.

        Args:
            coefficients: `opencv`: k1, k2, p1, p2[, k3[, k4, k5, k6]]; `fisheye` (`cv2.fisheye`): k1, k2, k3, k4;
                `fov`: omega, in radians.
            subject: what messages call the camera.
            model: one of `LENS_MODELS`.

        Raises:
            InputError: an unknown model, other values than finite numbers, another number of them (thin prism and tilt:
                any beyond the eighth that is not zero), no field of view.
        """
        require_choice(f"{subject}: model of the lens", model, LENS_MODELS)
        values = as_numbers(coefficients, subject=f"{subject}: distortion").ravel()
        if np.abs(values).max(initial=0.0) > _LARGEST:
            raise _misfit(subject, f"coefficients of at most {_LARGEST:g}", values)
        if model == FISHEYE:
            return FisheyeDistortion.from_coefficients(values, subject=subject)
        if model == FOV:
            return FovDistortion.from_coefficients(values, subject=subject)
        return RationalDistortion.from_coefficients(values, subject=subject)


@dataclass(frozen=True)
class RationalDistortion(Distortion):
    """Radial and tangential distortion (OpenCV's rational model; Brown 1966 with k4..k6 = 0).

    With x, y on the plane z = 1 and r^2 = x^2 + y^2:
    `q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`,
    `x_d = x q + 2 p1 x y + p2 (r^2 + 2 x^2)`, `y_d = y q + p1 (r^2 + 2 y^2) + 2 p2 x y`.

    Attributes:
        radial: k1..k6. tangential: p1, p2.
    """

    radial: tuple[float, float, float, float, float, float]
    tangential: tuple[float, float]
    native_id: ClassVar[int] = 0

    @staticmethod
    def from_coefficients(values: Float64[np.ndarray, " N"], *, subject: str) -> RationalDistortion | None:
        """Read k1, k2, p1, p2[, k3[, k4, k5, k6]]; None where all are zero."""
        if len(values) not in (0, 4, 5, 8, 12, 14) or values[8:].any():
            raise _misfit(subject, "4, 5 or 8 finite coefficients k1 k2 p1 p2 k3 k4 k5 k6", values)
        if not values.any():
            return None
        full = np.zeros(8)
        full[: min(len(values), 8)] = values[:8]
        k1, k2, p1, p2, k3, k4, k5, k6 = full.tolist()
        return RationalDistortion((k1, k2, k3, k4, k5, k6), (p1, p2))

    def distort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        x, y = np.asarray(xy, dtype=np.float64).T
        (k1, k2, k3, k4, k5, k6), (p1, p2) = self.radial, self.tangential
        r2 = x * x + y * y
        q = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.stack(
            [x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1
        )

    def undistort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """The inverse of `distort`, by Newton.

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

    def native_parameters(self) -> Float64[np.ndarray, " P"]:
        return np.array([*self.radial, *self.tangential])


class _RadialDistortion(Distortion):
    """A lens that moves points along the line to the middle alone."""

    @abstractmethod
    def bent(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        """The distance from the middle at which the lens puts what is at `r`; NaN where it shows nothing."""

    @abstractmethod
    def unbent(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        """The inverse of `bent`; NaN where there is none."""

    def distort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        return _scaled(xy, self.bent)

    def undistort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        return _scaled(xy, self.unbent)


@dataclass(frozen=True)
class FisheyeDistortion(_RadialDistortion):
    """OpenCV's fisheye (`cv2.fisheye`; Kannala and Brandt 2006): equidistant where all coefficients are 0.

    With theta the angle from the axis: `r_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`. Beyond
    the angle where that turns back (or 89 degrees) the lens counts as showing nothing.

    Attributes:
        k: k1..k4.
    """

    k: tuple[float, float, float, float]
    native_id: ClassVar[int] = 1

    @staticmethod
    def from_coefficients(values: Float64[np.ndarray, " N"], *, subject: str) -> FisheyeDistortion:
        """Read k1, k2, k3, k4; none at all are four zeros."""
        if len(values) not in (0, 4):
            raise _misfit(subject, "4 finite coefficients k1 k2 k3 k4 of a fisheye", values)
        k1, k2, k3, k4 = values.tolist() or [0.0] * 4
        return FisheyeDistortion((k1, k2, k3, k4))

    @property
    def reach(self) -> float:
        """The angle from the axis, in radians, up to which the lens is one to one, at most 89 degrees."""
        slope = [1.0, *(n * k for n, k in zip((3, 5, 7, 9), self.k, strict=True))]
        roots = np.asarray(np.polynomial.Polynomial(slope).trim(1e-15).roots(), dtype=np.complex128)
        turns = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(min(_WIDEST, np.sqrt(turns).min(initial=_WIDEST)))

    def bent(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        theta = np.arctan(r)
        return np.where(theta <= self.reach, self._polynomial(theta), np.nan)

    def unbent(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        low, high = np.zeros_like(r), np.full_like(r, self.reach)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            beyond = self._polynomial(middle) < r
            low, high = np.where(beyond, middle, low), np.where(beyond, high, middle)
        return np.where(r <= self._polynomial(np.array([self.reach])), np.tan(0.5 * (low + high)), np.nan)

    def native_parameters(self) -> Float64[np.ndarray, " P"]:
        return np.array([*self.k, np.tan(self.reach)])

    def _polynomial(self, theta: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        t2, (k1, k2, k3, k4) = theta * theta, self.k
        return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


@dataclass(frozen=True)
class FovDistortion(_RadialDistortion):
    """The field-of-view model (Devernay and Faugeras 2001): `r_d = atan(2 r tan(omega / 2)) / omega`.

    Attributes:
        omega: the lens's field of view, in radians, above 0 and below pi.
    """

    omega: float
    native_id: ClassVar[int] = 2

    @staticmethod
    def from_coefficients(values: Float64[np.ndarray, " N"], *, subject: str) -> FovDistortion | None:
        """Read omega; None for 0, which is a pinhole."""
        if len(values) != 1 or not 0 <= values[0] < np.pi:
            raise _misfit(subject, "one angle omega from 0 to below pi", values)
        return FovDistortion(float(values[0])) if values[0] > 0 else None

    def bent(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        return np.arctan(r * self._slope) / self.omega

    def unbent(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        plane = np.tan(np.minimum(r * self.omega, _WIDEST)) / self._slope
        return np.where((r * self.omega < _WIDEST) & (plane < np.tan(_WIDEST)), plane, np.nan)

    def native_parameters(self) -> Float64[np.ndarray, " P"]:
        return np.array([self.omega, self._slope])

    @property
    def _slope(self) -> float:
        return float(2.0 * np.tan(0.5 * self.omega))


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
        image: (H, W) or (H, W, C) uint8, as the lens drew it.
        distortion: the lens.
        source_K: (3, 3) intrinsics of `image`, pixel centres at +0.5.
        target_K: (3, 3) intrinsics of the result.
        size: width and height of the result.
        nearest: take the nearest pixel, for labels.

    Raises:
        InputError: an image without pixels or beyond 65536 a side; intrinsics that cannot be inverted.
    """
    image = np.ascontiguousarray(image, dtype=np.uint8)
    width, height = size
    for columns, rows in ((image.shape[1], image.shape[0]), size):
        check_size(columns, rows, "image to undistort")
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels not in (1, 3):  # the kernel knows grey and colour
        planes = [
            undistort(plane, distortion, source_K=source_K, target_K=target_K, size=size, nearest=nearest)
            for plane in np.moveaxis(image, 2, 0)
        ]
        return np.stack(planes, axis=2) if planes else np.empty((height, width, 0), np.uint8)
    if np.linalg.det(target_K) == 0:
        raise InputError("intrinsics of the undistorted image", expected="focal lengths that are not 0", received="0")
    out = np.empty((height, width, *image.shape[2:]), dtype=np.uint8)
    inverse = np.ascontiguousarray(np.linalg.inv(target_K)[:2], dtype=np.float64)
    K = np.ascontiguousarray(np.asarray(source_K)[:2], dtype=np.float64)
    lens = np.ascontiguousarray(distortion.native_parameters(), dtype=np.float64)
    native_library().smplxpp_undistort_image(
        address(image, "uint8"),
        image.shape[1],
        image.shape[0],
        channels,
        address(inverse, "float64"),
        address(K, "float64"),
        distortion.native_id,
        address(lens, "float64"),
        int(nearest),
        address(out, "uint8"),
        width,
        height,
    )
    return out


def _scaled(xy: Float[np.ndarray, "N 2"], change: Any) -> Float64[np.ndarray, "N 2"]:
    """Points at another distance from the middle, in the same direction."""
    points = np.asarray(xy, dtype=np.float64)
    r = np.linalg.norm(points, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(r > 0, change(r) / r, 1.0)
    return points * factor[:, None]


def _misfit(subject: str, expected: str, received: Float64[np.ndarray, " N"]) -> InputError:
    text = str(received.tolist())[:200]
    return InputError(f"{subject}: distortion", expected=expected, received=text, remedy=_NO_LENS_REMEDY)
