"""The tracker: Adam on one frame's control points at a time, outwards from the reference frame, from coarse to fine.

The loss, its terms and the schedule are described in `avatar.training.tracking`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.data.views import View
from avatar.gaussians.tensor_file import require_finite, require_like
from avatar.models.tracked_surface import ControlCage, Track, TrackedAvatar
from avatar.rendering.mesh_maps import vertex_normals
from avatar.training.engine.adam import ParameterGroup
from avatar.training.engine.photometric_task import ALONE, PhotometricConfig, PhotometricTask, TaskContext
from avatar.training.tracking.cloth_prediction import ClothPrediction, Observed, simulate_controls
from avatar.training.tracking.config import Level, TrackConfig
from avatar.training.tracking.track_uncertainty import expected_errors, structure_tensors, unobserved_weight
from smplxpp.core import DEFAULT_FPS, InputError

LEVEL_DECAY = 0.1
"""Learning rate at the end of a level, as a fraction of that at its start."""


@dataclass(frozen=True, eq=False)
class FramePriors:
    """Priors of a frame's displacements before its photographs are used, metres along the axes of the T-pose.

    Attributes:
        start: displacements at which the optimisation starts.
        rest_shape: displacements about which the frame's are smooth.
        anchor: centre of the Gaussian prior.
        weight: of the prior in every direction, see `unobserved_weight`.
    """

    start: Float[Tensor, "K 3"]
    rest_shape: Float[Tensor, "K 3"]
    anchor: Float[Tensor, "K 3"]
    weight: Float[Tensor, "K 3 3"]


@dataclass(frozen=True, eq=False)
class FramesApart:
    """Frames that one task solves apart from the others: a segment of the motion, or the backward pass.

    Attributes:
        order: the frames in the order in which they are solved.
        prediction: of their displacements.
        known: displacements and structure tensors of frames that were solved before, in their order.
    """

    order: Sequence[int]
    prediction: ClothPrediction
    known: Mapping[int, tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3 3"]]] = field(default_factory=dict)


class TrackTask(PhotometricTask):
    """Tracks frame after frame: each starts from predictions of its nearest solved neighbours and takes all levels.

    Args:
        sequence: the training frames and views.
        avatar: the Gaussians on control points.
        config: of the tracking.
        context: of the training.
        apart: some of the frames; None: all training frames, outwards from the reference frame.

    Raises:
        InputError: a reference frame that is not a training frame.
    """

    sequence: AvatarSequence

    def __init__(
        self,
        sequence: AvatarSequence,
        avatar: TrackedAvatar,
        config: TrackConfig,
        context: TaskContext = ALONE,
        *,
        apart: FramesApart | None = None,
    ) -> None:
        frames = sequence.train_frames
        if config.reference is not None and config.reference not in frames:
            raise InputError(
                "tracking: reference", expected="a training frame, or None", received=f"frame {config.reference}"
            )
        self.order = outwards(frames, config) if apart is None else list(apart.order)
        self.known = () if apart is None else tuple(apart.known)
        self.row = {frame: row for row, frame in enumerate(sorted({*self.known, *self.order}))}
        # One optimiser run over all frames: `steps` iterations each. `lr_factor` is the rate itself, so that lr is 1.
        shared = PhotometricConfig(
            iterations=len(self.order) * config.steps,
            views=config.views,
            weights=config.weights,
            seed=config.seed,
            betas=(0.8, 0.95),
            evaluations=1,
        )
        super().__init__(
            sequence, avatar, shared, [ParameterGroup("track", {"controls": avatar.controls}, 1.0)], context
        )
        self.avatar, self.track_config = avatar, config
        self.prediction = _prediction(sequence, avatar.cage, config) if apart is None else apart.prediction
        self._priors: tuple[int, FramePriors] | None = None
        self._halved_views: tuple[int, dict[tuple[str, int], View]] = (-1, {})
        self._projections: dict[int, Tensor] = {}  # by row, see `_observed`
        # Results: displacements and structure tensors of all frames, a row each.
        self.solved = torch.zeros(len(self.row), avatar.cage.count, 3, device=sequence.device)
        self.structure = torch.zeros(len(self.row), avatar.cage.count, 3, 3, device=sequence.device)
        self._unit = torch.eye(3, device=sequence.device)
        rig = sequence.rig
        self._normals = vertex_normals(rig.vertices, rig.faces)[avatar.cage.vertices]
        self.take({} if apart is None else apart.known)

    def micro_batches(self, iteration: int) -> Sequence[Item]:
        """Return the frame that is being tracked, with the cameras of this step."""
        self.iteration = iteration
        # Iterations count through the frames: each has the steps of all levels. The next step's photographs load
        # ahead.
        place, step = divmod(iteration, self.track_config.steps)
        now = self._item(place, step)
        if iteration + 1 < self.config.iterations:
            self.sequence.expect([self._item(*divmod(iteration + 1, self.track_config.steps))])
        return [now]

    def _item(self, place: int, step: int) -> Item:
        frame = self.order[place]
        return Item(frame, self.sequence.cameras(frame, step, self.track_config.views, self.track_config.seed))

    def lr_factor(self, iteration: int, group: ParameterGroup) -> float:
        """Return the learning rate: it starts at the level's and falls exponentially within it."""
        # From 1 at the level's first step towards LEVEL_DECAY at its end, times the level's own rate.
        level, step = self._level(iteration)
        return level.lr * LEVEL_DECAY ** (step / level.steps)

    def _level(self, iteration: int) -> tuple[Level, int]:
        """Return the level of a step, and the step's number within it."""
        step = iteration % self.track_config.steps
        for level in self.track_config.levels:
            if step < level.steps:
                return level, step
            step -= level.steps
        raise AssertionError("steps are those of the levels")

    def views(self, item: Item) -> list[View]:
        """Return the photographs at the level's size; halved ones are cached while the frame is tracked."""
        halvings = self._level(self.iteration)[0].halvings
        return [self._halved(view, item.frame, halvings) for view in super().views(item)]

    def _halved(self, view: View, frame: int, times: int) -> View:
        """Return the view at half its size, `times` times; halved views of the current frame are cached."""
        if self._halved_views[0] != frame:
            self._halved_views = (frame, {})
        cached = self._halved_views[1]
        if not times:
            return view
        if (view.name, times) not in cached:
            cached[view.name, times] = self._halved(view, frame, times - 1).halved()
        return cached[view.name, times]

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the loss of a frame and its terms; see `avatar.training.tracking` for the equation."""
        views = self.views(item)
        posed = self.avatar(self.sequence.pose(item.frame), camera_centers_of(views))
        # Photometric loss L_rec.
        total, terms, _ = self.compared(posed, views)
        cage, controls = self.avatar.cage, self.avatar.controls
        priors = self.priors(item.frame)
        # Smoothness of the difference from the predicted shape.
        total = total + self.track_config.smoothness * cage.roughness(controls - priors.rest_shape)
        # Strain of the clothes whose lengths at rest are known.
        simulated = self.prediction.simulated
        if self.track_config.strain_weight and simulated is not None and simulated.edges is not None:
            total = total + self.track_config.strain_weight * simulated.edges.strain(posed.vertices)
        # Gaussian prior about the anchor, in the directions that photographs do not determine.
        if self.track_config.prior_weight:
            off = controls - priors.anchor
            squared = torch.einsum("ki,kij,kj->k", off, priors.weight, off).mean()
            total = total + self.track_config.prior_weight * squared
        # Robust penalty of motion off the clothes and of clothes near the skin.
        if self.track_config.body_motion_weight and not cage.off_clothes.all():
            left = cage.motion_off_clothes(controls, reach=self.track_config.tight_reach)
            total = total + self.track_config.body_motion_weight * left
        return total, {"loss": total.detach(), **terms}

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Take one step of the current frame; its first step sets the start and clears the optimiser's moments."""
        # A new frame starts from its priors, with Adam's moments cleared.
        place, step = divmod(iteration, self.track_config.steps)
        if step == 0:
            with torch.no_grad():
                self.avatar.controls.copy_(self.priors(self.order[place]).start)
            self.optimiser.state.clear()
        metrics = super().step(iteration)
        with torch.no_grad():
            self.solved[self.row[self.order[place]]] = self.avatar.controls
        return metrics

    def priors(self, frame: int) -> FramePriors:
        """Return the priors of a frame, computed once; the frame's structure tensors are stored with them."""
        if self._priors is None or self._priors[0] != frame:
            self._priors = (frame, self._compute_priors(frame))
        return self._priors[1]

    def _compute_priors(self, frame: int) -> FramePriors:
        # Solved frames, with the directions that photographs determined there.
        solved: dict[int, tuple[Tensor, Observed | None]] = {}
        for other in (*self.known, *self.order[: self.order.index(frame)]):
            row = self.row[other]
            solved[other] = (self.solved[row], partial(self._observed, row))
        # Structure tensors of this frame are taken about its predicted start, where its photographs are compared
        # first.
        start = self.prediction.start(frame, solved) if solved else torch.zeros_like(self.avatar.controls)
        own = self.structure[self.row[frame]]
        own.copy_(self._structure(frame, start))
        if not solved:
            return FramePriors(start, start, start, torch.zeros_like(own))
        # The prior acts on simulated clothes alone: it would hold other swinging cloth where skinning has it.
        weight = self.prediction.share * unobserved_weight(own, self._normals)
        anchor = self.prediction.anchor(frame, solved)
        # Start at the anchor in the directions that photographs do not determine.
        start = start + torch.einsum("kij,kj->ki", weight, anchor - start)
        # Simulated clothes are smooth about the anchor. About what a simulation alone predicts smoothness would hold a
        # swing back; what is not simulated is smooth about skinning, without memory of the frames before.
        rest_shape = (self.prediction.share * anchor[..., None])[..., 0]
        return FramePriors(start, rest_shape, anchor, weight)

    def _observed(self, row: int) -> Tensor:
        """Return the projection I - W on the directions that a solved frame's photographs determined."""
        # Of many frames a predictor asks for the last few, several times each.
        kept_frames = 8
        if row not in self._projections:
            while len(self._projections) >= kept_frames:
                self._projections.pop(next(iter(self._projections)))
            self._projections[row] = self._unit - unobserved_weight(self.structure[row], self._normals)
        return self._projections[row]

    def _structure(self, frame: int, controls: Tensor) -> Tensor:
        """Return the structure tensors of a frame's photographs by all training cameras, about given displacements."""
        # Halvings of the photographs of which structure tensors are taken, or the nearest number that a
        # level has.
        structure_halvings = 1
        # Use photographs of a size that the levels load anyway.
        sizes = [level.halvings for level in self.track_config.levels]
        halvings = min(sizes, key=lambda size: abs(size - structure_halvings))
        names = self.sequence.cameras(frame, 0, len(self.sequence.train_cameras), self.track_config.seed)
        views = [self._halved(self.sequence.view(name, frame), frame, halvings) for name in names]
        pose, background = self.sequence.pose(frame), self.sequence.background
        return structure_tensors(self.avatar, controls, pose, views, background, halvings=halvings)

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return no figures, because the control points fit one frame alone."""
        return {"mean": {}}

    def state(self) -> Mapping[str, Tensor]:
        """Return the optimiser's state with the displacements and structure tensors of all frames."""
        return {**super().state(), **self.found()}

    def found(self) -> dict[str, Tensor]:
        """Return displacements (T, K, 3) and structure tensors (T, K, 3, 3); rows in the order of training frames."""
        return {"solved": self.solved, "structure": self.structure}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from a `state`, after checks of its shapes and numbers."""
        require_like(tensors, self.found(), subject="checkpoint")
        require_finite({name: tensors[name] for name in self.found()}, subject="checkpoint")
        super().restore(tensors)
        for name, own in self.found().items():
            own.copy_(tensors[name])
        self._priors, self._projections = None, {}

    def found_in(self, frames: Sequence[int]) -> dict[int, tuple[Tensor, Tensor]]:
        """Return displacements (K, 3) and structure tensors (K, 3, 3) of frames."""
        return {frame: (self.solved[self.row[frame]], self.structure[self.row[frame]]) for frame in frames}

    def take(self, found: Mapping[int, tuple[Tensor, Tensor]]) -> None:
        """Take up displacements and structure tensors of frames that other tasks have solved."""
        for frame, (solved, structure) in found.items():
            self.solved[self.row[frame]], self.structure[self.row[frame]] = solved, structure

    def backward(self) -> FramesApart:
        """Return the frames from the last ones, whose displacements are taken over, back to the reference frame."""
        frames, first, reference = self.sequence.train_frames, self.order[0], self.track_config.reference
        ends = tuple(sorted({frames[0], frames[-1]} - {first}))
        # The displacements of the reference frame are known, and the backward pass ends there.
        offset = None if reference is None else self.solved[self.row[reference]]
        prediction = self.prediction if offset is None else replace(self.prediction, offset=offset)
        order = [frame for frame in reversed(self.order) if frame not in ends]
        return FramesApart(order, prediction, self.found_in(ends))

    def track(self) -> Track:
        """Return the tracked surface: displacements relative to the reference frame's, and their expected errors.

        In the reference frame the template is the surface. Displacements found there are an error of the Gaussians,
        the same in all frames, and are subtracted.
        """
        # Subtract the error of the Gaussians, which the reference frame shows.
        solved = self.solved.clone()
        if self.track_config.reference is not None:
            solved -= self.solved[self.row[self.track_config.reference]]
        return Track(self.row, solved, self.avatar.cage, self._sigma(solved))

    def _sigma(self, solved: Tensor) -> Tensor:
        """Return the expected error (T, K) of displacements, metres, by the Kalman filter of `expected_errors`."""
        # The filter runs in the order in which the frames were solved.
        structure = {frame: self.structure[self.row[frame]] for frame in self.order}
        seconds, known = 1.0 / (self.sequence.capture.fps or DEFAULT_FPS), self.track_config.reference is not None
        # (K,) RMS displacement over the frames, to which the expected error of an unobserved point tends.
        moved = solved.square().sum(-1).mean(0).sqrt()
        found = expected_errors(self.order, seconds, structure, moved, known=known)
        return torch.stack([found[frame] for frame in self.row])

    def drift(self, back: TrackTask) -> Tensor:
        """Return the round-trip error (K,), metres: distance of the backward pass's end from the forward start."""
        frames = self.sequence.train_frames
        row = self.row[frames[0] if self.track_config.reference is None else self.track_config.reference]
        return (back.solved[row] - self.solved[row]).norm(dim=-1)


def outwards(frames: Sequence[int], config: TrackConfig) -> list[int]:
    """Return the training frames in the order in which they are solved: outwards from the reference frame."""
    first = frames[0] if config.reference is None else config.reference
    return sorted(frames, key=lambda frame: (abs(frame - first), frame))


def _prediction(sequence: AvatarSequence, cage: ControlCage, config: TrackConfig) -> ClothPrediction:
    """Return the predictor, with simulated clothes where the configuration and the capture allow them."""
    # A simulation needs time between frames, and a reference frame in which the garment's shape is known.
    simulated, fps = None, sequence.capture.fps
    if config.simulate and config.reference is not None and fps is not None:
        poses = {frame: sequence.params(frame) for frame in sequence.train_frames}
        reference = poses[config.reference].without_shape()
        simulated = simulate_controls(sequence.rig.template, poses, fps, reference=reference, controls=cage.vertices)
    return ClothPrediction(config.extrapolation, simulated, config.reference, fps=fps or DEFAULT_FPS)
