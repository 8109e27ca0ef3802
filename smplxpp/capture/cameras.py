"""Read camera files: a JSON list in OpenCV's convention, and ActorsHQ's calibration.csv."""

from __future__ import annotations

import csv
import io
from collections import Counter
from pathlib import Path

import numpy as np

from smplxpp.capture.distortion import OPENCV, Distortion
from smplxpp.capture.readers.common import inverted, pinhole, required
from smplxpp.core import Camera, InputError, matrix_from_rotvec
from smplxpp.core.files import as_integer, as_list, as_numbers, as_text, read_json, read_text, regular_file
from smplxpp.core.files.paths import ascii_numbers

_CSV_FIELDS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def read_cameras(path: str | Path) -> list[Camera]:
    """Read the cameras of `cameras.json` (`K`, `R`, `T` with x_cam = R x_world + T) or ActorsHQ's `calibration.csv`.

    ActorsHQ stores camera-to-world rotation vectors and positions, and intrinsics in units of the image's size.

    Raises:
        InputError: missing file, unknown layout, fields missing, a camera with distortion.
    """
    lenses = read_lenses(path)
    # Callers of this function project with K alone, which would be off by many pixels near the borders of a distorted
    # image.
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
    """Read cameras like `read_cameras`, each with the distortion of its lens, None for a pinhole.

    `dist` holds the coefficients of a lens and `dist_model` its model, by default `opencv` (`Distortion.from_opencv`).

    Raises:
        InputError: missing file, unknown layout, fields missing or of another type, a duplicate name.
    """
    path = Path(path)
    readers = {".csv": _read_actorshq, ".json": _read_opencv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"camera file {path}", expected="a .json or .csv file", received=path.suffix or "no suffix")
    lenses = reader(regular_file(path, subject="camera file"))
    names = Counter(camera.name for camera, _ in lenses)
    # Names are keys of folders and splits, so that they must be unique.
    twice = [name for name, count in names.items() if count > 1]
    if twice:
        raise InputError(f"camera file {path}", expected="every name once", received=f"{twice[:5]} several times")
    return lenses


def _read_opencv(path: Path) -> list[tuple[Camera, Distortion | None]]:
    content = read_json(path, subject="camera file")
    # Both a bare list and an object with a list under "cameras" are read.
    if isinstance(content, dict):
        content = required(content, "cameras", source=f"camera file {path}")
    lenses = []
    for index, entry in enumerate(as_list(content, subject=f"camera file {path}: cameras")):
        source = f"camera file {path}: entry {index}"
        name, K, R, T, w, h = (required(entry, key, source=source) for key in ("name", "K", "R", "T", "w", "h"))
        camera = pinhole(str(name), K, R, T, (w, h))
        model = as_text(entry.get("dist_model", OPENCV), subject=f"{source}: dist_model")
        lens = Distortion.from_opencv(entry.get("dist", []), subject=f"camera {name!r}", model=model)
        lenses.append((camera, lens))
    return lenses


def _read_actorshq(path: Path) -> list[tuple[Camera, Distortion | None]]:
    lenses: list[tuple[Camera, Distortion | None]] = []
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, subject="camera file"))))
        names = [row[_CSV_FIELDS[0]] or "" for row in rows]
        numbers = [{key: float(ascii_numbers(row[key])) for key in _CSV_FIELDS[1:]} for row in rows]
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(
            f"camera file {path}",
            expected=f"ActorsHQ columns {', '.join(_CSV_FIELDS)}",
            received=f"{type(error).__name__}: {error}"[:200],
        ) from None
    for name, value in zip(names, numbers, strict=True):
        source = f"camera file {path}: camera {name}"
        # ActorsHQ's calibration.csv: rotation vectors are camera-to-world, focal lengths and principal point are
        # shares of width and height.
        as_numbers(list(value.values()), subject=source)
        width, height = (as_integer(value[key], subject=f"{source}: {key}") for key in ("w", "h"))
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3] = matrix_from_rotvec(np.array([value["rx"], value["ry"], value["rz"]]))
        world_from_cam[:3, 3] = value["tx"], value["ty"], value["tz"]
        # Back to pixels. ActorsHQ counts pixels from the image's corner, as this package does.
        K = np.diag([value["fx"] * width, value["fy"] * height, 1.0])
        K[:2, 2] = value["px"] * width, value["py"] * height
        lenses.append((pinhole(name, K, *inverted(world_from_cam), (width, height)), None))
    return lenses
