"""Digests of the parts of a capture that a training reads."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np

from smplxpp.capture import Capture
from smplxpp.capture.recording import ParamSource
from smplxpp.core.params import ARRAY_NAMES, BodyParams


def capture_digests(
    capture: Capture, params: Mapping[int, BodyParams], *, files: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return the SHA-256 of cameras, parameters, splits, and of names and sizes of all files that training may read.

    The content of the files is left out, because a sequence has hundreds of gigabytes of them.

    Args:
        capture: with its splits.
        params: of its frames.
        files: `names_and_sizes` of the same views, where they are known.
    """
    # Digests apart, so that a change can be attributed to cameras, parameters or images.
    cameras, numbers, splits = hashlib.sha256(), hashlib.sha256(), capture.splits
    for name, camera in capture.cameras.items():
        cameras.update(name.encode() + camera.K.tobytes() + camera.cam_from_world.tobytes())
        cameras.update(f"{camera.width} {camera.height}".encode())
        if name in capture.recording.distortions:
            cameras.update(repr(capture.recording.distortions[name]).encode())
    for frame, row in params.items():
        _add_frame(numbers, frame, row)
    return {
        "capture/cameras": cameras.hexdigest(),
        "capture/parameters": numbers.hexdigest(),
        **(names_and_sizes(capture) if files is None else files),
        "capture/splits": hashlib.sha256(repr((splits, capture.recording.background)).encode()).hexdigest(),
    }


def names_and_sizes(capture: Capture) -> dict[str, str]:
    """Return the SHA-256 of names and sizes of the files of all views that training may read, by their number.

    They reveal a replaced or missing file at the cost of a directory listing.
    """
    digest, used = hashlib.sha256(), 0
    wanted = np.isin(capture.frames, (*capture.splits.train_frames, *capture.splits.novel_pose_frames))
    frames, views = np.array(capture.frames, dtype=np.int64), capture.presence() & wanted
    for kind in ("image", "mask", "normal"):
        for view, present in zip(capture.recording.cameras, views & capture.presence(kind), strict=True):
            series = capture.recording.series(kind, view)
            if series is None or not present.any():
                continue
            own = series.only(np.isin(series.numbers, frames[present]))
            digest.update(f"{kind} {view} {own.names.dtype}\n".encode())
            for array in (own.numbers, own.names, own.sizes()):
                digest.update(array.tobytes())
            used += len(own)
    return {f"capture/names and sizes of {used} files": digest.hexdigest()}


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
