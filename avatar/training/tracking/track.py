"""Following the surface: displacements of every training frame, found one after the other from coarse to fine.

Cloth that swings moves by many pixels, and a pattern repeats within few: gradients of images lead a network that learns
all frames at once into the wrong stripe. From one frame to the next the way is short.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.tensor_file import require_finite, require_like
from avatar.models.tracked_surface import ControlCage, Track, TrackedAvatar
from avatar.rendering.mesh_maps import vertex_normals
from avatar.training.engine.loop import Progress
from avatar.training.engine.optimization_task import ParameterGroup
from avatar.training.engine.photometric_task import ALONE, PhotometricConfig, PhotometricTask, TaskContext
from avatar.training.engine.processes import Distributed
from avatar.training.engine.session import BACK, Session
from avatar.training.tracking.certainty import expected_distances, held_directions
from avatar.training.tracking.config import LEVEL_END, Level, TrackConfig
from avatar.training.tracking.foresight import Foresight, simulate_controls
from avatar.training.tracking.structure import picture_structure
from smplxpp.core.errors import InputError
from smplxpp.core.params import DEFAULT_FPS

SEEN = 1
"""Halvings of the photographs, about, that say how much can be told."""


@dataclass(frozen=True, eq=False)
class Begin:
    """What a frame begins with, metres along the axes of the T-pose.

    Attributes:
        start: displacements. shape: those about which the frame's are smooth.
        anchor: those that the frame's are held to. held: how much of that stands, see `held_directions`.
    """

    start: Float[Tensor, "K 3"]
    shape: Float[Tensor, "K 3"]
    anchor: Float[Tensor, "K 3"]
    held: Float[Tensor, "K 3 3"]


class TrackTask(PhotometricTask):
    """Every frame starts from its nearest neighbour that is done, and takes the steps of all levels.

    Args:
        ahead: one that is done; the way back begins with what it found in the frames farthest from the first, and ends
            there.
    """

    sequence: AvatarSequence

    def __init__(
        self,
        sequence: AvatarSequence,
        avatar: TrackedAvatar,
        config: TrackConfig,
        context: TaskContext = ALONE,
        *,
        ahead: TrackTask | None = None,
    ) -> None:
        frames = sequence.train_frames
        if config.reference is not None and config.reference not in frames:
            raise InputError(
                "tracking: reference", expected="a training frame, or None", received=f"frame {config.reference}"
            )
        first = frames[0] if config.reference is None else config.reference
        self.order = sorted(frames, key=lambda frame: (abs(frame - first), frame))
        self.ends: tuple[int, ...] = ()
        if ahead is not None:
            self.ends = tuple(sorted({frames[0], frames[-1]} - {first}))
            self.order = [frame for frame in reversed(self.order) if frame not in self.ends]
        self.row = {frame: row for row, frame in enumerate(frames)}
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
        self.foresight = _foresight(sequence, avatar.cage, config) if ahead is None else ahead.foresight_known()
        self._begun: tuple[int, Begin] | None = None
        self._small: tuple[int, dict[tuple[str, int], View]] = (-1, {})
        self.solved = torch.zeros(len(frames), avatar.cage.count, 3, device=sequence.device)
        self.structure = torch.zeros(len(frames), avatar.cage.count, 3, 3, device=sequence.device)
        self._unit = torch.eye(3, device=sequence.device)
        rig = sequence.rig
        self._normals = vertex_normals(rig.vertices, rig.faces)[avatar.cage.vertices]
        for row in (self.row[frame] for frame in self.ends):
            assert ahead is not None
            self.solved[row], self.structure[row] = ahead.solved[row], ahead.structure[row]

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
        halvings = self._level(self.iteration)[0].halvings
        return [self._halved(view, item.frame, halvings) for view in super().views(item)]

    def _halved(self, view: View, frame: int, times: int) -> View:
        if self._small[0] != frame:
            self._small = (frame, {})
        kept = self._small[1]
        if not times:
            return view
        if (view.name, times) not in kept:
            kept[view.name, times] = self._halved(view, frame, times - 1).halved()
        return kept[view.name, times]

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, float]]:
        """Return `L_rec` with the roughness of what is not foreseen and how far the body moves, and its terms."""
        views = self.views(item)
        posed = self.avatar(self.sequence.pose(item.frame), camera_centers_of(views))
        total, terms, _ = self.compared(posed, views)
        cage, controls = self.avatar.cage, self.avatar.controls
        begin = self.begin(item.frame)
        total = total + self.track_config.smoothness * cage.roughness(controls - begin.shape)
        if self.track_config.held:
            off = controls - begin.anchor
            total = total + self.track_config.held * torch.einsum("ki,kij,kj->k", off, begin.held, off).mean()
        if self.track_config.body_motion_weight and not cage.off_clothes.all():
            left = cage.motion_off_clothes(controls, reach=self.track_config.tight_reach)
            total = total + self.track_config.body_motion_weight * left
        return total, {"loss": float(total.detach()), **terms}

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Take a step of the frame's; the first one leaves the frame before."""
        place, step = divmod(iteration, self.track_config.steps)
        if step == 0:
            with torch.no_grad():
                self.avatar.controls.copy_(self.begin(self.order[place]).start)
            self.optimiser.state.clear()
        metrics = super().step(iteration)
        with torch.no_grad():
            self.solved[self.row[self.order[place]]] = self.avatar.controls
        return metrics

    def begin(self, frame: int) -> Begin:
        """Return what a frame begins with; it is kept while the frame is followed, what pictures tell for good."""
        if self._begun is None or self._begun[0] != frame:
            self._begun = (frame, self._begin(frame))
        return self._begun[1]

    def _begin(self, frame: int) -> Begin:
        done = {}
        for other in (*self.ends, *self.order[: self.order.index(frame)]):
            row = self.row[other]
            done[other] = (self.solved[row], self._unit - held_directions(self.structure[row], self._normals))
        start = self.foresight.start(frame, done) if done else torch.zeros_like(self.avatar.controls)
        own = self.structure[self.row[frame]]
        own.copy_(self._structure(frame, start))
        if not done:
            return Begin(start, start, start, torch.zeros_like(own))
        # What is not simulated is not held: plain cloth that swings would stay where skinning has it.
        held, anchor = self.foresight.share * held_directions(own, self._normals), self.foresight.anchor(frame, done)
        start = start + torch.einsum("kij,kj->ki", held, anchor - start)
        return Begin(start, self.foresight.shape(frame, done), anchor, held)

    def _structure(self, frame: int, controls: Tensor) -> Tensor:
        """What photographs of a frame can tell of displacements about these."""
        halvings = min((level.halvings for level in self.track_config.levels), key=lambda size: abs(size - SEEN))
        names = self.sequence.cameras(frame, 0, len(self.sequence.train_cameras), self.track_config.seed)
        views = [self._halved(self.sequence.view(name, frame), frame, halvings) for name in names]
        pose, background = self.sequence.pose(frame), self.sequence.background
        return picture_structure(self.avatar, controls, pose, views, background, halvings=halvings)

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return nothing: the control points are those of one frame."""
        return {"mean": {}}

    def state(self) -> Mapping[str, Tensor]:
        """Return the frames that are done too."""
        return {**super().state(), **self.found()}

    def found(self) -> dict[str, Tensor]:
        """Return displacements of the frames that are done and what pictures told; rows in the frames' order."""
        return {"solved": self.solved, "structure": self.structure}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `state` gave."""
        require_like(tensors, self.found(), subject="checkpoint")
        require_finite({name: tensors[name] for name in self.found()}, subject="checkpoint")
        super().restore(tensors)
        for name, own in self.found().items():
            own.copy_(tensors[name])
        self._begun = None

    def foresight_known(self) -> Foresight:
        """Return the foresight with what was found in the reference frame, where a way back has yet to come."""
        reference = self.track_config.reference
        return self.foresight if reference is None else replace(self.foresight, error=self.solved[self.row[reference]])

    def track(self) -> Track:
        """Return what was found, less what was found in the reference frame.

        There the template is the surface: what images ask of it is an error of the Gaussians, in all frames alike.
        """
        solved = self.solved.clone()
        if self.track_config.reference is not None:
            solved -= self.solved[self.row[self.track_config.reference]]
        return Track(self.row, solved, self.avatar.cage, self._sigma(solved))

    def _sigma(self, solved: Tensor) -> Tensor:
        """Distances (T, K) from the truth that are to be expected of displacements."""
        structure = {frame: self.structure[self.row[frame]] for frame in self.order}
        seconds, known = 1.0 / (self.sequence.capture.fps or DEFAULT_FPS), self.track_config.reference is not None
        moved = solved.square().sum(-1).mean(0).sqrt()
        found = expected_distances(self.order, seconds, structure, moved, known=known)
        return torch.stack([found[frame] for frame in self.row])

    def apart_at_first(self, back: TrackTask) -> Tensor:
        """Return how far (K,), metres, a way back ends from where this one began."""
        frames = self.sequence.train_frames
        row = self.row[frames[0] if self.track_config.reference is None else self.track_config.reference]
        return (back.solved[row] - self.solved[row]).norm(dim=-1)


def _foresight(sequence: AvatarSequence, cage: ControlCage, config: TrackConfig) -> Foresight:
    simulated, fps = None, sequence.capture.fps
    if config.simulate and config.reference is not None and fps is not None:
        poses = {frame: sequence.params(frame) for frame in sequence.train_frames}
        reference = poses[config.reference].without_shape()
        simulated = simulate_controls(sequence.rig.template, poses, fps, reference=reference, controls=cage.vertices)
    return Foresight(config.extrapolation, simulated, config.reference, fps=fps or DEFAULT_FPS)


def follow_surface(
    sequence: AvatarSequence, gaussians: BoundGaussians, config: TrackConfig, session: Session
) -> tuple[Track, Progress]:
    """Find the displacements of every training frame, one frame after the other; go back, where that is asked for.

    Steps have one frame each: of several processes the first follows it, and the others hear what it found.
    """
    count = min(config.control_points, len(sequence.rig.vertices))
    avatar = TrackedAvatar(sequence.rig, gaussians, count, still_body=config.still_body)
    context = replace(session.context, distributed=None)
    task = TrackTask(sequence, avatar, config, context)
    progress = session.run_alone(lambda: task, task.config)
    _share(task, session)
    if not (config.back and progress.finished and len(sequence.train_frames) > 1):
        return task.track(), progress
    way_back = TrackTask(sequence, avatar, config.coarse(), context, ahead=task)
    after = session.after(progress).within(BACK).run_alone(lambda: way_back, way_back.config)
    _share(way_back, session)
    found = replace(task.track(), drift=task.apart_at_first(way_back)) if after.finished else task.track()
    return found, replace(after, session_seconds=progress.session_seconds + after.session_seconds)


def _share(task: TrackTask, session: Session) -> None:
    """Tell all processes what the first one found."""
    processes = session.distributed or Distributed()
    for own in task.found().values():
        own.copy_(processes.run_on_rank0(own.cpu))
