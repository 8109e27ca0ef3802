"""Find the images that transforms.json names, their masks, and the camera and frame of each."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import IMAGE_SUFFIXES
from smplxpp.capture.readers.common import camera_names, number_at_end, without_suffix
from smplxpp.core.camera import Camera
from smplxpp.core.files.paths import path_inside


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
