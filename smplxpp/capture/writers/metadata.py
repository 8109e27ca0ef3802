"""Write the camera files and the description of a capture in the simple layout, and those of ActorsHQ."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from smplxpp.capture.distortion import (
    FISHEYE,
    FOV,
    Distortion,
    FisheyeDistortion,
    FovDistortion,
    RationalDistortion,
)
from smplxpp.capture.recording import Recording, Splits
from smplxpp.core import Camera, rotvec_from_matrix
from smplxpp.core.files.atomic import atomic_write_text

_CONVENTION = (
    "OpenCV: x_cam = R @ x_world + T, x right, y down, z forward; u = fx*x/z + cx in [0,w], pixel (i,j) has its centre "
    "at (j+0.5, i+0.5); no distortion; world y up, metres"
)
_CSV_FIELDS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def write_cameras_json(path: Path, rig: list[RigCamera]) -> None:
    """Write cameras.json in OpenCV's convention, with the kind and split of each camera."""
    entries = [
        {**camera_entry(item.camera, item.camera.name), "kind": item.kind, "split": "novel" if item.novel else "train"}
        for item in rig
    ]
    atomic_write_text(path, json.dumps({"convention": _CONVENTION, "cameras": entries}, indent=1) + "\n")


def write_plain_cameras_json(path: Path, cameras: Mapping[str, Camera]) -> None:
    """Write cameras.json in OpenCV's convention, without kind and split."""
    entries = [camera_entry(camera, name) for name, camera in cameras.items()]
    atomic_write_text(path, json.dumps({"cameras": entries}, indent=1) + "\n")


def camera_entry(camera: Camera, name: str) -> dict[str, object]:
    """Return the entry of a camera in cameras.json."""
    return {
        "name": name,
        "w": camera.width,
        "h": camera.height,
        "K": camera.K.tolist(),
        "R": camera.cam_from_world[:3, :3].tolist(),
        "T": camera.cam_from_world[:3, 3].tolist(),
    }


def lens_entry(distortion: Distortion | None) -> dict[str, object]:
    """Return what cameras.json says of a lens; nothing for a pinhole."""
    if isinstance(distortion, RationalDistortion):
        (k1, k2, k3, *rest), (p1, p2) = distortion.radial, distortion.tangential
        return {"dist": [k1, k2, p1, p2, k3, *rest]}
    if isinstance(distortion, FisheyeDistortion):
        return {"dist": list(distortion.k), "dist_model": FISHEYE}
    return {"dist": [distortion.omega], "dist_model": FOV} if isinstance(distortion, FovDistortion) else {}


def write_calibration_csv(path: Path, rig: list[RigCamera]) -> None:
    """Write ActorsHQ's calibration.csv: camera-to-world, intrinsics in units of the image size."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_CSV_FIELDS)
    for item in rig:
        camera = item.camera
        world_from_cam = camera.cam_from_world[:3, :3].T
        size = np.array([camera.width, camera.height])
        focal, center = np.diag(camera.K)[:2] / size, camera.K[:2, 2] / size
        numbers = [*rotvec_from_matrix(world_from_cam), *camera.position, *focal, *center]
        writer.writerow([camera.name, *size.tolist(), *(f"{value:.12g}" for value in numbers)])
    atomic_write_text(path, text.getvalue())


def write_actorshq_scene(folder: Path, boxes: Float[np.ndarray, "T 2 3"], fps: float) -> None:
    """Write `aabbs.csv` and `scene.json` beside the scale folders; `boxes` are the corners of each frame's bounds."""
    corners = [f"aabb_{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    rows = [",".join(["frame_number", *corners])]
    rows += [",".join([str(frame), *(f"{value:.6g}" for value in box.ravel())]) for frame, box in enumerate(boxes)]
    atomic_write_text(folder / "aabbs.csv", "\n".join(rows) + "\n")
    atomic_write_text(folder / "scene.json", json.dumps({"num_frames": len(boxes), "fps": fps}, indent=1) + "\n")


BODY, FACE = "body", "face"


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig; its kind is body or face, and `novel` cameras are held out."""

    camera: Camera
    kind: str
    novel: bool


def write_description(path: Path, recording: Recording, splits: Splits, frames: Sequence[int]) -> None:
    """Write capture.json, the description of a capture in the simple layout.

    Args:
        path: path of the file.
        recording: source of name, frame rate, background and label set.
        splits: training and held-out cameras and frames.
        frames: all frames of the written capture, ascending.
    """
    description: dict[str, object] = {"name": recording.name}
    if recording.fps is not None:
        description["fps"] = recording.fps
    description |= {
        "background": None if recording.background is None else list(recording.background),
        "label_set": recording.label_set,
        "train_views": list(splits.train_cameras),
        "novel_views": list(splits.novel_view_cameras),
        "train_frames": _ranges(splits.train_frames, frames),
        "novel_pose_frames": _ranges(splits.novel_pose_frames, frames),
    }
    atomic_write_text(path, json.dumps(description, indent=1) + "\n")


def _ranges(chosen: Sequence[int], frames: Sequence[int]) -> list[list[int]]:
    """Return [first, last] of every run of consecutive `frames` that are chosen."""
    marks = np.concatenate([[0], np.isin(frames, chosen).astype(np.int8), [0]])
    starts, ends = np.flatnonzero(np.diff(marks) == 1), np.flatnonzero(np.diff(marks) == -1) - 1
    return [[int(frames[int(first)]), int(frames[int(last)])] for first, last in zip(starts, ends, strict=True)]
