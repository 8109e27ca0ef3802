"""check_capture: everything about a capture that would spoil a training run, found before it."""

from __future__ import annotations

import math
import os
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from smplxpp.body import BodyModel
from smplxpp.capture import Capture
from smplxpp.capture.check.calibration import blind_cameras, by_camera, by_frame, calibration_findings
from smplxpp.capture.check.findings import Finding
from smplxpp.capture.check.mistakes import Sample
from smplxpp.capture.check.views import OPAQUE, FitSummary, ViewCheck, check_view
from smplxpp.capture.check.without_images import missing_findings, parameter_findings, read_parameters, split_findings
from smplxpp.core import BodyParams, InputError, ProgressCallback, ignore_progress, matrix_from_rotvec, spread
from smplxpp.core.errors import one_line


@dataclass(frozen=True)
class CheckConfig:
    """Extent of the check of a capture.

    Attributes:
        frames: frames whose images are opened; None: evenly spaced frames with `max_views` views in all. Missing files
            and parameters are reported for all frames in any case.
        max_views: number of views without `frames`.
        size: pixels of the longer side at which masks and silhouettes are compared.
    """

    frames: tuple[int, ...] | None = None
    max_views: int = 2000
    size: int = 640


@dataclass(frozen=True, eq=False)
class CaptureCheck:
    """Findings of a check with their figures.

    Attributes:
        capture: as opened.
        small: the same at the size of the comparison.
        findings: what is wrong; empty for a sound capture.
        views: all views that were opened.
        vertices: gives those of the posed body in a frame, or None.
        faces: the body's triangles.
    """

    capture: Capture
    small: Capture
    findings: tuple[Finding, ...]
    views: tuple[ViewCheck, ...]
    vertices: Callable[[int], Float[np.ndarray, "V 3"] | None]
    faces: Int[np.ndarray, "F 3"]

    __repr__ = one_line

    @property
    def failed(self) -> bool:
        """Whether anything has to be done before training."""
        return any(finding.status == "fail" for finding in self.findings)

    @property
    def frames(self) -> tuple[int, ...]:
        """Return the frames whose images were opened."""
        return tuple(dict.fromkeys(view.frame for view in self.views))

    def cameras(self) -> dict[str, FitSummary]:
        """Return the body's fit into the masks by camera."""
        return by_camera(self.views)

    def frame_fits(self) -> dict[int, FitSummary]:
        """Return the body's fit into the masks by frame."""
        return by_frame(self.views)


def check_capture(
    capture: Capture,
    body: BodyModel,
    config: CheckConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> CaptureCheck:
    """Look at files, splits, masks, parameters, and at the posed body's silhouette against the masks.

    Args:
        capture: as opened.
        body: the model that the parameters are for.
        config: how much to look at.
        progress: called with the share of the views that are checked.

    Raises:
        InputError: frames that the capture does not have.
    """
    config = config or CheckConfig()
    frames = _chosen_frames(capture, config)
    # What needs no image comes first: files, splits, then parameters.
    findings = [*missing_findings(capture), *split_findings(capture)]
    params = read_parameters(capture)
    findings += parameter_findings(capture, params, body)
    poser = _Poser(body, params)
    # Silhouettes are compared at a reduced size, which keeps shares of pixels and saves time quadratically.
    small = capture.resized(_scale(capture, config.size))
    views: list[ViewCheck] = []
    wanted = small.views(frames=frames)
    # Decoding and rendering release the interpreter's lock, so that threads suffice. One body is posed for each
    # frame.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for frame, group in groupby(wanted, key=lambda view: view[1]):
            vertices = poser.vertices(frame)
            posed = None if vertices is None else (vertices, body.faces)
            cameras = [camera for camera, _ in group]
            views += pool.map(lambda camera, f=frame, b=posed: check_view(small, camera, f, b), cameras)
            progress("images", len(views) / len(wanted))
    findings += [finding for view in views for finding in view.findings]
    # Findings over many views: a colour that all photographs share, cameras that never see the person.
    findings += [*poser.findings, *_plain_background(views), *blind_cameras(views)]
    findings += calibration_findings(views, small.cameras, lambda camera, frame: _sample(small, poser, camera, frame))
    # The same defect may be found twice, for instance by the list of files and by decoding.
    shown = tuple(_relative(finding, capture.root) for finding in dict.fromkeys(findings))
    return CaptureCheck(capture, small, shown, tuple(views), poser.vertices, body.faces)


class _Poser:
    """The posed body by frame; what cannot be posed becomes a finding."""

    def __init__(self, body: BodyModel, params: dict[int, BodyParams]) -> None:
        self.body, self.params = body, params
        self.findings: list[Finding] = []
        self._posed: OrderedDict[int, Float[np.ndarray, "V 3"] | None] = OrderedDict()

    def vertices(self, frame: int) -> Float[np.ndarray, "V 3"] | None:
        """Pose the body as in a frame; None without usable parameters. The last few are kept."""
        # Number of posed bodies that are kept in memory.
        kept = 32
        if frame not in self._posed:
            self._posed[frame] = self._pose(frame)
            if len(self._posed) > kept:
                self._posed.popitem(last=False)
        return self._posed[frame]

    def _pose(self, frame: int) -> Float[np.ndarray, "V 3"] | None:
        if frame not in self.params:
            return None
        try:
            return self.body.forward(self.params[frame]).vertices[0]
        except InputError as error:
            self.findings.append(Finding("params-body", f"frame {frame}: {error}", None, frame))
            return None


def _sample(small: Capture, poser: _Poser, camera: str, frame: int) -> Sample | None:
    """Return the view to try corrections on; None where the body or the mask is missing."""
    shifts = (-3, -2, -1, 1, 2, 3)  # frame offsets that are tried where images and parameters may not be synchronised
    vertices = poser.vertices(frame)
    mask = small.mask(camera, frame)
    if vertices is None or mask is None:
        return None
    p = poser.params[frame]
    # Rotation about the origin instead of the root joint moves the body by R r - r, with r the root joint at rest.
    root = poser.body.rest_joints(p)[0, 0]
    neighbours = {k: poser.vertices(frame + k) for k in shifts}
    return Sample(
        camera=small.cameras[camera],
        mask=mask > OPAQUE,
        vertices=vertices,
        faces=poser.body.faces,
        transl=p.transl[0],
        pivot_shift=matrix_from_rotvec(p.global_orient[0]) @ root - root,
        neighbours={k: v for k, v in neighbours.items() if v is not None},
    )


def _chosen_frames(capture: Capture, config: CheckConfig) -> list[int]:
    if config.frames is None:
        # Spread over the capture; at least two, so that a bad frame can be told from a bad calibration.
        return spread(capture.frames, max(2, config.max_views // max(1, len(capture.cameras))))
    unknown = sorted(set(config.frames) - set(capture.frames))
    if unknown:
        raise InputError(
            "--frames",
            expected=f"frames from {min(capture.frames, default=0)} to {max(capture.frames, default=0)} that exist",
            received=f"{unknown[:5]}",
        )
    return sorted(set(config.frames))


def _scale(capture: Capture, size: int) -> float:
    """Return a scale of one to a whole number, so that reduced images are means over areas; 1 for small ones."""
    longest = max((max(camera.width, camera.height) for camera in capture.cameras.values()), default=1)
    return 1.0 / max(1, math.ceil(longest / size))


def _plain_background(views: Sequence[ViewCheck]) -> list[Finding]:
    """Photographs that all lie on one plain colour were composited, whatever the capture declares."""
    colours = [view.plain for view in views if view.plain is not None]
    # Nine views of ten must lie on a plain colour of their own.
    if len(colours) < 0.9 * len(views) or not colours:
        return []
    # All must be the same colour: 16 of 255 is above the error of JPEG.
    common = np.median(colours, axis=0)
    if np.abs(np.array(colours) - common).max() > 16:
        return []
    words = f"images are declared as photographs, but all lie on plain RGB {common.astype(int).tolist()}"
    shares = (common / 255.0).round(3).tolist()
    return [Finding("background-plain", words, advice=f'declare it in capture.json: `"background": {shares}`')]


def _relative(finding: Finding, root: Path) -> Finding:
    """Return the finding with file names from the capture's folder on."""
    return Finding(
        finding.kind, finding.message.replace(f"{root}{os.sep}", ""), finding.camera, finding.frame, finding.advice
    )
