"""Digests of the parts of a capture that a training reads."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np

from smplxpp.capture import Capture
from smplxpp.capture.recording import ParamSource
from smplxpp.core.params import ARRAY_NAMES, BodyParams


def capture_digests(capture: Capture, params: Mapping[int, BodyParams]) -> dict[str, str]:
    """Return the SHA-256 of cameras, parameters, splits, and of names and sizes of all files that training may read.

    The content of the files is left out, because a sequence has hundreds of gigabytes of them.
    """
    # Three digests, so that a change can be attributed to cameras, parameters or images.
    cameras, numbers, files = hashlib.sha256(), hashlib.sha256(), hashlib.sha256()
    for name, camera in capture.cameras.items():
        cameras.update(name.encode() + camera.K.tobytes() + camera.cam_from_world.tobytes())
        cameras.update(f"{camera.width} {camera.height}".encode())
        if name in capture.recording.distortions:
            cameras.update(repr(capture.recording.distortions[name]).encode())
    for frame, row in params.items():
        _add_frame(numbers, frame, row)
    # Names and sizes reveal a replaced or missing file at the cost of a directory listing.
    splits, used = capture.splits, 0
    for view, frame in capture.views(frames=(*splits.train_frames, *splits.novel_pose_frames)):
        for kind in ("image", "mask", "normal"):
            path = capture.file(view, frame, kind)
            if path is not None:
                files.update(f"{kind} {view} {frame} {path.name} {path.stat().st_size}\n".encode())
                used += 1
    return {
        "capture/cameras": cameras.hexdigest(),
        "capture/parameters": numbers.hexdigest(),
        f"capture/names and sizes of {used} files": files.hexdigest(),
        "capture/splits": hashlib.sha256(repr((splits, capture.recording.background)).encode()).hexdigest(),
    }


def params_digest(source: ParamSource) -> str:
    """Return the SHA-256 of the parameters of all frames."""
    numbers = hashlib.sha256()
    for frame in source.frames().tolist():
        _add_frame(numbers, frame, source.read(frame))
    return numbers.hexdigest()


def _add_frame(numbers: hashlib._Hash, frame: int, row: BodyParams) -> None:
    # The number first, so that the same parameters in another frame give another digest.
    numbers.update(str(frame).encode())
    for array in ARRAY_NAMES:
        numbers.update(np.ascontiguousarray(getattr(row, array)).tobytes())
    if row.v_shape is not None:
        numbers.update(row.v_shape.tobytes())
