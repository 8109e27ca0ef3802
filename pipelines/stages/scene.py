"""What a training reads, opened and looked at before it starts: what cannot be trained on is said, or left out."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

from avatar.data.views import read_views
from pipelines.runs.code import sha256_file
from pipelines.runs.folders import lies_in
from pipelines.runs.layout import (
    RECONSTRUCT_STAGE,
    REFINE_STAGE,
    REFINED_CAMERAS,
    REFINED_PARAMS,
    REGISTER_STAGE,
    REGISTERED_PARAMS,
    TEMPLATE,
)
from pipelines.stages.build_config import load_build
from pipelines.stages.held_out import refuse_seen
from pipelines.stages.params_in_use import params_in_use, params_to_begin_with
from pipelines.stages.protocol import chosen_protocol
from pipelines.stages.scene_digests import capture_digests
from pipelines.stages.usable import (
    compare_shapes,
    overlap_of,
    silhouette_overlap,
    with_cameras,
    with_masks,
    with_params,
)
from smplxpp.body import load_body
from smplxpp.capture import Capture, open_capture, read_cameras
from smplxpp.capture.readers.simple import stacked_params
from smplxpp.capture.splits import Splits
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.template.template import Template

REGISTER_ANEW = "register without them (smplxpp register --hold-out, or the capture's split)"
RECONSTRUCT_ANEW = "reconstruct without them (smplxpp reconstruct --hold-out, or the capture's split) and build anew"
REFINE_ANEW = "refine the poses without them (smplxpp train --refine-poses on)"


@dataclass(frozen=True)
class TrainInputs:
    """Where a training takes its views from.

    Attributes:
        capture: folder of any known layout.
        params: other parameters than those that the run has made (`params_in_use`) or the capture's own. body: what
            they are for, None for the open body.
        hold_out: names of cameras kept from training; empty: those that the capture's splits hold out.
        scale: of the images, 1 for all pixels.
        protocol: of the capture; None: the run's.
    """

    capture: Path
    params: Path | None = None
    body: Path | None = None
    hold_out: tuple[str, ...] = ()
    scale: float = 1.0
    protocol: str | None = None

    def __post_init__(self) -> None:
        if self.params is not None:  # a file by its name in the capture is the same as by its path
            object.__setattr__(self, "params", stacked_params(self.capture, self.params))


@dataclass(frozen=True, eq=False)
class TrainScene:
    """A capture that can be trained on; pickles.

    Attributes:
        template: of the run.
        capture: its splits are what is trained on and held out; unusable frames and views are left out.
        frame: the reference frame of the fit.
        built_frame: the one that the template was built from, if it is trained on; then both are one.
        template_frame: the one whose scan the template is made of, if that scan is the capture's own.
        overlap: mean IoU of silhouettes and masks in `CHECKED_FRAMES` training frames.
        digests: SHA-256 by name of everything that is read.
    """

    template: Template
    capture: Capture
    frame: int
    built_frame: int | None
    template_frame: int | None
    overlap: float
    digests: dict[str, str]


def open_template(run: Path) -> Template:
    """The template of a run.

    Raises:
        InputError: none has been built.
    """
    path = run / TEMPLATE
    if not path.is_file():
        raise InputError(
            f"run {run}",
            expected=f"a template, {TEMPLATE}",
            received="none",
            remedy="make one with `smplxpp build --capture DIR --out RUN`",
        )
    return Template.load(path)


def open_frame(run: Path, inputs: TrainInputs, frame: int) -> TrainScene:
    """Open the template of a run and one frame of a capture, for a fit; see `open_scene`.

    Raises:
        InputError: no template; a capture that lacks images, masks, cameras or parameters of the frame; a template
            that does not stand in the images.
    """
    template = open_template(run)
    inputs = of_protocol(run, inputs)
    inputs = replace(inputs, params=params_in_use(run, inputs.params))
    capture, train, held_out = open_cameras(inputs)
    if inputs.params == run / REFINED_PARAMS:
        capture = _corrected(run, capture)
    if frame not in capture.frames:
        raise InputError(
            f"capture {capture.name}",
            expected=f"frame {frame}",
            received=f"frames {capture.frames[0]} to {capture.frames[-1]}",
            remedy="choose another with --frame",
        )
    params = capture.params(frame)
    if params is None:
        raise InputError(
            f"capture {capture.name}",
            expected=f"body parameters of frame {frame}",
            received="none",
            remedy="name a file with --params, convert your fit with `smplxpp params convert`, or make one with "
            "`smplxpp register`",
        )
    capture = replace(capture, splits=Splits(train, held_out, (frame,), ()))
    overlap = silhouette_overlap(
        template.mesh.with_vertices(template.pose(params)[0]), read_views(capture, frame, train)
    )
    digests = {TEMPLATE: sha256_file(run / TEMPLATE)}
    return TrainScene(template, capture, frame, frame, _template_frame(run, inputs), overlap, digests)


def open_scene(run: Path, inputs: TrainInputs, *, refined: bool = True, measures: bool = False) -> TrainScene:
    """Open the template of a run and a capture, and look at both.

    Training frames and views that lack parameters or a mask are left out with a warning, if others remain.

    Args:
        refined: with the run's refined parameters, if it has any that began with these.
        measures: nothing is trained; then another protocol than the run's is logged and not refused.

    Raises:
        InputError: no template; another protocol than the template's; no training camera, image, mask or parameters;
            images of another size than their camera; nobody in the masks; a template that does not stand in the images,
            or parameters of another body.
    """
    template = open_template(run)
    if not template.cloth_mask.any():
        warnings.warn("the template has no clothes: the whole of it moves as one body", GeometryWarning, stacklevel=2)
    inputs = of_protocol(run, inputs, measures=measures)
    inputs = replace(inputs, params=(params_in_use if refined else params_to_begin_with)(run, inputs.params))
    capture, params = with_params(_opened(inputs))
    capture = with_masks(capture)
    made: dict[str, str] = {}
    if inputs.params == run / REGISTERED_PARAMS:
        refuse_seen(run, (REGISTER_STAGE,), capture.splits, anew=REGISTER_ANEW)
    if inputs.params == run / REFINED_PARAMS:
        refuse_seen(run, (REFINE_STAGE,), capture.splits, anew=REFINE_ANEW)
        made = {REFINED_PARAMS: sha256_file(inputs.params)}
        if (run / REFINED_CAMERAS).is_file():
            made[REFINED_CAMERAS] = sha256_file(run / REFINED_CAMERAS)
            capture = _corrected(run, capture)
    seen = {shown for _, shown in capture.views(capture.splits.train_cameras)}
    frames = [number for number in capture.splits.train_frames if number in seen]
    built = load_build(run)
    if built is not None and lies_in(built[0].scan, run / RECONSTRUCT_STAGE):
        refuse_seen(run, (RECONSTRUCT_STAGE,), capture.splits, anew=RECONSTRUCT_ANEW)
    built_frame = built[0].frame if built is not None and built[0].frame in frames else None
    frame = frames[0] if built_frame is None else built_frame
    for name in capture.splits.train_cameras:
        if capture.file(name, frame) is not None:
            capture.foreground(name, frame)  # a damaged image or one of another size is an error now
    compare_shapes(template, [params[f] for f in frames])
    overlap = overlap_of(template, capture, params)
    digests = {TEMPLATE: sha256_file(run / TEMPLATE), **made, **capture_digests(capture, params)}
    template_frame = _template_frame(run, inputs)
    if template_frame in capture.splits.novel_pose_frames:
        raise InputError(
            f"held-out frames of capture {capture.name}",
            expected="frames that neither the template nor a model has seen",
            received=f"frame {template_frame}, whose scan the template of {run} was built from",
            remedy="hold out other frames (in the capture's split, or with --hold-out-frames of evaluate), or build "
            "the template from a training frame",
        )
    return TrainScene(template, capture, frame, built_frame, template_frame, overlap, digests)


def of_protocol(run: Path, inputs: TrainInputs, *, measures: bool = False) -> TrainInputs:
    """The inputs with the protocol that is read."""
    own_params = inputs.params is not None
    protocol = chosen_protocol(run, inputs.protocol, own_params=own_params, measures=measures)
    return replace(inputs, protocol=protocol)


def _corrected(run: Path, capture: Capture) -> Capture:
    """The capture with the training cameras that the run has corrected, if it has."""
    file = run / REFINED_CAMERAS
    if not file.is_file():
        return capture
    return with_cameras(capture, {camera.name: camera.cam_from_world for camera in read_cameras(file)})


def _template_frame(run: Path, inputs: TrainInputs) -> int | None:
    """The frame of the capture whose scan the template was built from."""
    built = load_build(run)
    if built is None or not lies_in(built[0].scan, inputs.capture):
        return None
    return built[0].frame


def open_cameras(inputs: TrainInputs) -> tuple[Capture, tuple[str, ...], tuple[str, ...]]:
    """The capture, and the names of the cameras to train on and of those held out.

    Raises:
        InputError: unknown cameras, none, or none to train on.
    """
    body = None if inputs.body is None else load_body(inputs.body)
    capture = open_capture(inputs.capture, params=inputs.params, body=body, protocol=inputs.protocol)
    if not capture.cameras or not capture.presence().any():
        raise InputError(
            f"capture {capture.name}",
            expected="cameras and their images",
            received="none",
            remedy="a scan alone makes a template; a fit needs the views: see docs/captures.md",
        )
    unknown = sorted(set(inputs.hold_out) - set(capture.cameras))
    if unknown:
        raise InputError(
            "option hold-out", expected=f"cameras among {', '.join(capture.cameras)}", received=", ".join(unknown)
        )
    if not 0.0 < inputs.scale <= 1.0:
        raise InputError("option scale", expected="a number above 0 and at most 1", received=f"{inputs.scale:g}")
    if inputs.scale != 1.0:
        capture = capture.resized(inputs.scale)
    splits = capture.splits
    held_out = inputs.hold_out or splits.novel_view_cameras
    # Cameras that the splits hold out and the option does not are trained on; those of neither are not.
    known = {*splits.train_cameras, *splits.novel_view_cameras}
    train = tuple(name for name in capture.cameras if name in known and name not in held_out)
    if not train:
        raise InputError("cameras", expected="at least one to train on", received="all held out")
    return capture, train, tuple(held_out)


def _opened(inputs: TrainInputs) -> Capture:
    """The capture with the user's held-out cameras and scale; frames as it splits them."""
    capture, train, held_out = open_cameras(inputs)
    old = capture.splits
    if not old.train_frames:
        raise InputError(
            f"capture {capture.name}",
            expected="frames to train on",
            received="none in its splits",
            remedy="see docs/captures.md: splits are read from the capture",
        )
    return replace(capture, splits=Splits(train, held_out, old.train_frames, old.novel_pose_frames))
