"""Following the surface: displacements of every training frame, found one after the other from coarse to fine.

Cloth that swings moves by many pixels, and a pattern repeats within few: gradients of images lead a network that learns
all frames at once into the wrong stripe. From one frame to the next the way is short.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.tensor_file import require_finite, require_like
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.tracked_surface import ControlCage, Track, TrackedAvatar
from avatar.training.engine.loop import Progress
from avatar.training.engine.optimization_task import ParameterGroup
from avatar.training.engine.photometric_task import ALONE, PhotometricConfig, PhotometricTask, TaskContext
from avatar.training.engine.processes import Distributed
from avatar.training.engine.session import Session
from avatar.training.tracking.foresight import Foresight, simulate_controls
from smplxpp.core.errors import InputError
from smplxpp.core.validation import require_at_least


@dataclass(frozen=True)
class Level:
    """A part of the steps of a frame.

    Attributes:
        halvings: of the images. steps: of Adam. lr: metres, at its first step; it falls to `LEVEL_END` of that.
    """

    halvings: int
    steps: int
    lr: float


LEVEL_END = 0.1


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Choices of the tracking.

    Attributes:
        levels: from coarse to fine. Stripes melt into one colour in coarse images, and silhouettes lead.
        control_points: on the template. views: cameras a step.
        smoothness: weight of the mean squared difference of neighbouring control points' displacements from the shape
            that is foreseen, a square metre.
        body_motion_weight: weight of the mean distance that control points off the clothes move, a metre:
            parameters say where the body is, and few pixels cannot tell better. Not applied to a template without
            clothes.
        still_body: the body's own surface follows its joints alone: poses say better where it is than photographs of a
            few hundred pixels do. Not applied to a template that is a body alone.
        tight_reach: metres from the skin, in the T-pose, within which clothes take part in that, the more the nearer:
            what lies on the body goes where the body goes. 0: no clothes do.
        extrapolation: share of the motion between the two frames before that a frame starts with.
        simulate: let simulated clothes say where frames start and what shape they are smooth about, the more the better
            they told the frames before; where `reference` and the capture's frames a second are known.
        weights: of the losses.
        reference: frame whose surface the template is, to begin with; None: no training frame's, and the first one
            comes first.
        seed: of the order of views.
    """

    levels: tuple[Level, ...] = (Level(2, 20, 5e-3), Level(1, 16, 4e-3), Level(0, 20, 2e-3))
    control_points: int = 2400
    views: int = 4
    smoothness: float = 80.0
    body_motion_weight: float = 0.0
    tight_reach: float = 0.0
    still_body: bool = False
    extrapolation: float = 1.0
    simulate: bool = True
    weights: ReconstructionWeights = field(
        default_factory=lambda: ReconstructionWeights(perceptual=0.0, normal=0.0, alpha=0.5)
    )
    reference: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.levels or any(level.steps < 1 or level.halvings < 0 or level.lr <= 0 for level in self.levels):
            raise InputError("tracking: levels", expected="one or more, each with steps", received=str(self.levels))
        for name, least in (
            ("control_points", 1),
            ("views", 1),
            ("smoothness", 0),
            ("body_motion_weight", 0),
            ("tight_reach", 0),
            ("extrapolation", 0),
        ):
            require_at_least(f"tracking: {name}", getattr(self, name), least)

    @property
    def steps(self) -> int:
        """Steps of one frame."""
        return sum(level.steps for level in self.levels)

    def shortened(self, share: float) -> TrackConfig:
        """Return the same with `share` of the steps of every level."""
        levels = tuple(replace(level, steps=max(1, round(share * level.steps))) for level in self.levels)
        return replace(self, levels=levels)


class TrackTask(PhotometricTask):
    """Every frame starts from its nearest neighbour that is done, and takes the steps of all levels."""

    sequence: AvatarSequence

    def __init__(
        self, sequence: AvatarSequence, avatar: TrackedAvatar, config: TrackConfig, context: TaskContext = ALONE
    ) -> None:
        frames = sequence.train_frames
        if config.reference is not None and config.reference not in frames:
            raise InputError(
                "tracking: reference", expected="a training frame, or None", received=f"frame {config.reference}"
            )
        first = frames[0] if config.reference is None else config.reference
        self.order = sorted(frames, key=lambda frame: (abs(frame - first), frame))
        self.row = {frame: row for row, frame in enumerate(frames)}
        shared = PhotometricConfig(
            iterations=len(frames) * config.steps,
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
        self.foresight = _foresight(sequence, avatar.cage, config)
        self._shapes: dict[int, Tensor] = {}
        self._small: tuple[int, dict[tuple[str, int], View]] = (-1, {})
        self.solved = torch.zeros(len(frames), avatar.cage.count, 3, device=sequence.device)

    def micro_batches(self, iteration: int) -> Sequence[Item]:
        """Return one frame, until its steps are done."""
        self.iteration = iteration
        place, step = divmod(iteration, self.track_config.steps)
        now = self._item(place, step)
        if iteration + 1 < self.config.iterations:
            self.sequence.expect([self._item(*divmod(iteration + 1, self.track_config.steps))])
        return [now]

    def _item(self, place: int, step: int) -> Item:
        frame = self.order[place]
        return Item(frame, self.sequence.cameras(frame, step, self.track_config.views, self.track_config.seed))

    def lr_factor(self, iteration: int, group: ParameterGroup) -> float:
        """Return the rate itself: the level's, falling exponentially."""
        level, step = self._level(iteration)
        return level.lr * LEVEL_END ** (step / level.steps)

    def _level(self, iteration: int) -> tuple[Level, int]:
        """Return the level of a step, and the step's number within it."""
        step = iteration % self.track_config.steps
        for level in self.track_config.levels:
            if step < level.steps:
                return level, step
            step -= level.steps
        raise AssertionError("steps are those of the levels")

    def views(self, item: Item) -> list[View]:
        """Return the photographs at the level's size; halved ones are kept while the frame is followed."""
        if self._small[0] != item.frame:
            self._small = (item.frame, {})
        halvings = self._level(self.iteration)[0].halvings
        return [self._halved(view, halvings) for view in super().views(item)]

    def _halved(self, view: View, times: int) -> View:
        kept = self._small[1]
        if not times:
            return view
        if (view.name, times) not in kept:
            kept[view.name, times] = self._halved(view, times - 1).halved()
        return kept[view.name, times]

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, float]]:
        """Return `L_rec` with the roughness of what is not foreseen and how far the body moves, and its terms."""
        views = self.views(item)
        posed = self.avatar(self.sequence.motion(item.frame), camera_centers_of(views))
        total, terms, _ = self.compared(posed, views)
        cage, controls = self.avatar.cage, self.avatar.controls
        total = total + self.track_config.smoothness * cage.roughness(controls - self._shape(item.frame))
        if self.track_config.body_motion_weight and not cage.off_clothes.all():
            left = cage.motion_off_clothes(controls, reach=self.track_config.tight_reach)
            total = total + self.track_config.body_motion_weight * left
        return total, {"loss": float(total.detach()), **terms}

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Take a step of the frame's; the first one leaves the frame before."""
        place, step = divmod(iteration, self.track_config.steps)
        if step == 0:
            with torch.no_grad():
                self.avatar.controls.copy_(self._start(place))
            self.optimiser.state.clear()
        metrics = super().step(iteration)
        with torch.no_grad():
            self.solved[self.row[self.order[place]]] = self.avatar.controls
        return metrics

    def _start(self, place: int) -> Tensor:
        """Displacements that a frame begins with: 0 in the first, what is foreseen in the others."""
        if place == 0:
            return torch.zeros_like(self.avatar.controls)
        return self.foresight.start(self.order[place], self._done(place))

    def _shape(self, frame: int) -> Tensor:
        """The shape that a frame's displacements are smooth about, kept while the frame is followed."""
        if frame not in self._shapes:
            place = self.order.index(frame)
            nothing = torch.zeros_like(self.avatar.controls)
            self._shapes = {frame: self.foresight.shape(frame, self._done(place)) if place else nothing}
        return self._shapes[frame]

    def _done(self, place: int) -> dict[int, Tensor]:
        """Displacements of the frames before a place in the order."""
        return {frame: self.solved[self.row[frame]] for frame in self.order[:place]}

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return nothing: the control points are those of one frame."""
        return {"mean": {}}

    def state(self) -> Mapping[str, Tensor]:
        """Return the frames that are done too."""
        return {**super().state(), "solved": self.solved}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `state` gave."""
        require_like(tensors, {"solved": self.solved}, subject="checkpoint")
        require_finite({"solved": tensors["solved"]}, subject="checkpoint")
        super().restore(tensors)
        self.solved.copy_(tensors["solved"])

    def track(self) -> Track:
        """Return what was found, less what was found in the reference frame.

        There the template is the surface: what images ask of it is an error of the Gaussians, in all frames alike.
        """
        solved = self.solved.clone()
        if self.track_config.reference is not None:
            solved -= self.solved[self.row[self.track_config.reference]]
        return Track(self.row, solved, self.avatar.cage)


def _foresight(sequence: AvatarSequence, cage: ControlCage, config: TrackConfig) -> Foresight:
    simulated, fps = None, sequence.capture.fps
    if config.simulate and config.reference is not None and fps is not None:
        poses = {frame: sequence.params(frame) for frame in sequence.train_frames}
        reference = poses[config.reference].without_shape()
        simulated = simulate_controls(sequence.rig.template, poses, fps, reference=reference, controls=cage.vertices)
    return Foresight(config.extrapolation, simulated, config.reference)


def follow_surface(
    sequence: AvatarSequence, gaussians: BoundGaussians, config: TrackConfig, session: Session
) -> tuple[Track, Progress]:
    """Find the displacements of every training frame, one frame after the other.

    Steps have one frame each: of several processes the first follows it, and the others hear what it found.
    """
    count = min(config.control_points, len(sequence.rig.vertices))
    avatar = TrackedAvatar(sequence.rig, gaussians, count, still_body=config.still_body)
    task = TrackTask(sequence, avatar, config, replace(session.context, distributed=None))
    progress = session.run_alone(lambda: task, task.config)
    processes = session.distributed or Distributed()
    task.solved.copy_(processes.run_on_rank0(lambda: task.solved.cpu()))
    return task.track(), progress
