"""Read calibrations of data sets in JSON (CMU Panoptic, Shelf, MVHumanNet, AIST++, HuMMan) and of tools in TOML.

Pose2Sim, anipose, FreeMoCap and caliscope hold for each camera `size`, `matrix`, `distortions`, `rotation` (rotation
vector or matrix, world to camera) and `translation` in OpenCV's convention. anipose and FreeMoCap take the unit of the
calibration board (FreeMoCap: always millimetres) and the first camera's axes unless the ground was set; Pose2Sim and
caliscope write metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.capture.calibrations.file_camera import FileCamera, RigFile, entry, file_camera, numbers_of
from smplxpp.capture.distortion import FISHEYE, OPENCV
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_number, read_json
from smplxpp.core.files.safe_pickle import safe_load

_KEYS = ("matrix", "rotation", "translation")
# Kinds of cameras of the Panoptic studio, the preferred one first.
_PANOPTIC_KINDS = ("hd", "vga", "kinect-color")


def is_panoptic(content: Any) -> bool:
    """Tell a list `cameras` whose entries have `distCoef` and `resolution`."""
    listed = content.get("cameras") if isinstance(content, Mapping) else None
    first = listed[0] if isinstance(listed, list) and listed else None
    return isinstance(first, Mapping) and {"K", "R", "t", "distCoef", "resolution"} <= set(first)


def is_shelf(content: Any) -> bool:
    """Tell cameras by number with `fx`, `k`, `p` and a position `T`."""
    return _all_entries(content, {"R", "T", "fx", "fy", "cx", "cy"})


def is_mvhumannet(content: Any) -> bool:
    """Tell cameras by image name with `camera_pos`, `rotation` and `translation`."""
    return _all_entries(content, {"rotation", "translation", "camera_pos"})


def is_aist(content: Any) -> bool:
    """Tell a list of anipose's tables, as AIST++ keeps each of its settings."""
    return _all_entries(_by_name(content), {*_KEYS, "name"})


def is_humman(content: Any) -> bool:
    """Tell cameras by name with OpenCV's `K`, `R` and `T`."""
    return _all_entries(content, {"K", "R", "T"})


def _all_entries(content: Any, keys: set[str]) -> bool:
    return (
        isinstance(content, Mapping)
        and bool(content)
        and all(isinstance(one, Mapping) and keys <= set(one) for one in content.values())
    )


def read_panoptic(path: Path, content: Any) -> RigFile:
    """CMU Panoptic: centimetres, y down. Of its kinds of cameras the HD cameras are read, else VGA, else Kinects.

    `x_cam = R X + t` and OpenCV's five coefficients, as the toolbox's `projectPoints` has them.
    """
    source, cameras = f"calibration {path}", entry(content, "cameras", source=f"calibration {path}")
    kinds = {str(one.get("type", "")) if isinstance(one, Mapping) else "" for one in cameras}
    kind = next((name for name in _PANOPTIC_KINDS if name in kinds), None)
    chosen = [one for one in cameras if kind is None or (isinstance(one, Mapping) and one.get("type") == kind)]
    read = []
    for one in chosen:
        name = str(entry(one, "name", source=source))
        K, R, t, size = (entry(one, key, source=f"{source}: camera {name}") for key in ("K", "R", "t", "resolution"))
        read.append(file_camera(name, K, R, t, source=source, size=size, dist=one.get("distCoef", [])))
    left = len(cameras) - len(chosen)
    notes = (f"{left} cameras of other kinds than {kind} left out",) if left else ()
    return RigFile(tuple(read), 0.01, "-y", notes)


def read_shelf(path: Path, content: Any) -> RigFile:
    """Shelf and Campus as VoxelPose and mmpose keep them: millimetres, z up; T is the position, `x_cam = R (X - T)`."""
    source, cameras = f"calibration {path}", []
    for key, one in content.items():
        name = f"Camera{key}" if str(key).isdigit() else str(key)
        fx, fy, cx, cy = (as_number(one[k], subject=f"{source}: camera {key}: {k}") for k in ("fx", "fy", "cx", "cy"))
        R, position = (numbers_of(one[k], subject=f"{source}: camera {key}: {k}") for k in ("R", "T"))
        k, p = (numbers_of(one.get(n, []), subject=f"{source}: camera {key}: {n}").ravel() for n in ("k", "p"))
        if R.shape != (3, 3) or position.size != 3 or k.size not in (0, 3) or p.size not in (0, 2):
            raise InputError(
                f"{source}: camera {key}",
                expected="R of 3 x 3 numbers, T of 3, k of 3, p of 2",
                received=f"{R.shape}, {position.size}, {k.size}, {p.size}",
            )
        k, p = (np.pad(values, (0, count - values.size)) for values, count in ((k, 3), (p, 2)))
        K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        dist = (*k[:2], *p, k[2])
        cameras.append(file_camera(name, K, R, -R @ position.ravel(), source=source, dist=dist))
    return RigFile(tuple(cameras), 1e-3, "z")


def read_mvhumannet(path: Path, content: Any) -> RigFile:
    """MVHumanNet's `camera_extrinsics.json`: thousandths of a unit that `camera_scale.pkl` beside it gives in metres.

    All cameras share `camera_intrinsics.json`. A name `1_CC32871A004.png` belongs to the images of `CC32871A004`.
    """
    source = f"calibration {path}"
    beside = path.with_name("camera_intrinsics.json")
    shared = read_json(
        beside, subject="calibration", remedy="keep camera_intrinsics.json beside camera_extrinsics.json"
    )
    K, dist = (entry(shared, "intrinsics", source=f"calibration {beside}"), shared.get("dist", []))
    scale_file = path.with_name("camera_scale.pkl")
    scale = as_number(safe_load(scale_file), subject=f"file {scale_file}", least=1e-6) if scale_file.is_file() else None
    cameras: list[FileCamera] = []
    for key, one in content.items():
        stem = key.rsplit(".", 1)[0]
        name = stem.split("_", 1)[1] if stem.split("_", 1)[0].isdigit() and "_" in stem else stem
        cameras.append(file_camera(name, K, one["rotation"], one["translation"], source=source, dist=dist))
    notes = () if scale is not None else ("no camera_scale.pkl: the unit is guessed",)
    return RigFile(tuple(cameras), None if scale is None else 1e-3 * scale, None, notes)


def read_aist(path: Path, content: Any) -> RigFile:
    """AIST++ (`setting1.json`): aniposelib's cameras in a list; the unit is guessed (AIST++: centimetres)."""
    return RigFile(_cameras(path, _by_name(content)))


def read_humman(path: Path, content: Any) -> RigFile:
    """HuMMan's `cameras.json`: pinholes with `x_cam = R X + T`; the world is the first Kinect's, metres.

    Files of the same form by other tools may have `dist` or `distCoeff`, `imgSize`, and other units.
    """
    source, cameras = f"calibration {path}", []
    for name, one in content.items():
        dist, size = one.get("dist", one.get("distCoeff", ())), one.get("imgSize")
        cameras.append(file_camera(str(name), one["K"], one["R"], one["T"], source=source, size=size, dist=dist))
    return RigFile(tuple(cameras))


def _by_name(content: Any) -> dict[str, Any]:
    """Return the entries of a list by their place; nothing of anything else."""
    return {f"cam_{k}": one for k, one in enumerate(content)} if isinstance(content, list) else {}


def is_caliscope(content: Any) -> bool:
    """Tell `[cameras.N]`, or `[cam_N]` with `cam_id` or `port`."""
    tables = _tables(content)
    return any("cam_id" in table or "port" in table for table in tables.values())


def is_freemocap(content: Any) -> bool:
    """Tell FreeMoCap's metadata or world poses, beside anipose's tables."""
    about = content.get("metadata") if isinstance(content, Mapping) else None
    mine = isinstance(about, Mapping) and any("freemocap" in key or "charuco" in key or key == "board" for key in about)
    return _has_cameras(content) and (mine or any("world_position" in t for t in _tables(content).values()))


def is_pose2sim(content: Any) -> bool:
    """Tell Pose2Sim's tables, each with `fisheye`, and image sizes written as decimal numbers."""
    tables = [t for t in _tables(content).values() if "matrix" in t]
    return bool(tables) and all("fisheye" in t and any(isinstance(s, float) for s in t.get("size", ())) for t in tables)


def is_anipose(content: Any) -> bool:
    """Tell any other table of cameras."""
    return _has_cameras(content)


def read_pose2sim(path: Path, content: Any) -> RigFile:
    """Metres; the axes are those of the object that the cameras were calibrated on, usually z up."""
    return RigFile(_cameras(path, content), metres=1.0)


def read_anipose(path: Path, content: Any) -> RigFile:
    """Unit and axes of the board that the user described."""
    return RigFile(_cameras(path, content))


def read_freemocap(path: Path, content: Any) -> RigFile:
    """Read FreeMoCap's cameras, whose unit is the millimetre."""
    return RigFile(_cameras(path, content), metres=1e-3)


def read_caliscope(path: Path, content: Any) -> RigFile:
    """Metres; cameras that were left aside, or have no pose yet, are noted."""
    tables = _tables(content)
    kept = {key: t for key, t in tables.items() if not t.get("ignore") and all(name in t for name in _KEYS)}
    notes = tuple(f"camera {key}: no pose in the calibration; left out" for key in tables if key not in kept)
    return RigFile(
        _cameras(path, {key: {**t, "name": _port_name(key, t)} for key, t in kept.items()}), 1.0, notes=notes
    )


def _port_name(key: str, table: Mapping[str, Any]) -> str:
    """Return `cam_N`, as caliscope names the videos (`port_N` before its version 0.6)."""
    return f"cam_{table['cam_id']}" if "cam_id" in table else f"port_{table.get('port', key)}"


def _tables(content: Any) -> dict[str, Mapping[str, Any]]:
    """Return the tables of cameras: at the top, or under `cameras`."""
    if not isinstance(content, Mapping):
        return {}
    inside = content.get("cameras")
    inside = inside if isinstance(inside, Mapping) else content
    return {
        str(key): value
        for key, value in inside.items()
        if key != "metadata" and isinstance(value, Mapping) and ("matrix" in value or "cam_id" in value)
    }


def _has_cameras(content: Any) -> bool:
    return any(all(key in table for key in _KEYS) for table in _tables(content).values())


def _cameras(path: Path, content: Any) -> tuple[FileCamera, ...]:
    source = f"calibration {path}"
    cameras = []
    for key, table in _tables(content).items():
        fisheye = table.get("fisheye", False)
        if not isinstance(fisheye, bool):
            raise InputError(f"{source}: {key}: fisheye", expected="true or false", received=f"{fisheye!r}"[:80])
        dist = table.get("distortions", [])
        cameras.append(
            file_camera(
                str(table.get("name", key)),
                *(entry(table, name, source=f"{source}: {key}") for name in _KEYS),
                source=source,
                size=table.get("size", table.get("image_size")),
                # A fisheye has four coefficients; tools pad them to five.
                dist=dist[:4] if fisheye and isinstance(dist, list) else dist,
                model=FISHEYE if fisheye else OPENCV,
            )
        )
    return tuple(cameras)
