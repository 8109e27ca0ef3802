"""Cameras as a calibration file has them: in its own units and axes, before they are converted to this package's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.capture.distortion import OPENCV
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_numbers
from smplxpp.core.files.paths import ascii_numbers
from smplxpp.core.rotations import matrix_from_rotvec

AXES: Mapping[str, tuple[float, float, float]] = {
    "x": (1, 0, 0),
    "y": (0, 1, 0),
    "z": (0, 0, 1),
    "-x": (-1, 0, 0),
    "-y": (0, -1, 0),
    "-z": (0, 0, -1),
}
"""Directions by the names that users give them."""


@dataclass(frozen=True, eq=False)
class FileCamera:
    """A camera of a calibration file, `x_cam = R x_world + T` with OpenCV's axes of the camera.

    Attributes:
        name: name in the file.
        K: intrinsics in pixels, with pixel centres at whole numbers as OpenCV has them.
        R: rotation from the world to the camera.
        T: translation, in the file's unit.
        size: width and height of the image; None where the file does not say.
        dist: coefficients of the lens in OpenCV's order.
        model: name of the lens model (`smplxpp.capture.distortion.LENS_MODELS`).
        centred: whether pixel centres are at +0.5 instead.
    """

    name: str
    K: Float64[np.ndarray, "3 3"]
    R: Float64[np.ndarray, "3 3"]
    T: Float64[np.ndarray, " 3"]
    size: tuple[int, int] | None = None
    dist: Sequence[float] = ()
    model: str = OPENCV
    centred: bool = False

    @property
    def centre(self) -> Float64[np.ndarray, " 3"]:
        """Position of the camera, in the file's unit."""
        return -self.R.T @ self.T


@dataclass(frozen=True, eq=False)
class RigFile:
    """Cameras and world of a calibration file.

    Attributes:
        cameras: in the order of the file.
        metres: length of the file's unit in metres; None where the format leaves it to the user.
        up: axis of the world that points up; None where the format leaves it to the user.
        notes: sentences about what was left out.
    """

    cameras: tuple[FileCamera, ...]
    metres: float | None = None
    up: str | None = None
    notes: tuple[str, ...] = field(default=())


def file_camera(
    name: str,
    K: Any,
    rotation: Any,
    T: Any,
    *,
    source: str,
    size: Any = None,
    dist: Any = (),
    **more: Any,
) -> FileCamera:
    """Check and shape the numbers of a camera.

    Args:
        name: name of the camera.
        K: nine numbers, or the 3 x 4 or 4 x 4 matrix that holds them.
        rotation: rotation matrix from the world to the camera, or its rotation vector.
        T: three numbers.
        source: the file, in messages.
        size: width and height; None where unknown.
        dist: coefficients of the lens, nested or not.
        more: `model` and `centred` of `FileCamera`.

    Raises:
        InputError: another count of numbers, or values that are not finite.
    """
    subject = f"{source}: camera {name}"
    intrinsics = numbers_of(K, subject=f"{subject}: intrinsics")
    intrinsics = intrinsics[:3, :3] if intrinsics.ndim == 2 and intrinsics.shape != (3, 3) else intrinsics
    turn = numbers_of(rotation, subject=f"{subject}: rotation")
    shift = numbers_of(T, subject=f"{subject}: translation").ravel()
    if intrinsics.size != 9 or turn.size not in (3, 9) or shift.size != 3:
        raise InputError(
            subject,
            expected="9 intrinsics, a rotation of 3 or 9 numbers, a translation of 3",
            received=f"{intrinsics.size}, {turn.size}, {shift.size}",
        )
    R = matrix_from_rotvec(turn.ravel()) if turn.size == 3 else turn.reshape(3, 3)
    width_height = None
    if size is not None:
        sides = numbers_of(size, subject=f"{subject}: image size").ravel()
        if sides.size != 2 or not (sides >= 1).all():
            raise InputError(f"{subject}: image size", expected="width and height", received=f"{sides.tolist()}")
        width_height = (round(float(sides[0])), round(float(sides[1])))
    lens = tuple(numbers_of(dist, subject=f"{subject}: distortion").ravel().tolist())
    return FileCamera(name, intrinsics.reshape(3, 3), R, shift, width_height, lens, **more)


def numbers_of(value: Any, *, subject: str) -> np.ndarray:
    """Return numbers, or texts that hold them with blanks between, as an array.

    Raises:
        InputError: other values than finite numbers.
    """
    if isinstance(value, str):
        try:
            value = [float(part) for part in ascii_numbers(value).replace(",", " ").split()]
        except ValueError:
            raise InputError(subject, expected="numbers", received=value[:80]) from None
    return np.asarray(as_numbers(value, subject=subject), dtype=np.float64)


def entry(mapping: Any, key: str, *, source: str) -> Any:
    """Return an entry of a table that must be there.

    Raises:
        InputError: no table, or none of that key.
    """
    if not isinstance(mapping, Mapping) or key not in mapping:
        have = ", ".join(map(str, list(mapping)[:8])) if isinstance(mapping, Mapping) else type(mapping).__name__
        raise InputError(source, expected=f"an entry {key}", received=have or "nothing")
    return mapping[key]


def scaled_intrinsics(K: Float64[np.ndarray, "3 3"], factors: tuple[float, float]) -> Float64[np.ndarray, "3 3"]:
    """Return the intrinsics of a resized image, pixel centres at +0.5 in both."""
    return np.diag([factors[0], factors[1], 1.0]) @ K
