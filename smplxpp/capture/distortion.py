"""Model lens distortion with OpenCV's parameters on the plane z = 1, and undistort images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from smplxpp.core import InputError, require_choice
from smplxpp.core.files.json_file import as_numbers
from smplxpp.native import address, check_size, native_library

OPENCV, FISHEYE, FOV = LENS_MODELS = ("opencv", "fisheye", "fov")
"""Names of the models in `dist_model` of cameras.json."""

# Largest angle from the axis that undistortion shows: at 90 degrees a pinhole image would be infinite.
_WIDEST = np.radians(89.0)
_NO_LENS_REMEDY = "calibrate without thin prism and tilt, or undistort the images beforehand"


class Distortion(ABC):
    """Maps points of the plane z = 1 of the pinhole camera to their places after lens distortion, and back.

    Attributes:
        native_id: number of the model in the native library.
    """

    native_id: ClassVar[int]

    @abstractmethod
    def distort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Return the distorted points on the plane z = 1; NaN for points that the lens does not show."""

    @abstractmethod
    def undistort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Return the undistorted points on the plane z = 1, the inverse of `distort`.

        NaN for points that no pinhole shows (89 degrees from the axis and more).
        """

    @abstractmethod
    def native_parameters(self) -> Float64[np.ndarray, " P"]:
        """Return the parameters of this model for the native library."""

    @staticmethod
    def from_opencv(coefficients: Any, *, subject: str, model: str = OPENCV) -> Distortion | None:
        """Read coefficients in OpenCV's order, nested or not; None where the lens is a pinhole.

        Args:
            coefficients: `opencv`: k1, k2, p1, p2[, k3[, k4, k5, k6]]; `fisheye` (`cv2.fisheye`): k1, k2, k3, k4;
                `fov`: omega, in radians.
            subject: name of the camera in messages.
            model: one of `LENS_MODELS`.

        Raises:
            InputError: an unknown model, other values than finite numbers, another number of them (thin prism and tilt:
                nonzero ones after the eighth), no field of view.
        """
        require_choice(f"{subject}: model of the lens", model, LENS_MODELS)
        # OpenCV writes coefficients as a row, a column or nested lists.
        values = as_numbers(coefficients, subject=f"{subject}: distortion").ravel()
        largest = 1e12  # telephoto lenses have large coefficients, because their radii are small
        if np.abs(values).max(initial=0.0) > largest:
            raise _coefficient_error(subject, f"coefficients of at most {largest:g}", values)
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
        radial: coefficients k1..k6.
        tangential: coefficients p1, p2.
    """

    radial: tuple[float, float, float, float, float, float]
    tangential: tuple[float, float]
    native_id: ClassVar[int] = 0

    @property
    def fold(self) -> float:
        """Radius on the plane z = 1 from which the distorted radius decreases; infinity where there is none.

        Coefficients are fitted to a pattern that rarely reaches a picture's edges. Outside of it a pinhole would show
        parts of the picture a second time, mirrored.
        """
        k1, k2, k3, k4, k5, k6 = self.radial
        # With s = r^2, r q(s) increases while N D + 2 s (N' D - N D') > 0, and has a pole where D = 0.
        above, below = (np.polynomial.Polynomial([1.0, *k]) for k in ((k1, k2, k3), (k4, k5, k6)))
        with np.errstate(invalid="ignore", over="ignore"):
            slope = above * below + 2.0 * np.polynomial.Polynomial([0.0, 1.0]) * (
                above.deriv() * below - above * below.deriv()
            )
        # Coefficients that are not finite, or whose products are not, have no radius at which they turn.
        if not all(np.isfinite(p.coef).all() for p in (slope, below)):
            return float("inf")
        roots = np.concatenate([np.asarray(p.trim(1e-15).roots(), dtype=np.complex128) for p in (slope, below)])
        turns = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(np.sqrt(turns.min(initial=np.inf)))

    @staticmethod
    def from_coefficients(values: Float64[np.ndarray, " N"], *, subject: str) -> RationalDistortion | None:
        """Read k1, k2, p1, p2[, k3[, k4, k5, k6]]; None where all are zero."""
        # Twelve and fourteen are OpenCV's counts with thin prism and tilt, which are read only if these are zero.
        if len(values) not in (0, 4, 5, 8, 12, 14) or values[8:].any():
            raise _coefficient_error(subject, "4, 5 or 8 finite coefficients k1 k2 p1 p2 k3 k4 k5 k6", values)
        if not values.any():
            return None
        # OpenCV's order puts the tangential p1, p2 between k2 and k3.
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
        """Invert `distort` by twelve Newton steps with a numerical Jacobian.

        Far outside of the image the polynomial is not monotonic, so that it has no inverse and the result is
        meaningless.
        """
        target = np.asarray(xy, dtype=np.float64)
        found, step = target.copy(), 1e-6
        for _ in range(12):
            # Newton for distort(x) = target, with the Jacobian [[a, b], [c, d]] by forward differences on the plane z
            # = 1.
            value = self.distort(found)
            # Columns of the Jacobian, (N, 2) each: derivatives by x, then by y.
            columns = [(self.distort(found + shift) - value) / step for shift in step * np.eye(2)]
            (a, c), (b, d) = (column.T for column in columns)
            determinant = a * d - b * c
            # A singular Jacobian marks the fold of the polynomial; a small determinant keeps the numbers finite
            # there.
            determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
            # The inverse of a 2 x 2 matrix, written out for all points at once.
            u, v = (target - value).T
            found = found + np.stack([d * u - b * v, a * v - c * u], axis=1) / determinant[:, None]
        return found

    def native_parameters(self) -> Float64[np.ndarray, " P"]:
        return np.array([*self.radial, *self.tangential])


class _RadialDistortion(Distortion):
    """A lens that moves points only along the line to the principal point."""

    @abstractmethod
    def distorted_radius(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        """Return the distorted radius of points at radius `r`; NaN where the lens shows nothing."""

    @abstractmethod
    def undistorted_radius(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        """Return the inverse of `distorted_radius`; NaN where there is none."""

    def distort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        return _scaled_radially(xy, self.distorted_radius)

    def undistort(self, xy: Float[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        return _scaled_radially(xy, self.undistorted_radius)


@dataclass(frozen=True)
class FisheyeDistortion(_RadialDistortion):
    """OpenCV's fisheye (`cv2.fisheye`; Kannala and Brandt 2006): equidistant where all coefficients are 0.

    With theta the angle from the axis: `r_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`. The lens
    shows nothing from the angle on at which r_d decreases (or 89 degrees).

    Attributes:
        k: coefficients k1..k4.
    """

    k: tuple[float, float, float, float]
    native_id: ClassVar[int] = 1

    @staticmethod
    def from_coefficients(values: Float64[np.ndarray, " N"], *, subject: str) -> FisheyeDistortion:
        """Read k1, k2, k3, k4; none at all are four zeros."""
        if len(values) not in (0, 4):
            raise _coefficient_error(subject, "4 finite coefficients k1 k2 k3 k4 of a fisheye", values)
        k1, k2, k3, k4 = values.tolist() or [0.0] * 4
        return FisheyeDistortion((k1, k2, k3, k4))

    @property
    def max_angle(self) -> float:
        """Angle from the axis, in radians, up to which r_d increases, at most 89 degrees."""
        # The first positive root of the derivative of r_d, as a polynomial in theta^2.
        slope = [1.0, *(n * k for n, k in zip((3, 5, 7, 9), self.k, strict=True))]
        roots = np.asarray(np.polynomial.Polynomial(slope).trim(1e-15).roots(), dtype=np.complex128)
        turns = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(min(_WIDEST, np.sqrt(turns).min(initial=_WIDEST)))

    def distorted_radius(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        theta = np.arctan(r)
        return np.where(theta <= self.max_angle, self._polynomial(theta), np.nan)

    def undistorted_radius(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        low, high = np.zeros_like(r), np.full_like(r, self.max_angle)
        # Bisection: 60 halvings reach the precision of float64.
        for _ in range(60):
            middle = 0.5 * (low + high)
            outside = self._polynomial(middle) < r
            low, high = np.where(outside, middle, low), np.where(outside, high, middle)
        return np.where(r <= self._polynomial(np.array([self.max_angle])), np.tan(0.5 * (low + high)), np.nan)

    def native_parameters(self) -> Float64[np.ndarray, " P"]:
        return np.array([*self.k, np.tan(self.max_angle)])

    def _polynomial(self, theta: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        t2, (k1, k2, k3, k4) = theta * theta, self.k
        return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


@dataclass(frozen=True)
class FovDistortion(_RadialDistortion):
    """The field-of-view model (Devernay and Faugeras 2001): `r_d = atan(2 r tan(omega / 2)) / omega`.

    Attributes:
        omega: field of view of the lens, in radians, above 0 and below pi.
    """

    omega: float
    native_id: ClassVar[int] = 2

    @staticmethod
    def from_coefficients(values: Float64[np.ndarray, " N"], *, subject: str) -> FovDistortion | None:
        """Read omega; None for 0, which is a pinhole."""
        if len(values) != 1 or not 0 <= values[0] < np.pi:
            raise _coefficient_error(subject, "one angle omega from 0 to below pi", values)
        return FovDistortion(float(values[0])) if values[0] > 0 else None

    def distorted_radius(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
        return np.arctan(r * self._slope) / self.omega

    def undistorted_radius(self, r: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
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
    """Return the image of a pinhole camera, resampled bilinearly, black where the source has no pixels.

    Args:
        image: (H, W) or (H, W, C) uint8, distorted.
        distortion: distortion of the lens.
        source_K: (3, 3) intrinsics of `image`, pixel centres at +0.5.
        target_K: (3, 3) intrinsics of the result.
        size: width and height of the result.
        nearest: take the nearest pixel, for labels.

    Raises:
        InputError: an image without pixels or with sides over 65536; intrinsics that cannot be inverted.
    """
    image = np.ascontiguousarray(image, dtype=np.uint8)
    width, height = size
    for columns, rows in ((image.shape[1], image.shape[0]), size):
        check_size(columns, rows, "image to undistort")
    channels = 1 if image.ndim == 2 else image.shape[2]
    # Bilinear sampling treats channels separately, so that any number of them can be done one at a time.
    if channels not in (1, 3):  # the kernel takes one or three channels
        planes = [
            undistort(plane, distortion, source_K=source_K, target_K=target_K, size=size, nearest=nearest)
            for plane in np.moveaxis(image, 2, 0)
        ]
        return np.stack(planes, axis=2) if planes else np.empty((height, width, 0), np.uint8)
    if np.linalg.det(target_K) == 0:
        raise InputError("intrinsics of the undistorted image", expected="focal lengths that are not 0", received="0")
    # The kernel maps each pixel of the result to the plane z = 1, distorts it there, and samples the source.
    out = np.empty((height, width, *image.shape[2:]), dtype=np.uint8)
    # Rows of K^-1 that map a pixel (u, v, 1) to x and y on the plane z = 1; the third row is (0, 0, 1).
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
    if isinstance(distortion, RationalDistortion):
        out[beyond_fold(distortion, target_K, size)] = 0
    return out


def beyond_fold(
    distortion: RationalDistortion, K: Float[np.ndarray, "3 3"], size: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a pinhole that a lens does not show, because its radial polynomial has turned back there."""
    width, height = size
    ray = np.linalg.inv(K)
    corners = np.array([[u, v, 1.0] for u in (0.0, width) for v in (0.0, height)]) @ ray.T
    if (corners[:, :2] ** 2).sum(axis=1).max() <= distortion.fold**2:
        return np.zeros((height, width), dtype=bool)
    u, v = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    x, y = (ray[row, 0] * u + ray[row, 1] * v + ray[row, 2] for row in (0, 1))
    return x * x + y * y > distortion.fold**2


def _scaled_radially(xy: Float[np.ndarray, "N 2"], change: Any) -> Float64[np.ndarray, "N 2"]:
    """Scale points to the radius that `change` returns, in the same direction."""
    points = np.asarray(xy, dtype=np.float64)
    r = np.linalg.norm(points, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(r > 0, change(r) / r, 1.0)
    return points * factor[:, None]


def _coefficient_error(subject: str, expected: str, received: Float64[np.ndarray, " N"]) -> InputError:
    text = str(received.tolist())[:200]
    return InputError(f"{subject}: distortion", expected=expected, received=text, remedy=_NO_LENS_REMEDY)
