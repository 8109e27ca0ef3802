"""The photographs of a moment that a reconstruction may see: held-out cameras and frames are never looked at."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pipelines.stages.reconstruct_config import ReconstructInputs
from smplxpp.capture import Capture, open_capture
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_number, as_numbers, as_object, read_json
from smplxpp.reconstruct import PhotoView
from smplxpp.reconstruct.neus2 import UnitCube

_NAMED = 6


def open_photographs(inputs: ReconstructInputs) -> Capture:
    """Open the capture of a reconstruction; no body parameters are looked at.

    Raises:
        InputError: no capture; one without cameras.
    """
    capture = open_capture(inputs.capture, masks=inputs.masks, protocol=inputs.protocol)
    if not capture.cameras:
        raise InputError(
            f"capture {capture.name}",
            expected="calibrated cameras",
            received="none",
            remedy="give cameras.json or calibration.csv (docs/captures.md)",
        )
    return capture


def usable_cameras(capture: Capture, hold_out: tuple[str, ...]) -> tuple[str, ...]:
    """The cameras that may be looked at: all but those asked for, or but those that the capture holds out.

    Raises:
        InputError: an unknown camera, or none is left.
    """
    splits = capture.splits
    unknown = sorted(set(hold_out) - set(capture.cameras))
    if unknown:
        raise InputError(
            "option hold-out", expected=f"cameras among {', '.join(capture.cameras)}", received=", ".join(unknown)
        )
    known = {*splits.train_cameras, *splits.novel_view_cameras}
    held_out = hold_out or splits.novel_view_cameras
    cameras = tuple(name for name in capture.cameras if name in known and name not in held_out)
    if not cameras:
        raise InputError("cameras", expected="some that are not held out", received="all held out")
    return cameras


def usable_frames(capture: Capture, frames: tuple[int, ...] | None) -> tuple[int, ...]:
    """The frames to reconstruct: those asked for, or all that are trained on.

    Raises:
        InputError: a frame that the capture has not, or one that is held out.
    """
    splits = capture.splits
    if frames is None:
        frames = tuple(frame for frame in splits.train_frames if frame in set(capture.frames))
        if not frames:
            raise InputError(f"capture {capture.name}", expected="training frames with images", received="none")
        return frames
    unknown = sorted(set(frames) - set(capture.frames))
    if unknown:
        have = f"{capture.frames[0]} to {capture.frames[-1]}" if capture.frames else "none"
        raise InputError(
            "--frame",
            expected=f"frames that capture {capture.name} has ({have})",
            received=", ".join(map(str, unknown[:_NAMED])),
        )
    held_out = sorted(set(frames) & set(splits.novel_pose_frames))
    if held_out:
        raise InputError(
            "--frame",
            expected="frames that are trained on",
            received=f"held-out {', '.join(map(str, held_out[:_NAMED]))}",
            remedy="choose others, or hold out other frames in the capture's split",
        )
    return tuple(sorted(set(frames)))


def check_masks(capture: Capture, cameras: tuple[str, ...], frames: tuple[int, ...]) -> None:
    """Refuse a capture without masks before any image is opened.

    Raises:
        InputError: no frame has masks of any camera.
    """
    for frame in frames:
        if any(capture.file(name, frame, "mask") is not None for name in cameras):
            return
    raise InputError(
        f"capture {capture.name}",
        expected="masks of its photographs",
        received="none",
        remedy="give a folder of masks with --masks, or make them with your matting model (docs/captures.md)",
    )


def photographs(capture: Capture, cameras: tuple[str, ...], frame: int) -> tuple[list[PhotoView], list[str]]:
    """The photographs and masks of a frame, and what is wrong with those that are missing."""
    views, problems = [], []
    for name in cameras:
        if capture.file(name, frame) is None:
            continue
        try:
            color, opacity = capture.image(name, frame), capture.mask(name, frame)
        except InputError as error:
            problems.append(f"camera {name} left out: {error}")
            continue
        if opacity is None:
            problems.append(f"camera {name} left out: no mask")
            continue
        views.append(PhotoView(name, capture.cameras[name], color, opacity))
    return views, problems


def photograph_digests(capture: Capture, cameras: tuple[str, ...], frames: tuple[int, ...]) -> dict[str, str]:
    """SHA-256 of the cameras, and of images' and masks' names and sizes: a sequence has gigabytes of them."""
    rig, files = hashlib.sha256(), hashlib.sha256()
    for name in cameras:
        camera = capture.cameras[name]
        rig.update(f"{name} {camera.width} {camera.height}".encode())
        rig.update(camera.K.tobytes() + camera.cam_from_world.tobytes())
    for frame in frames:
        for name in cameras:
            for kind in ("image", "mask"):
                path: Path | None = capture.file(name, frame, kind)
                if path is not None:
                    files.update(f"{kind} {name} {frame} {path.name} {path.stat().st_size}\n".encode())
    return {
        "capture/cameras": rig.hexdigest(),
        "capture/names and sizes of images and masks": files.hexdigest(),
    }


def unit_cube_of(root: Path) -> UnitCube | None:
    """The unit cube that a capture's transform.json names for its trainer; None where it names none."""
    for path in sorted(root.glob("transform*.json")):
        content = as_object(read_json(path), subject=f"file {path}")
        if "scale" in content and "offset" in content:
            offset = as_numbers(content["offset"], (3,), subject=f"file {path}: offset")
            scale = as_number(content["scale"], subject=f"file {path}: scale")
            return UnitCube(scale, (float(offset[0]), float(offset[1]), float(offset[2])))
    return None
