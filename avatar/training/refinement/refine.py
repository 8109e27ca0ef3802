"""Poses of a capture's frames refined on the photographs of its training cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64

from avatar.data.sequence import AvatarSequence
from avatar.data.views import View, read_view
from avatar.gaussians.binding import BoundGaussians
from avatar.training.fit.initial_colors import initial_gaussians
from avatar.training.refinement.align import Alignment, PassReport, Scene
from avatar.training.refinement.cameras import CameraCorrections
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.evidence import Photometer
from avatar.training.refinement.firmness import firmness
from avatar.training.refinement.posing import PosedTemplate
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import rotvec_from_matrix
from smplxpp.core.validation import require_known
from smplxpp.register import BodyState


@dataclass(frozen=True, eq=False)
class Refinement:
    """What a refinement gives.

    Attributes:
        frames: that were refined, ascending.
        start, params: their parameters before and after, a row a frame; the shape is the start's, hands are complete.
        before, after: loss of every frame with the final colours, 0 to 1 (`Photometer.firm_loss`).
        turned: degrees that each of the joints has turned, `joints` their names. moved: millimetres of translation.
        kept: frames that keep their start, which the photographs like better.
        gaussians: with the colours that were learned, on the CPU.
        cameras: corrected `cam_from_world` by name; empty where cameras were taken for right.
        history: what the passes saw.
    """

    frames: tuple[int, ...]
    start: BodyParams
    params: BodyParams
    before: Float64[np.ndarray, " F"]
    after: Float64[np.ndarray, " F"]
    turned: Float64[np.ndarray, "F K"]
    joints: tuple[str, ...]
    moved: Float64[np.ndarray, " F"]
    kept: tuple[int, ...]
    gaussians: BoundGaussians
    cameras: dict[str, Float64[np.ndarray, "4 4"]]
    history: tuple[PassReport, ...]


def refine_poses(
    sequence: AvatarSequence,
    config: RefineConfig | None = None,
    *,
    reference: int | None = None,
    frames: Sequence[int] | None = None,
    progress: ProgressCallback = ignore_progress,
) -> Refinement:
    """Refine training frames: the reference frame first, then all together, with the colours of the Gaussians.

    Only training cameras are looked at. The shape of the body is the template's and stays. A frame whose photographs
    like its start better keeps it. All is computed on the CPU, whatever the sequence's device.

    Args:
        sequence: whose parameters are the registered start; its images are read at full size.
        reference: frame that colours start from, None: the first. frames: some of the training frames, None: all.
        progress: called with the share of the frames' evaluations that are done.

    Raises:
        InputError: frames that are not trained on, or a frame without parameters or photographs.
    """
    config = config or RefineConfig()
    chosen = tuple(sorted(sequence.train_frames if frames is None else frames))
    first = chosen[0] if reference is None else reference
    _require_training(sequence, (*chosen, first))
    scene = _scene(sequence, config)
    start, reference_start = _start(sequence, chosen), _start(sequence, (first,))
    posed = scene.posed
    vertices = posed.place(_state(posed, reference_start), 0).vertices.detach().double().numpy()
    whole = [read_view(sequence.capture, name, first) for name in _cameras(sequence, first)]
    sampling = replace(config.sampling, seed=config.seed)
    gaussians = initial_gaussians(sequence.rig, vertices, whole, sampling).to(device="cpu")
    counter = _EvaluationCounter(progress, config, len(chosen))
    view = _training_views(sequence)
    begun = Alignment(scene, gaussians, (first,), _state(posed, reference_start), view)
    begun.run(config.reference_levels, counter.step)
    if scene.cameras is not None:  # one frame says too little of cameras: they begin anew with all
        scene = replace(scene, cameras=_corrections(sequence, config))
    return _finish(Alignment(scene, begun.gaussians, chosen, _state(posed, start), view), start, sequence, counter)


def refine_held_out(
    sequence: AvatarSequence,
    gaussians: BoundGaussians,
    config: RefineConfig | None = None,
    *,
    frames: Sequence[int] | None = None,
    progress: ProgressCallback = ignore_progress,
) -> Refinement:
    """Refine held-out frames on the photographs of training cameras, everything but their poses as it is.

    Not for driving: whoever drives an avatar with a new motion has no photographs of it. An evaluation can tell with it
    what poses cost and what the model costs.

    Args:
        gaussians: with the colours of a refinement of training frames, on the CPU.
        frames: some held-out frames, None: all.

    Raises:
        InputError: frames that are not held out, none, or one without parameters or photographs.
    """
    config = replace(config or RefineConfig(), cameras=False)
    held_out = sequence.capture.splits.novel_pose_frames
    chosen = tuple(sorted(held_out if frames is None else frames))
    require_known("frames to refine as held out", chosen, held_out)
    if not chosen:
        raise InputError(f"capture {sequence.capture.name}", expected="held-out frames", received="none")
    scene, start = _scene(sequence, config), _start(sequence, chosen)
    view = _training_views(sequence)
    alignment = Alignment(scene, gaussians, chosen, _state(scene.posed, start), view, learns_appearance=False)
    counter = _EvaluationCounter(progress, replace(config, reference_levels=()), len(chosen))
    return _finish(alignment, start, sequence, counter)


class _EvaluationCounter:
    """Counts the frames that passes have evaluated, and reports their share."""

    def __init__(self, progress: ProgressCallback, config: RefineConfig, frames: int) -> None:
        self._progress, self._done = progress, 0
        self._total = sum(level.steps + 1 for level in config.reference_levels)
        self._total += frames * (2 + sum(level.steps + 1 for level in config.levels))

    def step(self) -> None:
        """Report one more evaluation of a frame."""
        self._done += 1
        self._progress("poses", self._done / self._total)


def _finish(
    alignment: Alignment, start: BodyParams, sequence: AvatarSequence, counter: _EvaluationCounter
) -> Refinement:
    """Run an alignment, compare what came out with the start, and keep the better of both."""
    scene, frames = alignment.scene, alignment.frames
    alignment.run(scene.config.levels, counter.step)
    before = alignment.losses(alignment.start, counter.step)
    after = alignment.losses(alignment.state, counter.step)
    worse = ~(after < before)
    body = scene.posed.body
    refined = alignment.state.to_params(body, fps=start.fps)
    complete = alignment.start.to_params(body, fps=start.fps)
    rows = [(complete if bad else refined).frame(row) for row, bad in enumerate(worse)]
    params = replace(BodyParams.concatenate(rows), betas=start.betas)
    variables = alignment.variables
    change = rotvec_from_matrix(alignment.state.rotations @ alignment.start.rotations.swapaxes(-1, -2))
    turned = np.degrees(np.linalg.norm(change[:, variables.joints], axis=-1))
    moved = 1e3 * np.linalg.norm(alignment.state.transl - alignment.start.transl, axis=-1)
    truth = {name: sequence.capture.cameras[name].cam_from_world for name in sequence.train_cameras}
    return Refinement(
        frames=frames,
        start=replace(complete, betas=start.betas),
        params=params,
        before=before,
        after=np.where(worse, before, after),
        turned=np.where(worse[:, None], 0.0, turned),
        joints=tuple(body.joint_names[k] for k in variables.joints),
        moved=np.where(worse, 0.0, moved),
        kept=tuple(frame for frame, bad in zip(frames, worse, strict=True) if bad),
        gaussians=alignment.gaussians,
        cameras={} if scene.cameras is None else scene.cameras.poses(truth),
        history=tuple(alignment.history),
    )


def _require_training(sequence: AvatarSequence, frames: Sequence[int]) -> None:
    other = sorted(set(frames) - set(sequence.train_frames))
    if other:
        raise InputError(
            "frames to refine",
            expected="frames that are trained on",
            received=f"frame {other[0]}",
            remedy="held-out frames keep their registered poses; refine_held_out refines them apart",
        )


def _scene(sequence: AvatarSequence, config: RefineConfig) -> Scene:
    template = sequence.rig.template
    posed = PosedTemplate(template, firmness(template, config.reach))
    photometer = Photometer(posed.faces, sequence.background.cpu(), config)
    cameras = _corrections(sequence, config) if config.cameras else None
    return Scene(posed, photometer, config, cameras, sequence.capture.fps)


def _corrections(sequence: AvatarSequence, config: RefineConfig) -> CameraCorrections:
    return CameraCorrections(sequence.train_cameras, sequence.person_center().astype(np.float64), config)


def _start(sequence: AvatarSequence, frames: Sequence[int]) -> BodyParams:
    """The registered parameters of frames."""
    return BodyParams.concatenate([sequence.params(frame) for frame in frames])


def _state(posed: PosedTemplate, params: BodyParams) -> BodyState:
    return BodyState.of_params(posed.body, params)


def _cameras(sequence: AvatarSequence, frame: int) -> list[str]:
    """Training cameras that have an image of a frame."""
    names = [name for name in sequence.train_cameras if sequence.capture.file(name, frame) is not None]
    if not names:
        raise InputError(f"frame {frame}", expected="an image of a training camera", received="none")
    return names


def _training_views(sequence: AvatarSequence) -> Callable[[int], list[View]]:
    """Reads the views of a frame by training cameras, cut to the person; those of nobody are left out."""

    def read(frame: int) -> list[View]:
        views = (read_view(sequence.capture, name, frame) for name in _cameras(sequence, frame))
        return [view.cropped(sequence.config.margin) for view in views if torch.any(view.alpha)]

    return read
