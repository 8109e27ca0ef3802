"""Read transforms.json of Instant-NGP, nerfstudio, Blender's NeRF and NeuS2: its cameras, images, masks and frames."""

from __future__ import annotations

import math
import os
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.capture.distortion import FISHEYE, OPENCV, Distortion
from smplxpp.capture.files import IMAGE_SUFFIXES
from smplxpp.capture.readers.common import camera_names, inverted, number_at_end, pinhole, required, without_suffix
from smplxpp.core import Camera, InputError
from smplxpp.core.files.json_file import as_integer, as_number, as_numbers, as_text
from smplxpp.core.files.paths import path_inside

_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
# Keys of other projections in Instant-NGP, which are not supported.
_PROJECTIONS = ("latlong", "equirectangular", "orthographic", "ftheta_p0")
_REMEDY = "render or undistort the images to pinholes, or to OpenCV's fisheye, and give their intrinsics"
# Transform from OpenCV's camera axes to OpenGL's (y up, z backwards) and back.
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def frame_camera(
    content: Mapping[str, Any], frame: Mapping[str, Any], size: tuple[Any, Any], *, name: str, source: str
) -> tuple[Camera, Distortion | None]:
    """Return the camera of a frame and its distortion; values of the frame override those of the file.

    The keys are those of Instant-NGP (`src/nerf_loader.cu`: `read_lens`, `read_focal_length`) and of nerfstudio
    (`nerfstudio_dataparser.py`, `cameras/cameras.py`: `CAMERA_MODEL_TO_TYPE`).

    Args:
        content: JSON object of the file.
        frame: one of its `frames`.
        size: width and height of the image, unchecked.
        name: name of the camera.
        source: name of the frame in messages.

    Raises:
        InputError: an unsupported projection, a camera that moves during the exposure, missing or broken numbers.
    """
    width, height = (as_integer(side, subject=f"{source}: image size", least=1, most=1 << 16) for side in size)
    K = _intrinsics(content, frame, (width, height), source)
    camera = pinhole(name, K, *inverted(_pose(content, frame, source)), (width, height))
    return camera, _lens({**content, **frame}, source)


def _pose(content: Mapping[str, Any], frame: Mapping[str, Any], source: str) -> Float64[np.ndarray, "N 4"]:
    """Return the camera-to-world matrix in OpenCV's camera axes, which `from_na` marks as given (NeuS2)."""
    # NeuS2 and Instant-NGP may name poses at the start and the end of the exposure; they must be equal.
    key = "transform_matrix_start" if "transform_matrix_start" in frame else "transform_matrix"
    matrix = as_numbers(required(frame, key, source=source), (None, 4), subject=f"{source}: {key}")
    end = as_numbers(frame.get("transform_matrix_end", matrix), (None, 4), subject=f"{source}: transform_matrix_end")
    if matrix.shape != end.shape or not np.allclose(matrix, end, atol=1e-9):
        raise InputError(
            source,
            expected="a camera that stands still while it exposes",
            received="transform_matrix_start and transform_matrix_end that differ (rolling shutter)",
            remedy="undo the rolling shutter, or name one transform_matrix",
        )
    if matrix.shape[0] not in (3, 4):
        raise InputError(f"{source}: {key}", expected="shape (4, 4) or (3, 4)", received=f"{matrix.shape}")
    # Right multiplication changes the camera's axes (columns) and leaves its position.
    return matrix if "from_na" in content else matrix @ _OPENCV_FROM_OPENGL


def _intrinsics(
    content: Mapping[str, Any], frame: Mapping[str, Any], size: tuple[int, int], source: str
) -> Float64[np.ndarray, "3 3"]:
    values = {**content, **frame}
    if "intrinsic_matrix" in values:
        matrix = as_numbers(values["intrinsic_matrix"], (None, None), subject=f"{source}: intrinsic_matrix")
        if min(matrix.shape) < 3:
            raise InputError(f"{source}: intrinsic_matrix", expected="3 rows and columns", received=f"{matrix.shape}")
        return matrix[:3, :3]
    # Values of the frame come first, then those of the file.
    found = _focal_lengths(frame, size, source) or _focal_lengths(content, size, source)
    if found is None:
        raise InputError(
            source,
            expected="intrinsic_matrix, fl_x, x_fov or camera_angle_x (or these of y)",
            received="none of them",
        )
    # The principal point defaults to the image's middle, at half the size with pixel centres at +0.5.
    K = np.diag([*found, 1.0])
    for row, key in enumerate(("cx", "cy")):
        K[row, 2] = as_number(values.get(key, size[row] / 2), subject=f"{source}: {key}")
    return K


def _focal_lengths(values: Mapping[str, Any], size: tuple[int, int], source: str) -> tuple[float, float] | None:
    """Return the focal lengths in pixels of x and y, a single one for both; None without any."""
    x, y = (_focal_length(values, axis, side, source) for axis, side in zip("xy", size, strict=True))
    first = x or y
    return None if first is None else (first, y or first)


def _focal_length(values: Mapping[str, Any], axis: str, side: int, source: str) -> float | None:
    """Return a focal length in pixels by Instant-NGP's keys: `x_fov` (degrees), `fl_x`, `camera_angle_x` (radians)."""
    for key, half_circle in ((f"{axis}_fov", 180.0), (f"fl_{axis}", None), (f"camera_angle_{axis}", math.pi)):
        if key in values:
            number = as_number(values[key], subject=f"{source}: {key}", least=1e-6, most=half_circle or 1e9)
            return number if half_circle is None else 0.5 * side / math.tan(0.5 * math.pi * number / half_circle)
    return None


def _lens(values: Mapping[str, Any], source: str) -> Distortion | None:
    """Return the distortion by camera model and coefficients; None for a pinhole."""
    # A projection counts as absent if it is false or null.
    other = [key for key in _PROJECTIONS if key in values and values[key] is not False and values[key] is not None]
    if other:
        raise InputError(f"{source}: lens", expected="a pinhole or a fisheye", received=other[0], remedy=_REMEDY)
    name = as_text(values.get("camera_model") or "", subject=f"{source}: camera_model").upper()
    known = _PINHOLES + _FISHEYES
    fisheye = name in _FISHEYES or bool(values.get("is_fisheye"))
    if (name and name not in known) or (fisheye and name in _PINHOLES[:2]):
        received = f"{name} with is_fisheye" if name in known else name[:80]
        expected = f"one of {', '.join(known)}"
        raise InputError(f"{source}: camera_model", expected=expected, received=received, remedy=_REMEDY)
    # Tangential terms of a fisheye, and k4 to k6 of a pinhole, have no agreed meaning.
    k, p = _coefficients(values, source)
    if (p if fisheye else k[3:]).any():
        raise InputError(
            f"{source}: lens",
            expected="k1, k2, k3, k4 of a fisheye" if fisheye else "k1, k2, k3, p1, p2",
            received="p1 and p2 of a fisheye" if fisheye else "k4, k5 or k6, which tools use for different things",
            remedy=_REMEDY,
        )
    if fisheye:
        return Distortion.from_opencv(k[:4], subject=source, model=FISHEYE)
    # OpenCV's order: k1, k2, p1, p2, k3.
    return Distortion.from_opencv([*k[:2], *p, k[2]], subject=source, model=OPENCV)


def _coefficients(
    values: Mapping[str, Any], source: str
) -> tuple[Float64[np.ndarray, " 6"], Float64[np.ndarray, " 2"]]:
    """Return k1..k6 and p1, p2; nerfstudio's `distortion_params` (k1, k2, k3, k4, p1, p2) overrides single keys."""
    if "distortion_params" in values:
        listed = as_numbers(values["distortion_params"], (6,), subject=f"{source}: distortion_params")
        return np.append(listed[:4], [0.0, 0.0]), listed[4:]

    def numbers(keys: tuple[str, ...]) -> Float64[np.ndarray, " N"]:
        return np.array([as_number(values.get(key, 0.0), subject=f"{source}: {key}") for key in keys])

    return numbers(("k1", "k2", "k3", "k4", "k5", "k6")), numbers(("p1", "p2"))


@dataclass(frozen=True, eq=False)
class NamedImage:
    """An image that a transforms file names.

    Attributes:
        path: path below the capture's folder.
        exists: whether the file exists.
        mask: path of its mask, or None.
        camera: camera of the image, named like the image.
        lens: distortion, None for a pinhole.
        frame: number at the end of the name of the transforms file (NeuS2), or None.
        time: time of the frame (D-NeRF), or None.
        part: "train", "test", or "" if lists of the file name it in neither.
        source: transforms file that names it.
    """

    path: PurePosixPath
    exists: bool
    mask: PurePosixPath | None
    camera: Camera
    lens: Distortion | None
    frame: int | None
    time: float | None
    part: str
    source: Path


def find_image(root: Path, base: Path, name: str, *, subject: str) -> PurePosixPath:
    """Return the path below `root` of the image that a file in `base` names, with or without its suffix.

    Raises:
        InputError: a path outside of `root`.
    """
    path = path_inside(root, name, base=base, subject=subject)
    if path.suffix.lower() not in IMAGE_SUFFIXES and not os.path.isfile(path):
        tries = [path.with_name(path.name + suffix) for suffix in (".png", *IMAGE_SUFFIXES)]
        path = next((found for found in tries if os.path.isfile(found)), tries[0])
    return PurePosixPath(path.relative_to(os.path.normpath(root)))


def mask_beside(root: Path, image: PurePosixPath) -> PurePosixPath | None:
    """Return Instant-NGP's mask of an image, None without one: `IMAGE.SUFFIX.alpha.SUFFIX` or `IMAGE.alpha.SUFFIX`."""
    for stem in (image.name, image.stem):
        path = image.with_name(f"{stem}.alpha{image.suffix}")
        if os.path.isfile(root / path):
            return path
    return None


def places(images: Sequence[NamedImage], *, subject: str) -> list[tuple[str, int]]:
    """Assign a camera name and a frame to each image.

    1. The number of a transforms file (NeuS2) is the frame; the image path without this number is the camera.
    2. Otherwise a folder of numbered images with one pose and one lens is a camera, and the numbers are frames. So is
       each folder if every folder has one image whose name is a number.
    3. Any other image is a camera. Its number is the frame if case 2 applies to others, else the frame is 0.

    `time`, if given, overrides numbers: its rank is the frame.
    """
    keys, frames = _keys(images)
    names = camera_names(keys, subject=subject)
    return [(names[key], frame) for key, frame in zip(keys, frames, strict=True)]


def _keys(images: Sequence[NamedImage]) -> tuple[list[PurePosixPath], list[int]]:
    if any(image.frame is not None for image in images):
        return _without_frames(images), [image.frame or 0 for image in images]
    # Names that differ in their last number alone form a group: the frames of one camera, or the cameras of one moment.
    numbers = [number_at_end(image.path) for image in images]
    groups: dict[tuple[PurePosixPath, str], list[NamedImage]] = defaultdict(list)
    for image, number in zip(images, numbers, strict=True):
        if number is not None:
            groups[image.path.parent, number[0]].append(image)
    still = {group: _still(members) for group, members in groups.items()}
    single = len(groups) > 1 and all(len({m.path for m in members}) == 1 for members in groups.values())
    alone = single and None not in numbers and all(prefix == "" for _, prefix in groups)
    timed = alone or any(still[group] and len({m.path for m in members}) > 1 for group, members in groups.items())
    folders = Counter(folder for folder, _ in groups)
    # Times in the file, where it has several, decide the order of the moments; numbers in names decide otherwise.
    times = sorted({image.time for image in images if image.time is not None})
    moments = {time: rank for rank, time in enumerate(times)}
    keys, frames = [], []
    for image, number in zip(images, numbers, strict=True):
        group = (image.path.parent, number[0] if number else "")
        rig = timed and number is not None and still[group]
        folder_alone = folders[image.path.parent] == 1 and image.path.parent != PurePosixPath()
        prefix = group[1].rstrip("_-.")
        key = image.path.parent if folder_alone or not prefix else image.path.parent / prefix
        keys.append(key if rig else image.path)
        frame = number[1] if timed and number else 0
        frames.append(moments[image.time] if len(moments) > 1 and image.time is not None else frame)
    return keys, frames


def _still(images: Sequence[NamedImage]) -> bool:
    first = images[0]
    return all(same_camera(first.camera, image.camera) and first.lens == image.lens for image in images[1:])


def same_camera(a: Camera, b: Camera) -> bool:
    """Tell whether two cameras agree in pose, size and intrinsics up to rounding."""
    return (
        (a.width, a.height) == (b.width, b.height)
        and np.allclose(a.cam_from_world, b.cam_from_world, atol=1e-6)
        and np.allclose(a.K, b.K)
    )


def _without_frames(images: Sequence[NamedImage]) -> list[PurePosixPath]:
    """Return the paths without the frame number, with the fewest cameras that have at most one image a frame.

    `images/000280/image_c_003_f_000280.png` -> `images/image_c_003`, `000280/003.png` -> `003`, `003/000280.png` ->
    `003`. All variants are tried, because a folder or a name may be the number of a camera that equals the frame.
    """
    views = len({(image.frame, image.path) for image in images})
    best: list[PurePosixPath] = []
    for folders, name in ((True, True), (True, False), (False, True), (False, False)):
        keys = [_without_frame(image.path, image.frame or 0, folders=folders, name=name) for image in images]
        once = len({(image.frame, key) for image, key in zip(images, keys, strict=True)}) == views
        if once and (not best or len(set(keys)) < len(set(best))):
            best = keys
    return best


def _without_frame(path: PurePosixPath, frame: int, *, folders: bool, name: bool) -> PurePosixPath:
    own, number = without_suffix(path).name, number_at_end(path)
    if name and number is not None and number[1] == frame:
        own = _without_mark(number[0])
    parents = path.parent.parts
    if folders and own:
        parents = tuple(part for part in parents if not (part.isdecimal() and _is(part, frame)))
    return PurePosixPath(*parents, own) if own or parents else path


def _without_mark(name: str) -> str:
    """Return the name without `_f_` or `_frame_` at its end."""
    name = name.rstrip("_-")
    for mark in ("frame", "f"):
        if name == mark or name.endswith((f"_{mark}", f"-{mark}")):
            return name[: -len(mark)].rstrip("_-")
    return name


def _is(digits: str, number: int) -> bool:
    return len(digits) <= 18 and int(digits) == number
