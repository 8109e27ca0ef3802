"""What readers share: cameras from their numbers, image files of a camera."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.capture.files import IMAGE_SUFFIXES, FileSeries, image_name
from smplxpp.capture.recording import ParamSource
from smplxpp.capture.sources import find_params
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import image_size
from smplxpp.core.files.json_file import as_integer, as_numbers
from smplxpp.core.files.paths import check_name


@dataclass(frozen=True, eq=False)
class ReaderOptions:
    """Choices of the user.

    Attributes:
        params: a parameter file or folder instead of the set's own.
        protocol: name of the protocol whose files are read; None: without one.
        body: the body model that the parameters are for; None: the open body.
        person: whose keypoints are taken, where there are several people; None: the surest.
    """

    params: Path | None = None
    protocol: str | None = None
    body: BodyModel | None = None
    person: int | None = None


# Largest deviation of R R^T from the identity: calibrations are written with six digits and more.
_ROTATION_TOLERANCE = 1e-3
# Pixels; the largest sensors have 20,000.
_LONGEST_SIDE = 1 << 16


def pinhole(name: str, K: Any, R: Any, T: Any, size: tuple[int, int], *, opencv_pixels: bool = False) -> Camera:
    """A camera from numbers in any shape: K of 9 (or 4 x 4), R of 9 and T of 3 with x_cam = R x_world + T.

    Args:
        name: of the camera.
        K, R, T: numbers.
        size: width and height.
        opencv_pixels: the calibration puts pixel centres at whole numbers, as OpenCV's routines do; ours are at +0.5,
            so that the principal point moves by half a pixel.

    Raises:
        InputError: wrong counts, anything but finite numbers, R not a rotation, no focal length, a size no image has,
            or a name no file can have.
    """
    subject = f"camera {name[:80]!r}"
    check_name(name, subject=f"{subject}: name")
    intrinsics, rotation = as_numbers(K, subject=f"{subject}: K"), as_numbers(R, subject=f"{subject}: R")
    shift = as_numbers(T, subject=f"{subject}: T")
    intrinsics = intrinsics[:3, :3] if intrinsics.shape == (4, 4) else intrinsics
    if (intrinsics.size, rotation.size, shift.size) != (9, 9, 3):
        received = f"shapes {intrinsics.shape}, {rotation.shape}, {shift.shape}"
        raise InputError(subject, expected="K and R of 9 numbers, T of 3", received=received)
    intrinsics, rotation = intrinsics.reshape(3, 3), rotation.reshape(3, 3)
    if np.abs(rotation).max() > 2 or not (
        np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
    ):
        raise InputError(f"{subject}: R", expected="a rotation matrix", received=f"{rotation.tolist()}")
    if not (intrinsics[2, 2] and intrinsics[[0, 1], [0, 1]].min() > 0 and not intrinsics[2, :2].any()):
        raise InputError(
            f"{subject}: K",
            expected="focal lengths above 0 and a last row 0, 0, 1",
            received=f"{intrinsics.tolist()}",
        )
    width, height = (as_integer(side, subject=f"{subject}: image size", least=1, most=_LONGEST_SIDE) for side in size)
    K = intrinsics / intrinsics[2, 2]
    if opencv_pixels:
        K[:2, 2] += 0.5
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift.ravel()
    return Camera(K, pose, width, height, name=name)


def chosen_params(options: ReaderOptions, own: Path | None = None) -> ParamSource | None:
    """The user's parameters, else the set's own file or folder where it exists."""
    path = options.params or (own if own is not None and own.exists() else None)
    return None if path is None else find_params(path, body=options.body)


def inverted(world_from_cam: Any) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """R and T of `x_cam = R x_world + T` from a (4, 4) or (3, 4) camera-to-world matrix.

    Scaled axes, as tools write them that scale a scene by its matrices, are made units again: a pinhole's picture has
    no depth, and no pixel moves.
    """
    matrix = as_numbers(world_from_cam, subject="camera-to-world matrix")
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError("camera-to-world matrix", expected="shape (4, 4) or (3, 4)", received=f"{matrix.shape}")
    rotation = matrix[:3, :3].T
    with np.errstate(over="ignore", invalid="ignore"):
        volume = np.linalg.det(rotation)
    if 0 < volume < np.inf:
        rotation = rotation / np.cbrt(volume)
    return rotation, -rotation @ matrix[:3, 3]


def numbered_images(folders: Mapping[str, Path]) -> dict[str, FileSeries]:
    """Find each camera's images in its folder whose names are numbers; cameras without any are left out."""
    found = {name: FileSeries.find(folder, image_name()) for name, folder in folders.items()}
    return {name: series for name, series in found.items() if len(series)}


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


# Folders that say nothing of a camera, with nerfstudio's reductions (images_4).
_IMAGE_FOLDER = re.compile(r"(?:images?|imgs?|rgbs?)(?:_\d+)?")
# What an int64 holds.
_NUMBERED = re.compile(r"(.*?)([0-9]{1,18})", re.DOTALL)


def camera_names(paths: Iterable[PurePosixPath], *, subject: str) -> dict[PurePosixPath, str]:
    """A name of its own for each path: its parts joined by `_`.

    Left out are a first folder such as `images` and the suffix, as long as names stay different without.

    Raises:
        InputError: names that remain alike, or that no file can bear.
    """
    distinct = list(dict.fromkeys(paths))
    for folder, suffix in ((False, False), (True, False), (True, True)):
        names = {path: _spelled(path, folder=folder, suffix=suffix) for path in distinct}
        if len(set(names.values())) == len(distinct):
            return {path: check_name(name, subject=f"{subject}: image {path}") for path, name in names.items()}
    alike = sorted(names, key=lambda path: names[path])
    pair = next((a, b) for a, b in pairwise(alike) if names[a] == names[b])
    raise InputError(
        f"{subject}: images {pair[0]} and {pair[1]}",
        expected="paths that give cameras different names",
        received=f"{names[pair[0]]} for both",
        remedy="rename one of the folders",
    )


def without_suffix(path: PurePosixPath) -> PurePosixPath:
    """The path without the suffix of an image; a dot in a name alone is none."""
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def number_at_end(path: PurePosixPath) -> tuple[str, int] | None:
    """What precedes the number at the end of an image's name, and the number; None where there is none."""
    match = _NUMBERED.fullmatch(without_suffix(path).name)
    return None if match is None else (match[1], int(match[2]))


def _spelled(path: PurePosixPath, *, folder: bool, suffix: bool) -> str:
    parts = (path if suffix else without_suffix(path)).parts
    if not folder and len(parts) > 1 and _IMAGE_FOLDER.fullmatch(parts[0].lower()):
        parts = parts[1:]
    return "_".join(parts) or "camera"
