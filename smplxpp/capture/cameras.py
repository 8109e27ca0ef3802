"""Read camera files, OpenCV's JSON list and ActorsHQ's calibration.csv; place rigs of cameras around a person."""

from __future__ import annotations

import csv
import io
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from smplxpp.capture.distortion import OPENCV, Distortion
from smplxpp.capture.readers.common import inverted, pinhole, required
from smplxpp.core import Camera, InputError, matrix_from_rotvec
from smplxpp.core.files import as_integer, as_list, as_numbers, as_text, read_json, read_text, regular_file
from smplxpp.core.files.paths import ascii_numbers
from smplxpp.core.spread import spread_inside

_CSV_FIELDS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
BODY, FACE = "body", "face"


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig; its kind is body or face, and `novel` cameras are held out."""

    camera: Camera
    kind: str
    novel: bool


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


def camera_rig(
    points: Float[np.ndarray, "P 3"],
    heads: Float[np.ndarray, "Q 3"],
    *,
    count: int,
    size: int,
    seed: int,
    aspect: float = 0.8,
) -> list[RigCamera]:
    """Place `count` cameras that see the person in every frame.

    Args:
        points: points of the person over all frames, which body cameras must hold.
        heads: points of the head over all frames, which face cameras must hold.
        count: number of cameras; from four on two of them look at the face.
        size: height of body images in pixels; face images are square, 3/4 as high.
        seed: seed of small irregularities of places and principal points.
        aspect: width of body images by their height.
    """
    rng = np.random.default_rng([seed, 3])
    faces = 2 if count >= 4 else 0
    bodies = count - faces
    # A sixth of the ring is held out, evenly spread, but never the first camera, which looks at the front.
    held_out = set(spread_inside(range(bodies), max(1, round(bodies / 6)))) if bodies >= 4 else set()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    width = max(8, round(size * aspect / 8) * 8)
    # Body cameras: 3.4 m away, at three heights (metres) in turn.
    rig, heights = [], (1.05, 1.75, 0.55)
    for k in range(bodies):
        azimuth = np.radians(360.0 * k / bodies + rng.uniform(-4, 4))
        height = heights[k % len(heights)] + rng.uniform(-0.08, 0.08)
        eye = middle + 3.4 * np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
        eye[1] = height
        camera = _fitted(eye, middle, points, (width, size), rng, f"Cam{k + 1:03d}")
        rig.append(RigCamera(camera, BODY, k in held_out))
    head = 0.5 * (heads.min(axis=0) + heads.max(axis=0))
    square = max(8, round(size * 0.75 / 8) * 8)
    # Face cameras: 1.15 m away, in front and on the subject's left (degrees), where she turns to.
    for k in range(faces):
        azimuth = np.radians((-6.0, 44.0)[k] + rng.uniform(-3, 3))
        eye = head + 1.15 * np.array([np.sin(azimuth), rng.uniform(-0.06, 0.1), np.cos(azimuth)])
        rig.append(RigCamera(_fitted(eye, head, heads, (square, square), rng, f"Face{k + 1}"), FACE, False))
    return rig


def _fitted(
    eye: Float[np.ndarray, " 3"],
    target: Float[np.ndarray, " 3"],
    points: Float[np.ndarray, "P 3"],
    size: tuple[int, int],
    rng: np.random.Generator,
    name: str,
) -> Camera:
    """Return a camera whose image holds `points` with a margin of 6 %, its principal point a pixel off the middle."""
    width, height = size
    camera = Camera.look_at(eye=eye, target=target, fov_y_deg=40.0, width=width, height=height)
    cam = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    # Focal length and principal point follow from the range of x / z and y / z.
    slope = cam[:, :2] / cam[:, 2:]
    low, high = slope.min(axis=0), slope.max(axis=0)
    focal = float(np.min(np.array([width, height]) / (1.06 * (high - low))))
    center = np.array([width, height]) / 2 - focal * 0.5 * (low + high) + rng.uniform(-1, 1, 2)
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1.0]])
    return replace(camera, K=K, name=name)
