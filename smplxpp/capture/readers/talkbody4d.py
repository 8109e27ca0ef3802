"""TalkBody4D (Chen et al. 2025): a multi-camera calibration in JSON, `CAM/FRAME.jpg`, a JSON of parameters a frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries, subfolders
from smplxpp.capture.params import ParamFiles
from smplxpp.capture.readers.common import chosen_params, numbered_images, pinhole, required
from smplxpp.capture.readers.options import ReaderOptions
from smplxpp.capture.recording import Recording
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.json_file import read_json

NAME = "talkbody4d"
LOOKS_FOR = "a JSON file with `cameras` and `camera_poses`, beside a folder with a folder of images for each camera"
_FPS = 20.0
_CALIBRATION_KEYS = ("cameras", "camera_poses")
_PARAM_KEYS = {"body_pose", "betas", "Rh", "Th"}


def detect(root: Path) -> bool:
    """Tell whether a folder holds such a calibration."""
    return _calibration(root) is not None


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find a recording: distorted photographs (undistorted on reading); masks only if the user made a `masks/`.

    The calibration is of OpenCV, with pixel centres at whole numbers; a pose is stored under the camera's own name or
    as `CAM_to_REFERENCE`.

    Raises:
        InputError: a broken calibration, no images.
    """
    path = _calibration(root)
    if path is None:
        raise InputError(f"capture {root}", expected=LOOKS_FOR, received="none")
    cameras, distortions = _read_calibration(path)
    places = [root / "images", root, *(root / name for name in subfolders(root) if name != "masks")]
    images = next((folder for folder in places if _has(folder, cameras)), None)
    if images is None:
        raise InputError(
            f"capture {root}",
            expected=f"a folder with folders of images named {', '.join(list(cameras)[:3])}, ...",
            received=", ".join(subfolders(root)) or "no folder",
        )
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=distortions,
        files={
            "image": numbered_images({name: images / name for name in cameras}),
            "mask": numbered_images({name: root / "masks" / name for name in cameras}),
        },
        params=_params(root, options),
        fps=_FPS,
    )


def _calibration(root: Path) -> Path | None:
    for path in sorted(root.glob("*.json")):
        try:
            content = read_json(path)
        except InputError:  # a file of another layout, whose reader will say so
            continue
        if isinstance(content, Mapping) and all(isinstance(content.get(key), Mapping) for key in _CALIBRATION_KEYS):
            return path
    return None


def _read_calibration(path: Path) -> tuple[dict[str, Camera], dict[str, Distortion]]:
    content = read_json(path)
    poses = content["camera_poses"]
    cameras, distortions = {}, {}
    for name, entry in content["cameras"].items():
        source = f"file {path}: camera {name}"
        pose = poses.get(name) or next((poses[key] for key in poses if key.startswith(f"{name}_to_")), None)
        if pose is None:
            raise InputError(
                source, expected=f"a pose {name!r} or '{name}_to_...'", received=", ".join(list(poses)[:8])
            )
        K, size = (required(entry, key, source=source) for key in ("K", "image_size"))
        R, T = (required(pose, key, source=source) for key in ("R", "T"))
        cameras[name] = pinhole(name, K, R, T, tuple(size), opencv_pixels=True)
        distortion = Distortion.from_opencv(entry.get("dist", []), subject=source)
        if distortion is not None:
            distortions[name] = distortion
    return cameras, distortions


def _has(folder: Path, cameras: Mapping[str, Any]) -> bool:
    return any(numbered_images({name: folder / name for name in cameras if (folder / name).is_dir()}))


def _params(root: Path, options: ReaderOptions) -> Any:
    if options.params is not None:
        return chosen_params(options)
    for name in subfolders(root):
        series = FileSeries.find(root / name, r"\D*(?P<frame>\d+)\.json")
        if len(series):
            content = read_json(series.required(int(series.numbers[0])))
            if isinstance(content, Mapping) and content.keys() >= _PARAM_KEYS:
                return ParamFiles(series, "talkbody4d", options.body)
    return None
