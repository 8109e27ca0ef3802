"""Refine the poses of a sequence on the photographs of its training cameras: training frames, and held-out frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from avatar.data.sequence import AvatarSequence
from avatar.data.views import View, read_view
from avatar.gaussians.binding import BoundGaussians
from avatar.training.fit.initial_gaussians import initial_gaussians
from avatar.training.refinement.align import Alignment, PassReport, Scene
from avatar.training.refinement.board import Board
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.nuisance import CameraCorrections
from avatar.training.refinement.photometric import PhotometricLoss
from avatar.training.refinement.posing import PosedTemplate, rigidity
from smplxpp.core import BodyParams, InputError, ProgressCallback, ignore_progress, require_known, rotvec_from_matrix
from smplxpp.native import thread_count
from smplxpp.register import BodyState


@dataclass(frozen=True, eq=False)
class Refinement:
    """Refined poses of frames with their figures.

    Attributes:
        frames: numbers of the refined frames, ascending.
        start: parameters before, a row a frame, with complete hands.
        params: parameters after, a row a frame; the shape is the start's.
        before: loss of every frame at the start, with the final colours, in [0, 1] (`PhotometricLoss.rigid_loss`).
        after: loss of every frame after the refinement.
        turned: rotation of each joint, degrees.
        joints: names of those joints.
        moved: translation, millimetres.
        kept: frames that keep their start, because their photographs fit it better.
        gaussians: with the learned colours and depths, on the CPU.
        cameras: corrected `cam_from_world` by name; empty where cameras were not corrected.
        history: figures of the passes.
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
    state: Path | None = None,
    progress: ProgressCallback = ignore_progress,
    stop: Callable[[], bool] = lambda: False,
) -> Refinement:
    """Refine training frames: the reference frame first, then all together, with the colours of the Gaussians.

    Only images of training cameras are read. The body's shape is the template's and stays. A frame whose photographs
    fit its start better keeps the start. Pictures are drawn and compared on the sequence's device, and all else is
    computed on the CPU.

    Args:
        sequence: its parameters are the registered start; its images are read at full size.
        config: of the refinement; None: the defaults.
        reference: frame that colours start from; None: the first.
        frames: some of the training frames; None: all.
        state: file that is written after every pass over the frames. Where it exists, the same call continues from it.
            Any number of processes that make this call at the same time share the chunks of `chunk_frames` frames in
            a folder beside it, and get the same bits as one.
        progress: called with the finished share of the frames' evaluations.
        stop: asked after every pass and every chunk.

    Raises:
        InputError: frames that are not training frames, or a frame without parameters or photographs.
        RefinementStoppedError: `stop` returned True; the same call continues.
    """
    config = config or RefineConfig()
    chosen = tuple(sorted(sequence.train_frames if frames is None else frames))
    first = chosen[0] if reference is None else reference
    _require_training(sequence, (*chosen, first))
    scene = _scene(sequence, config)
    start, reference_start = _start(sequence, chosen), _start(sequence, (first,))
    # Colours of the Gaussians from the photographs of the reference frame in its registered pose.
    posed = scene.posed
    vertices = posed.place(_state(posed, reference_start), 0).vertices.detach().double().numpy()
    whole = [read_view(sequence.capture, name, first) for name in _cameras(sequence, first)]
    sampling = replace(config.sampling, seed=config.seed)
    gaussians = initial_gaussians(sequence.rig, vertices, whole, sampling).to(device="cpu")
    # Refine the reference frame alone, which sharpens the colours.
    counter = _EvaluationCounter(progress, config, len(chosen))
    view = _training_views(sequence)
    board = _board(state, stop)
    if state is None or not state.is_file():

        def alone(chunk: int) -> dict[str, np.ndarray]:
            one = Alignment(scene, gaussians, (first,), _state(posed, reference_start), view)
            one.run(config.reference_levels, counter.step)
            return {"dc": one.gaussians.dc.numpy(), "normal_offset": one.gaussians.normal_offset.numpy()}

        # The number of threads would show in the bits, so that all processes take what one has computed.
        shared = board is not None and len(chosen) > config.chunk_frames
        learned = board.gather("reference", 1, alone)[0] if board is not None and shared else alone(0)
        dc, depth = (torch.from_numpy(learned[name]) for name in ("dc", "normal_offset"))
        gaussians = replace(gaussians, dc=dc, normal_offset=depth)
    else:
        for _ in range(sum(level.steps + 1 for level in config.reference_levels)):
            counter.step()
    # One frame determines cameras poorly: their corrections start from zero again with all frames.
    if scene.cameras is not None:
        scene = replace(scene, cameras=_corrections(sequence, config))
    # Refine all frames together.
    together = Alignment(scene, gaussians, chosen, _state(posed, start), view, board=board)
    return _finish(together, start, sequence, counter, state, stop)


def refine_held_out(
    sequence: AvatarSequence,
    gaussians: BoundGaussians,
    config: RefineConfig | None = None,
    *,
    frames: Sequence[int] | None = None,
    state: Path | None = None,
    progress: ProgressCallback = ignore_progress,
    stop: Callable[[], bool] = lambda: False,
) -> Refinement:
    """Refine the poses of held-out frames on the photographs of training cameras; everything else stays.

    For evaluations alone: with these poses they separate the error of the poses from that of the model. An avatar that
    is driven by a new motion has no photographs of it.

    Args:
        sequence: its parameters are the registered start.
        gaussians: with the colours of a refinement of training frames, on the CPU.
        config: of the refinement; None: the defaults. Cameras are not corrected.
        frames: some held-out frames; None: all.
        state: as of `refine_poses`.
        progress: called with the finished share of the frames' evaluations.
        stop: as of `refine_poses`.

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
    alignment = Alignment(
        scene, gaussians, chosen, _state(scene.posed, start), view, learns_appearance=False, board=_board(state, stop)
    )
    counter = _EvaluationCounter(progress, replace(config, reference_levels=()), len(chosen))
    return _finish(alignment, start, sequence, counter, state, stop)


def _board(state: Path | None, stop: Callable[[], bool]) -> Board | None:
    """Return the folder beside a state in which processes share chunks."""
    return None if state is None else Board(state.with_suffix(""), stop)


class _EvaluationCounter:
    """Counts evaluations of frames and reports their finished share."""

    def __init__(self, progress: ProgressCallback, config: RefineConfig, frames: int) -> None:
        self._progress, self._done = progress, 0
        self._total = sum(level.steps + 1 for level in config.reference_levels)
        self._total += frames * (2 + sum(level.steps + 1 for level in config.levels))

    def step(self) -> None:
        """Report one more evaluation of a frame."""
        self._done += 1
        self._progress("poses", self._done / self._total)


def _finish(
    alignment: Alignment,
    start: BodyParams,
    sequence: AvatarSequence,
    counter: _EvaluationCounter,
    state: Path | None,
    stop: Callable[[], bool],
) -> Refinement:
    """Run an alignment of all frames, and keep for each frame the better of its start and its result."""
    scene, frames = alignment.scene, alignment.frames
    alignment.run(scene.config.levels, counter.step, file=state, stop=stop)
    # Losses of start and result with the same, final colours.
    before = alignment.losses(alignment.start, counter.step, name="before")
    after = alignment.losses(alignment.state, counter.step, name="after")
    # Frames that did not improve keep the start.
    worse = ~(after < before)
    # Parameters of the better ones.
    body = scene.posed.body
    refined = alignment.state.to_params(body, fps=start.fps)
    complete = alignment.start.to_params(body, fps=start.fps)
    # A row a frame; betas are not refined, so they are the start's.
    rows = [(complete if bad else refined).frame(row) for row, bad in enumerate(worse)]
    params = replace(BodyParams.concatenate(rows), betas=start.betas)
    # Figures: degrees a joint and millimetres.
    variables = alignment.variables
    change = rotvec_from_matrix(alignment.state.rotations @ alignment.start.rotations.swapaxes(-1, -2))
    turned = np.degrees(np.linalg.norm(change[:, variables.joints], axis=-1))
    moved = 1e3 * np.linalg.norm(alignment.state.transl - alignment.start.transl, axis=-1)
    # Corrected poses of the cameras, from those of the capture.
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
            remedy="held-out frames keep their registered poses; refine_held_out refines them separately",
        )


def _scene(sequence: AvatarSequence, config: RefineConfig) -> Scene:
    template = sequence.rig.template
    posed = PosedTemplate(template, rigidity(template, config.reach))
    photometric = PhotometricLoss(posed.faces, sequence.background, config)
    cameras = _corrections(sequence, config) if config.cameras else None
    return Scene(posed, photometric, config, cameras, sequence.capture.fps)


def _corrections(sequence: AvatarSequence, config: RefineConfig) -> CameraCorrections:
    return CameraCorrections(sequence.train_cameras, sequence.person_center().astype(np.float64), config)


def _start(sequence: AvatarSequence, frames: Sequence[int]) -> BodyParams:
    """Return the registered parameters of frames, a row each."""
    return BodyParams.concatenate([sequence.params(frame) for frame in frames])


def _state(posed: PosedTemplate, params: BodyParams) -> BodyState:
    return BodyState.of_params(posed.body, params)


def _cameras(sequence: AvatarSequence, frame: int) -> list[str]:
    """Return the training cameras that have an image of a frame."""
    names = [name for name in sequence.train_cameras if sequence.capture.file(name, frame) is not None]
    if not names:
        raise InputError(f"frame {frame}", expected="an image of a training camera", received="none")
    return names


def _training_views(sequence: AvatarSequence) -> Callable[[int], list[View]]:
    """Return a reader of a frame's views by training cameras, cut to the person; empty masks are left out."""
    # A CPU has other frames to compute meanwhile; a GPU would wait for one photograph after the other.
    on_gpu = sequence.background.device.type != "cpu"
    threads = ThreadPoolExecutor(thread_count(sequence.config.readers), "photographs") if on_gpu else None

    def read(frame: int) -> list[View]:
        def one(name: str) -> View | None:
            view = read_view(sequence.capture, name, frame)
            return view.cropped(sequence.config.margin) if torch.any(view.alpha) else None

        views = (threads.map if threads else map)(one, _cameras(sequence, frame))
        return [view for view in views if view is not None]

    return read
