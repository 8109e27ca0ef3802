"""Read TalkBody4D (Chen et al. 2025): a calibration in JSON, `CAM/FRAME.jpg`, a JSON of parameters a frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.body import BodyModel, UpAxis, load_body
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries, subfolders
from smplxpp.capture.readers.common import (
    ReaderOptions,
    chosen_params,
    first_folder,
    numbered_images,
    pinhole,
    required,
)
from smplxpp.capture.recording import ParamSource, Problem, Recording
from smplxpp.capture.sources import ParamFiles
from smplxpp.core import Camera, InputError, require_choice
from smplxpp.core.files.json_file import as_numbers, read_json

NAME = "talkbody4d"
LOOKS_FOR = "a JSON file with `cameras` and `camera_poses`, beside a folder with a folder of images for each camera"
_CALIBRATION_KEYS = ("cameras", "camera_poses")
_PARAM_KEYS = {"body_pose", "betas", "Rh", "Th"}
# Names of folders of mattes, the preferred first; they are never searched for images.
_MATTES = ("mattings", "matting", "mattes", "masks", "mask", "alphas", "alpha", "mask_images")
# Rotation by 180 degrees about x, from the set's y down to y up.
_Y_UP_FROM_Y_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def detect(root: Path) -> bool:
    """Tell whether a folder holds a calibration of this set."""
    return _calibration(root) is not None


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a recording: distorted images of the person on black, mattes, parameters; 20 frames a second.

    The calibration follows OpenCV, with pixel centres at whole numbers; a pose is stored under the camera's name or as
    `CAM_to_REFERENCE`. The world of the set has y down, so that cameras and parameters are rotated about x. A
    `capture.json` with `"format": "talkbody4d"` states differences: `"background": null` for photographs, `"up": "y"`.

    Raises:
        InputError: a broken calibration, no images.
    """
    path = _calibration(root)
    if path is None:
        raise InputError(f"capture {root}", expected=LOOKS_FOR, received="none")
    declared = _declared(root)
    up: UpAxis = declared.get("up", "-y")
    require_choice("up in capture.json of a TalkBody4D folder", up, ("y", "-y"))
    cameras, distortions = _read_calibration(path)
    # x_cam = R x + t in the set's world; with x = F x' the pose becomes [R|t] F, where F is its own inverse.
    if up == "-y":
        cameras = {name: replace(c, cam_from_world=c.cam_from_world @ _Y_UP_FROM_Y_DOWN) for name, c in cameras.items()}
    params, problems = _params(root, options, up)
    masks = first_folder(root, _MATTES)
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=distortions,
        files={
            "image": numbered_images(_images(root, cameras)),
            "mask": {} if masks is None else numbered_images({name: masks / name for name in cameras}),
        },
        background=_background(declared),
        params=params,
        fps=20.0,
        problems=tuple(problems),
    )


def _declared(root: Path) -> Mapping[str, Any]:
    path = root / "capture.json"
    content = read_json(path) if path.is_file() else {}
    if not isinstance(content, Mapping):
        raise InputError(f"file {path}", expected="an object", received=type(content).__name__)
    return content


def _background(declared: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Return the background of the images: black by default, so that edges are not multiplied by the matte twice."""
    value = declared.get("background", [0.0, 0.0, 0.0])
    if value not in (None, [0.0, 0.0, 0.0]):
        raise InputError(
            "background in capture.json of a TalkBody4D folder",
            expected="[0, 0, 0] as the set has it, or null for photographs",
            received=str(value)[:80],
        )
    return None if value is None else (0.0, 0.0, 0.0)


def _calibration(root: Path) -> Path | None:
    """Return the JSON file with `cameras` and `camera_poses`; None without one."""
    for path in sorted(root.glob("*.json")):
        try:
            content = read_json(path)
        except InputError:  # a file of another layout, whose reader reports it
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
        # The pose is stored under the camera's own name, or relative to the reference camera.
        pose = poses.get(name) or next((poses[key] for key in poses if key.startswith(f"{name}_to_")), None)
        if pose is None:
            raise InputError(
                source, expected=f"a pose {name!r} or '{name}_to_...'", received=", ".join(list(poses)[:8])
            )
        K, size = (required(entry, key, source=source) for key in ("K", "image_size"))
        R, T = (required(pose, key, source=source) for key in ("R", "T"))
        width, height = as_numbers(size, (2,), subject=f"{source}: image_size").tolist()
        cameras[name] = pinhole(name, K, R, T, (width, height), opencv_pixels=True)
        distortion = Distortion.from_opencv(entry.get("dist", []), subject=source)
        if distortion is not None:
            distortions[name] = distortion
    return cameras, distortions


def _images(root: Path, cameras: Mapping[str, Any]) -> dict[str, Path]:
    """Return the image folder of each camera: in `images/`, in the folder itself, or in any folder but those of mattes.

    Raises:
        InputError: no images in any of them.
    """
    # Releases differ in where images are, so that the usual places are tried in turn.
    others = [name for name in subfolders(root) if name not in _MATTES]
    for folder in (root / "images", root, *(root / name for name in others)):
        if numbered_images({name: folder / name for name in cameras if (folder / name).is_dir()}):
            return {name: folder / name for name in cameras}
    raise InputError(
        f"capture {root}",
        expected=f"a folder with folders of images named {', '.join(list(cameras)[:3])}, ..., such as images/",
        received=", ".join(name + (" (mattes)" if name in _MATTES else "") for name in subfolders(root)) or "no folder",
    )


def _params(root: Path, options: ReaderOptions, up: UpAxis) -> tuple[ParamSource | None, list[Problem]]:
    if options.params is not None:
        return chosen_params(options), []
    for name in subfolders(root):
        series = FileSeries.find(root / name, r"\D*(?P<frame>\d+)\.json")
        # Three files at most are opened, so that a long recording is recognised at once.
        content = _first_readable(series)
        if content.keys() >= _PARAM_KEYS:
            # Rh and Th rotate the posed body about the origin; their conversion needs the root joint of the very same
            # body.
            reason = _unfitting(content, options.body or load_body())
            if reason is None:
                return ParamFiles(series, "talkbody4d", options.body, up), []
            given = "the body given" if options.body is not None else "the open body, taken because none is given,"
            message = f"parameters in {root / name} are left out: {given} has {reason}. Rh and Th move the posed body "
            message += (
                "about the origin, so its root joint is needed: name the model that they were fitted with (body=, "
            )
            message += (
                "--body), or convert them for another one (smplxpp params convert --betas) and give these (params=)"
            )
            return None, [Problem(message)]
    return None, []


def _first_readable(series: FileSeries) -> Mapping[str, Any]:
    """Return the content of the first readable one of three files; empty without one."""
    for frame in series.numbers[:3].tolist():
        try:
            content = read_json(series.required(frame))
        except InputError:  # reported when the frame is read
            continue
        if isinstance(content, Mapping):
            return content
    return {}


def _unfitting(content: Mapping[str, Any], body: BodyModel) -> str | None:
    """Return in words what a body model lacks for parameters; None if it fits."""
    widths = [("betas", "betas", body.num_betas), ("expression", "expressions", body.num_expressions)]
    for key, word, known in widths:
        count = np.size(np.asarray(content.get(key, []), dtype=object))
        if count > known:
            return f"{known} {word}, not {count}"
    offsets = content.get("v_shape")
    count = body.vertex_count if offsets is None else np.size(np.asarray(offsets, dtype=object)) // 3
    return None if count == body.vertex_count else f"{body.vertex_count} vertices, where v_shape has {count}"
