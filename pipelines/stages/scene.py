"""The template of a run and a capture, opened for a training: which parameters and cameras of the run are read.

Views that count as held out are compared with those that models were trained on, as their stages record.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data.one_frame import frames_beside
from avatar.data.views import read_view, read_views
from avatar.training.scene import TrainScene, hold_out_cameras, prepare_scene, silhouette_overlap, with_cameras
from pipelines.runs import layout
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import REFINE_STAGE, REFINED_CAMERAS, REFINED_PARAMS, TEMPLATE
from pipelines.runs.stage import MANIFEST, StageRecord, read_manifest
from pipelines.stages.build_config import load_build
from pipelines.stages.run_inputs import chosen_protocol, params_in_use, params_to_begin_with
from smplxpp.body import load_body
from smplxpp.capture import Capture, Splits, open_capture, read_cameras
from smplxpp.capture.readers.simple import stacked_params
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_list, as_object, as_text
from smplxpp.core.files.paths import lies_in
from smplxpp.figures.drawings import write_strip
from smplxpp.template.template import Template

log = logging.getLogger(__name__)
NAMED = 8
"""Largest number of cameras or frames that an error message lists."""
TRAIN_AGAIN = "train without them (smplxpp train --force; the capture's split says which frames are held out)"
REGISTER_AGAIN = "register without them (smplxpp register --hold-out, or the capture's split)"
RECONSTRUCT_AGAIN = "reconstruct without them (smplxpp reconstruct --hold-out, or the capture's split) and build again"
REFINE_AGAIN = "refine the poses without them (smplxpp train --refine-poses on)"


@dataclass(frozen=True)
class Seen:
    """Cameras and frames that a model learned from, directly or through the models it was made from."""

    cameras: frozenset[str]
    frames: frozenset[int]


def seen_of(record: StageRecord) -> Seen | None:
    """Return the cameras and frames that the model of a stage has seen; None where its manifest has no record.

    Raises:
        InputError: a manifest with values of another type.
    """
    subject = f"file {record.folder / MANIFEST}: seen"
    value = record.manifest["numbers"].get("seen")
    if value is None:
        return None
    found = as_object(value, subject=subject)
    cameras = as_list(found.get("cameras", []), subject=f"{subject}: cameras")
    frames = as_list(found.get("frames", []), subject=f"{subject}: frames")
    return Seen(
        frozenset(as_text(camera, subject=f"{subject}: camera") for camera in cameras),
        frozenset(as_integer(frame, subject=f"{subject}: frame") for frame in frames),
    )


def _seen_by(run: Path, stage: str) -> Seen:
    """Return what the model of a stage has seen; log a warning for a model without a record."""
    manifest = read_manifest(run / stage)
    seen = None if manifest is None else seen_of(StageRecord(run / stage, manifest, ran=False))
    if seen is None:
        log.warning("%s: what its model has seen is not recorded; whether views are novel is not known", stage)
        return Seen(frozenset(), frozenset())
    return seen


def refuse_seen(run: Path, stages: Iterable[str], splits: Splits, *, remedy: str = TRAIN_AGAIN) -> None:
    """Refuse models that have seen cameras or frames which count as held out.

    Args:
        run: folder of the run.
        stages: names of the stages that made the models.
        splits: the cameras and frames that count as held out.
        remedy: how to make models that have not seen them.

    Raises:
        InputError: names the stages and what they saw.
    """
    # Intersect what is held out now with what each model has learned from.
    each = {name: _seen_by(run, name) for name in sorted(stages)}
    cameras = [camera for camera in splits.novel_view_cameras if any(camera in one.cameras for one in each.values())]
    frames = [frame for frame in splits.novel_pose_frames if any(frame in one.frames for one in each.values())]
    if not cameras and not frames:
        return
    # Suggest cameras that no model has seen: holding out those needs no further training.
    known = sorted({*splits.train_cameras, *splits.novel_view_cameras})
    never = [camera for camera in known if all(camera not in one.cameras for one in each.values())]
    names = [name for name, one in each.items() if one.cameras.intersection(cameras) or one.frames.intersection(frames)]
    if cameras and never:
        remedy = f"hold out what they did not see (--hold-out {' '.join(never[:NAMED])}), or {remedy}"
    what = [f"{kind} {_named(values)}" for kind, values in (("cameras", cameras), ("frames", frames)) if values]
    raise InputError(
        f"held-out views of run {run}",
        expected="views that its models have not seen",
        received=f"{' and '.join(what)}, which {', '.join(names)} learned from",
        remedy=remedy,
    )


def _named(values: list[Any]) -> str:
    shown = ", ".join(map(str, values[:NAMED]))
    return shown if len(values) <= NAMED else f"{shown} and {len(values) - NAMED} more"


@dataclass(frozen=True)
class TrainInputs:
    """Sources from which a training reads its views.

    Attributes:
        capture: folder of any known layout.
        params: parameters to read; None: those that the run has made (`params_in_use`), or the capture's own.
        body: body model that `params` are for, None for the open body.
        hold_out: names of cameras kept from training; empty: those that the capture's splits hold out.
        scale: size of the images, 1 for all pixels.
        protocol: protocol of the capture; None: the run's.
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


def open_template(run: Path) -> Template:
    """Load the template of a run.

    Raises:
        InputError: none has been built.
    """
    path = run / TEMPLATE
    if not path.is_file():
        raise InputError(
            f"run {run}",
            expected=f"a template, {TEMPLATE}",
            received="none",
            remedy="make one with `smplxpp build RUN --capture DIR`",
        )
    return Template.load(path)


def open_frame(run: Path, inputs: TrainInputs, frame: int) -> TrainScene:
    """Open the template of a run and one frame of a capture, for a fit; see `open_scene`.

    Raises:
        InputError: no template; a capture that lacks images, masks, cameras or parameters of the frame; a template
            that does not stand in the images.
    """
    # Choose protocol and parameters as `open_scene` does, so that fit and training see the same poses and cameras.
    template = open_template(run)
    inputs = of_protocol(run, inputs)
    inputs = replace(inputs, params=params_in_use(run, inputs.params))
    capture = open_views(inputs)
    if inputs.params == run / REFINED_PARAMS:
        capture = _corrected(run, capture)
    # Check the frame before any image is read.
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
    # Reduce the training frames to this one, or a turn's to those that show its sides; held-out cameras remain for
    # measuring.
    splits, frames = capture.splits, (frame, *frames_beside(capture, frame))
    capture = replace(capture, splits=Splits(splits.train_cameras, splits.novel_view_cameras, frames, ()))
    overlap = silhouette_overlap(
        template.mesh.with_vertices(template.pose(params)[0]), read_views(capture, frame, splits.train_cameras)
    )
    digests = {TEMPLATE: sha256_file(run / TEMPLATE)}
    return TrainScene(template, capture, frame, frame, _template_frame(run, inputs), overlap, digests)


def open_scene(
    run: Path, inputs: TrainInputs, *, refined: bool = True, measures: bool = False, before: TrainScene | None = None
) -> TrainScene:
    """Open the template of a run and a capture, and check that they fit together.

    Training frames and views that lack parameters or a mask are left out with a warning, if others remain.

    Args:
        run: folder of the run.
        inputs: capture, parameters, held-out cameras and scale.
        refined: whether to read the run's refined parameters, if it has any that started from these.
        measures: whether the caller only measures; then another protocol than the run's is logged instead of refused.
        before: scene of the same inputs with other parameters, whose files are not looked at again.

    Raises:
        InputError: no template; another protocol than the template's; no training camera, image, mask or parameters;
            images of another size than their camera; empty masks; a template that does not stand in the images, or
            parameters of another body.
    """
    # Choose the protocol first: it decides which parameters and splits the capture has.
    template = open_template(run)
    inputs = of_protocol(run, inputs, measures=measures)
    inputs = replace(inputs, params=(params_in_use if refined else params_to_begin_with)(run, inputs.params))
    capture = open_views(inputs)
    # Refined parameters were optimised together with camera corrections, so that both are read or neither.
    made: dict[str, str] = {}
    if inputs.params == run / REFINED_PARAMS:
        made = {name: sha256_file(run / name) for name in (REFINED_PARAMS, REFINED_CAMERAS) if (run / name).is_file()}
        capture = _corrected(run, capture)
    built = load_build(run)
    scene = prepare_scene(template, capture, built_frame=None if built is None else built[0].frame, before=before)
    # What the run made from photographs must not have seen those that are held out now.
    splits = scene.capture.splits
    if inputs.params == run / layout.REGISTERED_PARAMS:
        refuse_seen(run, (layout.REGISTER_STAGE,), splits, remedy=REGISTER_AGAIN)
    if inputs.params == run / REFINED_PARAMS:
        refuse_seen(run, (REFINE_STAGE,), splits, remedy=REFINE_AGAIN)
    if built is not None and lies_in(built[0].scan_file, run / layout.RECONSTRUCT_STAGE):
        refuse_seen(run, (layout.RECONSTRUCT_STAGE,), splits, remedy=RECONSTRUCT_AGAIN)
    template_frame = _template_frame(run, inputs)
    # The same holds for the template: its shape was scanned in one frame.
    if template_frame in splits.novel_pose_frames:
        raise InputError(
            f"held-out frames of capture {capture.name}",
            expected="frames that neither the template nor a model has seen",
            received=f"frame {template_frame}, whose scan the template of {run} was built from",
            remedy="hold out other frames (in the capture's split, or with --hold-out-frames of evaluate), or build "
            "the template from a training frame",
        )
    digests = {TEMPLATE: sha256_file(run / TEMPLATE), **made, **scene.digests}
    return replace(scene, template_frame=template_frame, digests=digests)


def of_protocol(run: Path, inputs: TrainInputs, *, measures: bool = False) -> TrainInputs:
    """Return the inputs with the protocol for reading the capture filled in."""
    own_params = inputs.params is not None
    protocol = chosen_protocol(run, inputs.protocol, own_params=own_params, measures=measures)
    return replace(inputs, protocol=protocol)


def _corrected(run: Path, capture: Capture) -> Capture:
    """Return the capture with the camera corrections of the run, unchanged without any."""
    file = run / REFINED_CAMERAS
    if not file.is_file():
        return capture
    return with_cameras(capture, {camera.name: camera.cam_from_world for camera in read_cameras(file)})


def _template_frame(run: Path, inputs: TrainInputs) -> int | None:
    """Return the frame whose scan the template was built from; None for a scan from outside the capture."""
    built = load_build(run)
    if built is None or not lies_in(built[0].scan_file, inputs.capture):
        return None
    return built[0].frame


def open_views(inputs: TrainInputs) -> Capture:
    """Open the capture at the scale that is asked for, its splits with the cameras that are held out.

    Raises:
        InputError: unknown cameras, none, or none to train on; a scale out of range.
    """
    body = None if inputs.body is None else load_body(inputs.body)
    capture = open_capture(inputs.capture, params=inputs.params, body=body, protocol=inputs.protocol)
    capture = hold_out_cameras(capture, inputs.hold_out)
    if not 0.0 < inputs.scale <= 1.0:
        raise InputError("option scale", expected="a number above 0 and at most 1", received=f"{inputs.scale:g}")
    return capture if inputs.scale == 1.0 else capture.resized(inputs.scale)


def preview_writer(capture: Capture, folder: Path) -> Callable[[Mapping[str, np.ndarray]], None]:
    """Return what writes photograph, rendering and error of measured views to `folder/previews/CAM_FFFFFF.png`."""
    background = capture.recording.background or (0.0, 0.0, 0.0)

    def write(images: Mapping[str, np.ndarray]) -> None:
        for name, image in images.items():
            camera, frame = name.rsplit(" ", 1)
            real = read_view(capture, camera, int(frame)).photograph(background)
            write_strip(folder / "previews" / f"{camera}_{int(frame):06d}.png", real, image)

    return write
