"""Camera files: a JSON list in OpenCV form, and ActorsHQ's calibration.csv."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.rotations import matrix_from_rotvec

_CSV_FIELDS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def read_cameras(path: str | Path) -> list[Camera]:
    """Cameras of `cameras.json` (`K`, `R`, `T` with x_cam = R x_world + T) or ActorsHQ's `calibration.csv`.

    ActorsHQ stores camera-to-world rotation vectors and positions, and intrinsics in units of the image's size.

    Raises:
        InputError: missing file, unknown layout, fields missing.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("camera file", expected="an existing file", received=str(path))
    try:
        if path.suffix.lower() == ".csv":
            return _read_actorshq(path)
        if path.suffix.lower() == ".json":
            return _read_opencv(path)
    except (KeyError, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"camera file {path}",
            expected=f"ActorsHQ columns {', '.join(_CSV_FIELDS)}, or JSON cameras with name, w, h, K, R, T",
            received=f"{type(error).__name__}: {error}",
        ) from None
    raise InputError(f"camera file {path}", expected="a .json or .csv file", received=path.suffix or "no suffix")


def _read_opencv(path: Path) -> list[Camera]:
    content = json.loads(path.read_text())
    entries = content["cameras"] if isinstance(content, dict) else content
    cameras = []
    for entry in entries:
        pose = np.eye(4)
        pose[:3, :3] = np.asarray(entry["R"], float).reshape(3, 3)
        pose[:3, 3] = np.asarray(entry["T"], float).reshape(3)
        K = np.asarray(entry["K"], float).reshape(3, 3)
        cameras.append(Camera(K, pose, int(entry["w"]), int(entry["h"]), name=str(entry["name"])))
    return cameras


def _read_actorshq(path: Path) -> list[Camera]:
    cameras = []
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            width, height = int(row["w"]), int(row["h"])
            value = {key: float(row[key]) for key in _CSV_FIELDS[3:]}
            cam_from_world = np.eye(4)
            rotation = matrix_from_rotvec(np.array([value["rx"], value["ry"], value["rz"]])).T
            cam_from_world[:3, :3] = rotation
            cam_from_world[:3, 3] = -rotation @ np.array([value["tx"], value["ty"], value["tz"]])
            K = np.array(
                [
                    [value["fx"] * width, 0, value["px"] * width],
                    [0, value["fy"] * height, value["py"] * height],
                    [0, 0, 1.0],
                ]
            )
            cameras.append(Camera(K, cam_from_world, width, height, name=row["name"]))
    return cameras
