"""Match the names of calibrated cameras to those of files and folders: `cam_01` is `cam01_json`, `cam01.mp4`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

# What tools add to a camera's name: folders of keypoints, images and videos, results of detectors.
_ADDED = (
    "json", "img", "imgs", "images", "image", "video", "videos", "pose", "poses", "keypoints", "openpose", "rgb", "mp4",
    "results", "synchronized", "synced", "sync", "undistorted", "halpe26", "body25b", "body25", "coco17", "int", "ext",
)  # fmt: skip


def matched_names(cameras: Sequence[str], files: Sequence[str]) -> dict[str, str]:
    """Return for each camera the file or folder (without its suffix) that is its own; cameras without one are left out.

    Names are compared without case, signs, zeros before numbers and what tools add to them. Equal names go first, then
    names that hold the camera's whole (a serial number in a video's name), then the only one with the same last number.
    No file is given to two cameras.

    Args:
        cameras: names of the calibration.
        files: names to choose from.
    """
    out: dict[str, str] = {}
    free = list(dict.fromkeys(files))
    for same in (_exactly, _within, _by_number):
        for camera in cameras:
            if camera in out:
                continue
            # Additions make names longer: of several the shortest is the camera's own.
            fitting = sorted((file for file in free if same(camera, file)), key=lambda name: (len(name), name))
            if not fitting or (same is _by_number and _shared(camera, fitting, cameras, out)):
                continue
            out[camera] = fitting[0]
            free.remove(fitting[0])
    return {camera: out[camera] for camera in cameras if camera in out}


def _shared(camera: str, fitting: Sequence[str], cameras: Sequence[str], matched: Mapping[str, str]) -> bool:
    """Tell whether several files, or several cameras without one, have the number."""
    others = (other for other in cameras if other != camera and other not in matched)
    return len(fitting) > 1 or any(_by_number(other, fitting[0]) for other in others)


def _tokens(name: str) -> tuple[str, ...]:
    """Return the words and numbers of a name, in lower case, without what tools add."""
    parts = re.findall(r"[a-z]+|\d+", name.lower())
    kept = [part for part in parts if part not in _ADDED]
    return tuple(part.lstrip("0") or "0" if part.isdigit() else part for part in kept or parts)


def _exactly(camera: str, file: str) -> bool:
    return camera == file or _tokens(camera) == _tokens(file)


def _within(camera: str, file: str) -> bool:
    """Tell whether the words of the camera stand one after another in those of the file."""
    own, other = _tokens(camera), _tokens(file)
    return any(other[k : k + len(own)] == own for k in range(len(other) - len(own) + 1))


def _by_number(camera: str, file: str) -> bool:
    """Tell whether the last numbers are the same."""
    own, other = (re.findall(r"\d+", name) for name in (camera, file))
    return bool(own) and bool(other) and int(own[-1]) == int(other[-1])
