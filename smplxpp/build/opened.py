"""Open captures for a build, and give them parameters that are in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from smplxpp.body import BodyModel
from smplxpp.capture import Capture, open_capture
from smplxpp.capture.sources import FrameParams
from smplxpp.core import BodyParams, InputError


def with_params(capture: Capture, frames: tuple[int, ...], params: BodyParams, *, estimated: bool) -> Capture:
    """Return the capture with other body parameters, a row a frame; `estimated` as `FrameParams` has it."""
    source = FrameParams({frame: params.frame(row) for row, frame in enumerate(frames)}, estimated=estimated)
    return replace(capture, recording=replace(capture.recording, params=source))


def opened(
    capture: Path | Capture,
    *,
    params: Path | BodyParams | None = None,
    frame: int = 0,
    body: BodyModel | None = None,
    protocol: str | None = None,
    keypoints: Path | None = None,
    masks: Path | None = None,
    subject: int | None = None,
) -> Capture:
    """Open a capture with the files that a build names; an open one is taken as it is.

    Args:
        capture: folder, or open capture.
        params: a file or folder, or a row a frame in memory (one row: of `frame`), which replace the capture's own.
        frame: of a single row in memory.
        body: the model that the parameters are for.
        protocol: of the capture.
        keypoints: folder that replaces the capture's own.
        masks: folder that replaces the capture's own.
        subject: place of the person whose keypoints are taken, where several are in view.

    Raises:
        InputError: no capture, or files named beside an open one that was opened with others.
    """
    file = None if isinstance(params, BodyParams) else params
    # An open capture has been read with its options already; other options cannot be applied to it afterwards.
    if isinstance(capture, Capture):
        if protocol not in (None, capture.protocol):
            raise InputError("protocol", expected=f"that of the capture, {capture.protocol}", received=str(protocol))
        for name, value in (("keypoints", keypoints), ("masks", masks), ("subject", subject)):
            if value is not None:
                raise InputError(
                    name,
                    expected=f"the folder of a capture beside it, or open_capture(..., {name}=...)",
                    received="an open capture",
                )
        if file is not None:
            # Only the parameters are exchanged: images, masks and keypoints of the open capture stay as they are.
            again = open_capture(capture.root, params=file, body=body, protocol=protocol)
            capture = replace(capture, recording=replace(capture.recording, params=again.recording.params))
    else:
        capture = open_capture(
            capture, params=file, body=body, protocol=protocol, keypoints=keypoints, masks=masks, subject=subject
        )
    if isinstance(params, BodyParams):
        # One row belongs to the reference frame; several rows are the frames from 0 on.
        frames = (frame,) if len(params) == 1 else tuple(range(len(params)))
        return with_params(capture, frames, params, estimated=False)
    return capture
