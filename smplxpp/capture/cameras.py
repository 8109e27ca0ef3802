"""Camera files: a JSON list in OpenCV form, and ActorsHQ's calibration.csv."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.readers.common import inverted, pinhole
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.json_file import read_json
from smplxpp.core.rotations import matrix_from_rotvec

_CSV_FIELDS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def read_cameras(path: str | Path) -> list[Camera]:
    """Cameras of `cameras.json` (`K`, `R`, `T` with x_cam = R x_world + T) or ActorsHQ's `calibration.csv`.

    ActorsHQ stores camera-to-world rotation vectors and positions, and intrinsics in units of the image's size.

    Raises:
        InputError: missing file, unknown layout, fields missing, a camera with distortion.
    """
    lenses = read_lenses(path)
    distorted = [camera.name for camera, distortion in lenses if distortion is not None]
    if distorted:
        raise InputError(
            f"camera file {path}",
            expected="cameras without distortion",
            received=f"distortion of {distorted[:5]}",
            remedy="undistort the images; a capture that is opened whole is undistorted on reading",
        )
    return [camera for camera, _ in lenses]


def read_lenses(path: str | Path) -> list[tuple[Camera, Distortion | None]]:
    """Read what `read_cameras` reads, with each camera's distortion (`dist` in OpenCV's order); None: a pinhole."""
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


def _read_opencv(path: Path) -> list[tuple[Camera, Distortion | None]]:
    content = read_json(path)
    lenses = []
    for entry in content["cameras"] if isinstance(content, dict) else content:
        name = str(entry["name"])
        camera = pinhole(name, entry["K"], entry["R"], entry["T"], (int(entry["w"]), int(entry["h"])))
        lenses.append((camera, Distortion.from_opencv(entry.get("dist", []), subject=f"camera {name!r}")))
    return lenses


def _read_actorshq(path: Path) -> list[tuple[Camera, Distortion | None]]:
    lenses: list[tuple[Camera, Distortion | None]] = []
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            width, height = int(row["w"]), int(row["h"])
            value = {key: float(row[key]) for key in _CSV_FIELDS[3:]}
            world_from_cam = np.eye(4)
            world_from_cam[:3, :3] = matrix_from_rotvec(np.array([value["rx"], value["ry"], value["rz"]]))
            world_from_cam[:3, 3] = value["tx"], value["ty"], value["tz"]
            K = np.diag([value["fx"] * width, value["fy"] * height, 1.0])
            K[:2, 2] = value["px"] * width, value["py"] * height
            lenses.append((pinhole(row["name"], K, *inverted(world_from_cam), (width, height)), None))
    return lenses
