"""The frames that a run can be shown in: a motion that is given, those of its capture, or the reference pose."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import PARAMS
from pipelines.stages.build_config import load_build, load_register
from pipelines.stages.run_inputs import params_in_use
from smplxpp.body import load_params
from smplxpp.body.bvh_params import load_bvh
from smplxpp.body.retarget import Skeleton
from smplxpp.capture import Capture, open_capture
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError
from smplxpp.template.template import Template

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ShownMotion:
    """Frames that the viewer can show.

    Attributes:
        params: T frames, without shape.
        numbers: frame numbers of the capture, or 0 to T - 1.
        fps: frames a second.
        source: description of their origin.
        photographed: whether photographs of these frames exist.
    """

    params: BodyParams
    numbers: tuple[int, ...]
    fps: float
    source: str
    photographed: bool = False


def capture_of_run(run: Path, given: Path | None) -> Capture | None:
    """Open the capture that is given, or the one that a run was made from, if it is still there.

    Raises:
        InputError: a folder that is given and is no capture.
    """
    if given is not None:
        return open_capture(given, params=params_in_use(run, None))
    for folder in _remembered(run):
        try:
            return open_capture(folder, params=params_in_use(run, None))
        except InputError as error:
            log.info("no photographs from %s: %s", folder, error)
    return None


def _remembered(run: Path) -> list[Path]:
    """Folders that a run's own records name."""
    registered, built = load_register(run), load_build(run)
    folders = [] if registered is None or registered.root is None else [registered.root]
    if built is not None and built[0].cameras is not None:
        folders += [built[0].cameras.parent]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def motion_of_run(run: Path, template: Template, capture: Capture | None, given: Path | None) -> ShownMotion:
    """Return the motion that is given, else the capture's frames, else the run's reference pose, else the T-pose.

    Raises:
        InputError: a file that is given and holds no motion of this body.
    """
    if given is not None:
        if given.suffix.lower() == ".bvh":
            params = load_bvh(given, Skeleton.of(template.body))
        else:
            # The template has the identity: betas must not move the root's joint a second time.
            body = replace(template.body, shapedirs=np.zeros_like(template.body.shapedirs))
            params = load_params(given, body=body).without_shape()
        return ShownMotion(params, tuple(range(len(params))), params.fps or DEFAULT_FPS, given.name)
    if capture is not None:
        found = {frame: own for frame in capture.frames if (own := capture.params(frame)) is not None}
        if found:
            whole = BodyParams.concatenate([replace(one, fps=None) for one in found.values()]).without_shape()
            return ShownMotion(
                whole, tuple(found), capture.fps or DEFAULT_FPS, f"capture {capture.name}", photographed=True
            )
    if (run / PARAMS).is_file():
        return ShownMotion(load_params_of_run(run).frame(0).without_shape(), (0,), DEFAULT_FPS, "the reference frame")
    return ShownMotion(BodyParams.rest(betas=0, expressions=0), (0,), DEFAULT_FPS, "the T-pose")
