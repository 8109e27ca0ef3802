"""Share options, cameras, image files and camera names among the readers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.capture.files import IMAGE_SUFFIXES, FileSeries, image_name
from smplxpp.capture.recording import ParamSource
from smplxpp.capture.sources import find_params
from smplxpp.core import Camera, InputError, require_choice
from smplxpp.core.files.image_file import image_size
from smplxpp.core.files.json_file import as_integer, as_numbers
from smplxpp.core.files.paths import check_name


@dataclass(frozen=True, eq=False)
class ReaderOptions:
    """Options of `open_capture` that every reader receives.

    Attributes:
        params: parameter file or folder that replaces the data set's own.
        protocol: name of the protocol whose files are read; None: no protocol.
        body: body model of the parameters; None: the open body.
        person: id of the person whose keypoints are taken; None: the subject (`smplxpp.capture.subject`).
        rig: calibration, unit and axes of a rig whose layout is not that of a data set.
    """

    params: Path | None = None
    protocol: str | None = None
    body: BodyModel | None = None
    person: int | None = None
    rig: RigOptions = field(default_factory=lambda: RigOptions())


@dataclass(frozen=True)
class RigOptions:
    """Options of a laboratory's rig (`smplxpp.capture.readers.rig`).

    Attributes:
        calibration: calibration file, or folder with one; None: looked for in the folder and beside it.
        units: unit of the calibration's lengths (m, cm, mm, inch); None: that of its format, else guessed.
        up: axis of its world that points up; None: that of its format, else what the pictures say.

    Raises:
        InputError: an unknown unit or axis, a path that does not exist.
    """

    calibration: Path | None = None
    units: str | None = None
    up: str | None = None

    def __post_init__(self) -> None:
        if self.units is not None:
            require_choice("--units", self.units, ("m", "cm", "mm", "inch"))
        if self.up is not None:
            require_choice("--up", self.up, ("x", "y", "z", "-x", "-y", "-z"))
        if self.calibration is not None and not self.calibration.exists():
            raise InputError("--calibration", expected="a file, or a folder with one", received=str(self.calibration))


def pinhole(name: str, K: Any, R: Any, T: Any, size: tuple[int, int], *, opencv_pixels: bool = False) -> Camera:
    """Return a camera from numbers in any shape: K of 9 (or 4 x 4), R of 9 and T of 3 with x_cam = R x_world + T.

    Args:
        name: name of the camera.
        K: intrinsics in pixels.
        R: rotation from the world to the camera.
        T: translation from the world to the camera.
        size: width and height of the image.
        opencv_pixels: whether the calibration puts pixel centres at whole numbers, as OpenCV's routines do. Half a
            pixel is then added to the principal point, because centres are at +0.5 here.

    Raises:
        InputError: wrong counts, anything but finite numbers, R that is not a rotation, no focal length, an impossible
            image size, or a name that no file can have.
    """
    # Names come from files and end up in paths and messages, so that they are cut and checked.
    subject = f"camera {name[:80]!r}"
    check_name(name, subject=f"{subject}: name")
    intrinsics, rotation = as_numbers(K, subject=f"{subject}: K"), as_numbers(R, subject=f"{subject}: R")
    shift = as_numbers(T, subject=f"{subject}: T")
    intrinsics = intrinsics[:3, :3] if intrinsics.shape == (4, 4) else intrinsics
    if (intrinsics.size, rotation.size, shift.size) != (9, 9, 3):
        received = f"shapes {intrinsics.shape}, {rotation.shape}, {shift.shape}"
        raise InputError(subject, expected="K and R of 9 numbers, T of 3", received=received)
    intrinsics, rotation = intrinsics.reshape(3, 3), rotation.reshape(3, 3)
    # Calibrations are written with six digits or more, so that R R^T is the identity to better than 1e-3.
    if np.abs(rotation).max() > 2 or not (
        np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3 and np.linalg.det(rotation) > 0
    ):
        raise InputError(f"{subject}: R", expected="a rotation matrix", received=f"{rotation.tolist()}")
    if not (intrinsics[2, 2] and intrinsics[[0, 1], [0, 1]].min() > 0 and not intrinsics[2, :2].any()):
        raise InputError(
            f"{subject}: K",
            expected="focal lengths above 0 and a last row 0, 0, 1",
            received=f"{intrinsics.tolist()}",
        )
    # The largest sensors have 20,000 pixels a side.
    width, height = (as_integer(side, subject=f"{subject}: image size", least=1, most=1 << 16) for side in size)
    # Normalise the scale of the homogeneous matrix.
    K = intrinsics / intrinsics[2, 2]
    if opencv_pixels:
        # From pixel centres at whole numbers to centres at +0.5: the principal point moves by half a pixel.
        K[:2, 2] += 0.5
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift.ravel()
    return Camera(K, pose, width, height, name=name)


def chosen_params(options: ReaderOptions, own: Path | None = None) -> ParamSource | None:
    """Return the parameters of the options, else those of the data set if its file or folder exists."""
    path = options.params or (own if own is not None and own.exists() else None)
    return None if path is None else find_params(path, body=options.body)


def inverted(world_from_cam: Any) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """Return R and T of `x_cam = R x_world + T` from a (4, 4) or (3, 4) camera-to-world matrix.

    Uniformly scaled axes, which tools write that scale a scene by its matrices, are normalised. That moves no pixel of
    a pinhole image.
    """
    matrix = as_numbers(world_from_cam, subject="camera-to-world matrix")
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError("camera-to-world matrix", expected="shape (4, 4) or (3, 4)", received=f"{matrix.shape}")
    # The inverse of a rotation is its transpose; with uniformly scaled axes s R the determinant is s^3.
    rotation = matrix[:3, :3].T
    with np.errstate(over="ignore", invalid="ignore"):
        volume = np.linalg.det(rotation)
    if 0 < volume < np.inf:
        rotation = rotation / np.cbrt(volume)
    # t = -R c, with the camera's position c.
    return rotation, -rotation @ matrix[:3, 3]


def numbered_images(folders: Mapping[str, Path]) -> dict[str, FileSeries]:
    """Find the images with numbers for names in each camera's folder; cameras without any are left out."""
    found = {name: FileSeries.find(folder, image_name()) for name, folder in folders.items()}
    return {name: series for name, series in found.items() if len(series)}


def size_of_first_image(name: str, files: Mapping[str, FileSeries]) -> tuple[int, int]:
    """Return the size of a camera's first image, for calibrations without image sizes.

    Raises:
        InputError: a camera without an image.
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
    """Return the first of these folders that exists; None without any."""
    return next((root / name for name in names if (root / name).is_dir()), None)


def required(mapping: Any, key: str, *, source: str) -> Any:
    """Return `mapping[key]`; refuse a missing key.

    Raises:
        InputError: no such key, or not a mapping.
    """
    if not isinstance(mapping, Mapping) or key not in mapping:
        have = ", ".join(map(str, list(mapping)[:12])) if isinstance(mapping, Mapping) else type(mapping).__name__
        raise InputError(source, expected=f"an entry {key!r}", received=have or "nothing")
    return mapping[key]


# Names of image folders that do not name a camera, with nerfstudio's reductions (images_4).
_IMAGE_FOLDER = re.compile(r"(?:images?|imgs?|rgbs?)(?:_\d+)?")
# A number at the end of a name, of as many digits as an int64 holds.
_NUMBERED = re.compile(r"(.*?)([0-9]{1,18})", re.DOTALL)


def camera_names(paths: Iterable[PurePosixPath], *, subject: str) -> dict[PurePosixPath, str]:
    """Return a unique camera name for each image path: its parts joined by `_`.

    A first folder such as `images` and the suffix are left out as long as the names stay different.

    Raises:
        InputError: names that remain equal, or that no file can have.
    """
    distinct = list(dict.fromkeys(paths))
    # Short names first: the first folder, then the suffix are added only where names would collide.
    for folder, suffix in ((False, False), (True, False), (True, True)):
        names = {path: _spelled(path, folder=folder, suffix=suffix) for path in distinct}
        if len(set(names.values())) == len(distinct):
            return {path: check_name(name, subject=f"{subject}: image {path}") for path, name in names.items()}
    # Name two paths that collide: sorted by name they are neighbours.
    alike = sorted(names, key=lambda path: names[path])
    pair = next((a, b) for a, b in pairwise(alike) if names[a] == names[b])
    raise InputError(
        f"{subject}: images {pair[0]} and {pair[1]}",
        expected="paths that give cameras different names",
        received=f"{names[pair[0]]} for both",
        remedy="rename one of the folders",
    )


def without_suffix(path: PurePosixPath) -> PurePosixPath:
    """Return the path without its suffix if that is one of an image file."""
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def number_at_end(path: PurePosixPath) -> tuple[str, int] | None:
    """Return the text before the number at the end of an image name, and the number; None without a number."""
    match = _NUMBERED.fullmatch(without_suffix(path).name)
    return None if match is None else (match[1], int(match[2]))


def _spelled(path: PurePosixPath, *, folder: bool, suffix: bool) -> str:
    parts = (path if suffix else without_suffix(path)).parts
    if not folder and len(parts) > 1 and _IMAGE_FOLDER.fullmatch(parts[0].lower()):
        parts = parts[1:]
    return "_".join(parts) or "camera"
