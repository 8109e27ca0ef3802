"""Hold the request for a build: the scan or capture, and what a user gives with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.build.config import BuildConfig, ReconstructInputs, RegisterInputs
from smplxpp.capture import Capture
from smplxpp.capture.readers.simple import stacked_params
from smplxpp.core import BodyParams, MeshLike


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
