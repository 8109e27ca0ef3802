"""Hold the request for a build, and open the captures that it names."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.build.config import BuildConfig, ReconstructInputs, RegisterInputs
from smplxpp.capture import Capture, open_capture
from smplxpp.capture.readers.simple import stacked_params
from smplxpp.capture.sources import FrameParams
from smplxpp.core import BodyParams, InputError, MeshLike


@dataclass(frozen=True, eq=False)
class BuildRequest:
    """What a user asks a build for: files or objects in memory, and options.

    Attributes:
        scan: clothed scan of the reference frame, a file or a mesh.
        capture: folder of a capture, or an open one. Either this or a scan is given.
        params: body parameters of the scan.
        labels: labels of the scan's vertices or faces, a file or an array of ids.
        body: body file or model; None: the open body.
        config: choices of the build.
        surface: file in which a reconstructed scan is kept; None: in memory.
        registration: inputs of an earlier registration, which stands if it was of this capture.
        reconstruction: inputs of an earlier reconstruction, likewise.
    """

    scan: Path | MeshLike | None = None
    capture: Path | Capture | None = None
    params: Path | BodyParams | None = None
    labels: Path | np.ndarray | None = None
    body: Path | BodyModel | None = None
    config: BuildConfig = field(default_factory=BuildConfig)
    surface: Path | None = None
    registration: RegisterInputs | None = None
    reconstruction: ReconstructInputs | None = None

    @property
    def root(self) -> Path | None:
        """Folder of the capture, also of an open one; None without a capture."""
        return self.capture.root if isinstance(self.capture, Capture) else self.capture

    @property
    def protocol(self) -> str | None:
        """Name of the protocol that is read: the configuration's, or that of an open capture."""
        if self.config.protocol is None and isinstance(self.capture, Capture):
            return self.capture.protocol
        return self.config.protocol

    @property
    def body_file(self) -> Path | None:
        """The body's file; None for the open body and for a model in memory."""
        return None if isinstance(self.body, BodyModel) else self.body

    @property
    def named_params(self) -> Path | None:
        """The parameters' file (`named_params`); parameters in memory have none."""
        return named_params(self.root, self.params) if isinstance(self.params, Path) else None


def named_params(root: Path | None, params: Path | None) -> Path | None:
    """Return the file or folder that a user means by parameters: a path, or a name in the capture's folder `params`."""
    return stacked_params(root, params) if params is not None and root is not None else params


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
