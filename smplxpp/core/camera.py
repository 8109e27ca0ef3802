"""Define pinhole and orthographic cameras in OpenCV's axes (x right, y down, z forward), pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Num

from smplxpp.core.errors import InputError, one_line


@dataclass(frozen=True)
class Camera:
    """A pinhole or orthographic camera without lens distortion.

    Attributes:
        K: (3, 3) intrinsics in pixels. For an orthographic camera the focal lengths are pixels a metre.
        cam_from_world: (4, 4) rigid transform, `x_cam = R x_world + t`.
        width: of the image in pixels.
        height: of the image in pixels.
        orthographic: parallel projection instead of a pinhole.
        name: for messages and files.

    Example:
        >>> K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> camera = smplxpp.Camera(K, np.eye(4), 640, 480)
        >>> camera.screen_from_world(np.array([[0.0, 0.0, 2.0]]))[0, :2]
        array([320., 240.])
    """

    K: Float64[np.ndarray, "3 3"]
    cam_from_world: Float64[np.ndarray, "4 4"]
    width: int
    height: int
    orthographic: bool = False
    name: str = ""

    __repr__ = one_line

    def __post_init__(self) -> None:
        for field, shape in (("K", (3, 3)), ("cam_from_world", (4, 4))):
            value = np.asarray(getattr(self, field), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(
                    f"camera {self.name!r}: {field}",
                    expected=f"finite values of shape {shape}",
                    received=f"shape {value.shape}, finite: {bool(np.isfinite(value).all())}",
                    remedy="check the calibration file",
                )
            object.__setattr__(self, field, value)
        if self.width < 1 or self.height < 1:
            raise InputError(
                f"camera {self.name!r}: image size", expected="at least 1 x 1", received=f"{self.width} x {self.height}"
            )

    @property
    def position(self) -> Float64[np.ndarray, " 3"]:
        """Centre of projection in world coordinates; meaningless for an orthographic camera."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    @property
    def forward(self) -> Float64[np.ndarray, " 3"]:
        """Unit viewing direction in world coordinates."""
        return self.cam_from_world[2, :3]

    def screen_from_world(self, points: Num[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4"]:
        """Project world points to x, y in pixels, depth in metres and interpolation weight (1/z, orthographic 1)."""
        # One row per coordinate, so that every operation reads contiguous memory.
        # (3, N) points in the camera's axes: x_cam = R x + t.
        cam = self.cam_from_world[:3, :3] @ np.asarray(points, dtype=np.float64).T + self.cam_from_world[:3, 3:]
        screen = np.empty((4, cam.shape[1]))
        screen[2] = cam[2]
        # Points in the camera's plane give infinity; callers test the depth instead.
        with np.errstate(divide="ignore", invalid="ignore"):
            screen[3] = 1.0 if self.orthographic else 1.0 / cam[2]
            # K without its last row: u = f x / z + c; an orthographic camera leaves out the division.
            screen[:2] = self.K[:2, :2] @ cam[:2] * screen[3] + self.K[:2, 2:]
        return screen.T

    def cropped(self, box: tuple[float, float, float, float], *, size: tuple[int, int] | None = None) -> Camera:
        """Return the camera of a rectangle of the image, resampled where a size is given.

        With pixel centres at +0.5 the image spans [0, width] x [0, height], and a point at x is at
        `(x - x0) * width / (x1 - x0)` afterwards: principal point and focal lengths follow.

        Args:
            box: x0, y0, x1, y1 in pixels; it may extend past the image.
            size: width and height of the result; None keeps the resolution, and the box must be of whole pixels.

        Raises:
            InputError: an empty box, or fractional pixels without a size.
        """
        x0, y0, x1, y1 = box
        if not (x0 < x1 and y0 < y1) or (size is None and not all(float(edge).is_integer() for edge in box)):
            raise InputError(
                f"camera {self.name!r}: crop box",
                expected="x0 < x1 and y0 < y1" + ("" if size else ", whole pixels"),
                received=f"{tuple(box)}",
            )
        width, height = size or (int(x1 - x0), int(y1 - y0))
        sx, sy = width / (x1 - x0), height / (y1 - y0)
        # u' = (u - x0) s as a matrix on homogeneous pixels, so that K' = W K keeps the skew right too.
        window_from_full = np.array([[sx, 0.0, -x0 * sx], [0.0, sy, -y0 * sy], [0.0, 0.0, 1.0]])
        return replace(self, K=window_from_full @ self.K, width=width, height=height)

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the whole image at another resolution."""
        return self.cropped((0, 0, self.width, self.height), size=(width, height))

    @staticmethod
    def look_at(
        *, eye: np.ndarray, target: np.ndarray, fov_y_deg: float, width: int, height: int, up: tuple = (0.0, 1.0, 0.0)
    ) -> Camera:
        """Return a pinhole camera at `eye` looking at `target` (world, metres); vertical angle of view in degrees."""
        f = 0.5 * height / np.tan(np.radians(fov_y_deg) / 2)
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
        return Camera(K, _look_at_pose(np.asarray(eye, float), np.asarray(target, float), up), width, height)

    @staticmethod
    def orthographic_view(*, center: np.ndarray, direction: np.ndarray, half_extent: float, size: int) -> Camera:
        """Return a square parallel view of the ball about `center` with radius `half_extent`, seen along `-direction`.

        `direction` points from the centre to the camera.
        """
        direction = np.asarray(direction, float) / np.linalg.norm(direction)
        # The eye lies outside the ball, at twice its radius, so that all depths are positive.
        eye = np.asarray(center, float) + direction * 2.0 * half_extent
        # A view along the vertical takes +z as its upper edge, because +y has no direction in the image.
        up = (0.0, 1.0, 0.0) if abs(direction[1]) < 0.99 else (0.0, 0.0, 1.0)
        # Pixels per metre; the ball fills the square image.
        scale = size / (2.0 * half_extent)
        K = np.array([[scale, 0, size / 2], [0, scale, size / 2], [0, 0, 1.0]])
        return Camera(K, _look_at_pose(eye, np.asarray(center, float), up), size, size, orthographic=True)


def _look_at_pose(eye: np.ndarray, target: np.ndarray, up: tuple[float, float, float]) -> np.ndarray:
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, np.asarray(up, float))
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose
