"""What readers share: JSON, cameras from their numbers, image files of a camera."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.capture.files import FileSeries, image_name
from smplxpp.capture.params import find_params
from smplxpp.capture.readers.options import ReaderOptions
from smplxpp.capture.recording import ParamSource
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError

# Largest deviation of R R^T from the identity: calibrations are written with six digits and more.
_ROTATION_TOLERANCE = 1e-3


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        InputError: missing or broken.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"file {path}", expected="a readable file", received=error.strerror or str(error)) from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"file {path}", expected="JSON", received=str(error)) from None


def pinhole(name: str, K: Any, R: Any, T: Any, size: tuple[int, int], *, opencv_pixels: bool = False) -> Camera:
    """A camera from numbers in any shape: K of 9 (or 4 x 4), R of 9 and T of 3 with x_cam = R x_world + T.

    Args:
        name: of the camera.
        K, R, T: numbers.
        size: width and height.
        opencv_pixels: the calibration puts pixel centres at whole numbers, as OpenCV's routines do; ours are at +0.5,
            so that the principal point moves by half a pixel.

    Raises:
        InputError: wrong counts, not finite, or R not a rotation.
    """
    try:
        intrinsics = np.asarray(K, dtype=np.float64)
        intrinsics = intrinsics[:3, :3] if intrinsics.shape == (4, 4) else intrinsics.reshape(3, 3)
        rotation, shift = np.asarray(R, np.float64).reshape(3, 3), np.asarray(T, np.float64).reshape(3)
    except (TypeError, ValueError) as error:
        raise InputError(f"camera {name!r}", expected="K and R of 9 numbers, T of 3", received=str(error)) from None
    if not (np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0):
        raise InputError(f"camera {name!r}: R", expected="a rotation matrix", received=f"{rotation.round(4).tolist()}")
    K = intrinsics / intrinsics[2, 2]
    if opencv_pixels:
        K[:2, 2] += 0.5
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift
    return Camera(K, pose, int(size[0]), int(size[1]), name=name)


def chosen_params(options: ReaderOptions, own: Path | None = None) -> ParamSource | None:
    """The user's parameters, else the set's own file or folder where it exists."""
    path = options.params or (own if own is not None and own.exists() else None)
    return None if path is None else find_params(path, body=options.body)


def inverted(world_from_cam: Any) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """R and T of `x_cam = R x_world + T` from a (4, 4) or (3, 4) camera-to-world matrix."""
    matrix = np.asarray(world_from_cam, dtype=np.float64)
    rotation = matrix[:3, :3].T
    return rotation, -rotation @ matrix[:3, 3]


def numbered_images(folders: Mapping[str, Path]) -> dict[str, FileSeries]:
    """Find each camera's images in its folder whose names are numbers; cameras without any are left out."""
    found = {name: FileSeries.find(folder, image_name()) for name, folder in folders.items()}
    return {name: series for name, series in found.items() if len(series)}


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, from its header.

    Raises:
        InputError: not an image.
    """
    import PIL.Image

    try:
        with PIL.Image.open(path) as image:
            return image.size
    except OSError as error:
        raise InputError(f"image file {path}", expected="an image", received=str(error)) from None


def size_of_first_image(name: str, files: Mapping[str, FileSeries]) -> tuple[int, int]:
    """Read the images' size from the first one, for calibrations that do not say it.

    Raises:
        InputError: the camera has no image.
    """
    if name not in files:
        raise InputError(
            f"camera {name!r}",
            expected="an image, because the calibration does not say its size",
            received="none",
            remedy="remove the camera from the calibration, or add its images",
        )
    series = files[name]
    return image_size(series.required(int(series.numbers[0])))


def first_folder(root: Path, names: Iterable[str]) -> Path | None:
    """The first of these folders that exists."""
    return next((root / name for name in names if (root / name).is_dir()), None)


def required(mapping: Any, key: str, *, source: str) -> Any:
    """`mapping[key]`.

    Raises:
        InputError: no such key.
    """
    if not isinstance(mapping, Mapping) or key not in mapping:
        have = ", ".join(map(str, list(mapping)[:12])) if isinstance(mapping, Mapping) else type(mapping).__name__
        raise InputError(source, expected=f"an entry {key!r}", received=have or "nothing")
    return mapping[key]
