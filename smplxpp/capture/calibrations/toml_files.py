"""Calibrations in TOML: Pose2Sim, anipose, FreeMoCap, caliscope.

All hold for each camera `size`, `matrix`, `distortions`, `rotation` (rotation vector or matrix, world to camera) and
`translation` in OpenCV's convention. anipose and FreeMoCap take the unit of the calibration board (FreeMoCap: always
millimetres) and the first camera's axes unless the ground was set; Pose2Sim and caliscope write metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smplxpp.capture.calibrations.file_camera import FileCamera, RigFile, entry, file_camera
from smplxpp.capture.distortion import FISHEYE, OPENCV
from smplxpp.core.errors import InputError

_KEYS = ("matrix", "rotation", "translation")


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
