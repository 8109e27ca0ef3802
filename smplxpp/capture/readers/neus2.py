"""NeuS2 (Wang et al. 2023) and Instant-NGP: `transform*.json`, one for each moment, and RGBA images."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries
from smplxpp.capture.readers.common import chosen_params, inverted, pinhole, required
from smplxpp.capture.readers.options import ReaderOptions
from smplxpp.capture.recording import Problem, Recording
from smplxpp.capture.splits import Splits
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.json_file import read_json

NAME = "neus2"
LOOKS_FOR = "transform*.json, there or in train/ and test/"
_SETS = ("", "train", "test")
# Camera axes of OpenGL (y up, z backwards) in OpenCV's.
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def detect(root: Path) -> bool:
    """Tell whether a folder holds such files."""
    return bool(_moments(root))


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find a scene. Every image is a view; the number that ends a JSON file's name is its frame, else 0.

    `from_na` (its presence, as in NeuS2) means camera axes of OpenCV, otherwise they are OpenGL's; both are
    camera-to-world in the units of the data: `scale` and `offset` concern the trainer's unit cube alone. Test files
    hold the held-out cameras and frames.

    Raises:
        InputError: broken files, a camera that moves between frames.
    """
    cameras: dict[str, Camera] = {}
    distortions: dict[str, Distortion] = {}
    names: dict[str, dict[int, str]] = {}
    tested: dict[bool, set[tuple[str, int]]] = {True: set(), False: set()}
    problems: list[Problem] = []
    for path in _moments(root):
        content = read_json(path)
        frame = _frame_of(path)
        for entry in required(content, "frames", source=f"file {path}"):
            file = path.parent / required(entry, "file_path", source=f"file {path}")
            if not file.suffix:
                file = file.with_suffix(".png")
            name = _camera_name(file.stem, frame)
            camera, distortion = _camera(name, content, entry, path)
            _keep(cameras, name, camera, path)
            if distortion is not None:
                distortions[name] = distortion
            if not file.is_file():
                problems.append(Problem(f"{file}: named in {path.name}, but missing", name, frame))
                continue
            names.setdefault(name, {})[frame] = os.path.relpath(file, root)
            tested["test" in (path.parent.name, path.stem.rpartition("_")[2])].add((name, frame))
    images = {name: FileSeries.from_names(root, files) for name, files in names.items()}
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=distortions,
        files={"image": images, "mask": images} if _has_alpha(images) else {"image": images},
        splits=_splits(cameras, tested),
        params=chosen_params(options),
        problems=tuple(problems),
    )


def _moments(root: Path) -> list[Path]:
    return [path for folder in _SETS for path in sorted((root / folder).glob("transform*.json"))]


def _frame_of(path: Path) -> int:
    match = re.search(r"_(\d+)$", path.stem)
    return int(match[1]) if match else 0


def _camera_name(stem: str, frame: int) -> str:
    """The image's name without the frame's number at its end (`image_c_003_f_000280` -> `image_c_003`)."""
    match = re.fullmatch(r"(?P<name>.*?)[_-]?(?:f|frame)?[_-]?(?P<number>\d+)", stem)
    return match["name"] if match and match["name"] and int(match["number"]) == frame else stem


def _camera(name: str, content: Mapping[str, Any], entry: Any, path: Path) -> tuple[Camera, Distortion | None]:
    source = f"file {path}: {entry.get('file_path')}"
    values = {**content, **entry}
    width, height = (int(required(values, key, source=source)) for key in ("w", "h"))
    world_from_cam = np.asarray(required(entry, "transform_matrix", source=source), dtype=np.float64)
    if world_from_cam.shape not in ((3, 4), (4, 4)):
        raise InputError(source, expected="a 4 x 4 transform_matrix", received=f"shape {world_from_cam.shape}")
    if "from_na" not in content:
        world_from_cam = world_from_cam @ _OPENCV_FROM_OPENGL
    if "intrinsic_matrix" in values:
        K = np.asarray(values["intrinsic_matrix"], dtype=np.float64)[:3, :3]
    else:
        angle = values.get("camera_angle_x")
        fx = values.get("fl_x") or (None if angle is None else 0.5 * width / math.tan(0.5 * angle))
        if fx is None:
            raise InputError(source, expected="intrinsic_matrix, fl_x or camera_angle_x", received="none of them")
        K = np.diag([fx, values.get("fl_y", fx), 1.0])
        K[:2, 2] = values.get("cx", width / 2), values.get("cy", height / 2)
    coefficients = [values.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    return (
        pinhole(name, K, *inverted(world_from_cam), (width, height)),
        Distortion.from_opencv(coefficients, subject=source),
    )


def _keep(cameras: dict[str, Camera], name: str, camera: Camera, path: Path) -> None:
    known = cameras.setdefault(name, camera)
    same = np.allclose(known.cam_from_world, camera.cam_from_world, atol=1e-6) and np.allclose(known.K, camera.K)
    if not same:
        raise InputError(
            f"file {path}: camera {name}",
            expected="the pose and intrinsics it has in the other frames",
            received="others",
            remedy="a capture's cameras stand still: give moving cameras names of their own",
        )


def _has_alpha(images: Mapping[str, FileSeries]) -> bool:
    import PIL.Image

    series = next(iter(images.values()), None)
    path = None if series is None else series.path(int(series.numbers[0]))
    if path is None or not path.is_file():
        return False
    with PIL.Image.open(path) as image:
        return image.mode in ("RGBA", "LA", "PA")


def _splits(cameras: Mapping[str, Camera], tested: Mapping[bool, set[tuple[str, int]]]) -> Splits | None:
    """What only the test files name is held out; without any training file there is nothing to hold out from."""
    if not tested[False]:
        return None
    train_cameras, test_cameras = ({name for name, _ in tested[test]} for test in (False, True))
    train_frames, test_frames = ({frame for _, frame in tested[test]} for test in (False, True))
    return Splits(
        tuple(name for name in cameras if name in train_cameras),
        tuple(name for name in cameras if name in test_cameras - train_cameras),
        tuple(sorted(train_frames)),
        tuple(sorted(test_frames - train_frames)),
    )
