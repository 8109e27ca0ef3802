"""Training of the teacher: residual maps that fit the Gaussians of every frame to its photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from avatar.data.byte_cache import ByteCache
from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.gaussians.binding import BoundGaussians, on_triangles
from avatar.models.networks.teacher import Residuals, TeacherConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import Track
from avatar.rig.rig import PosedAvatar
from avatar.training.engine.adam import ParameterGroup
from avatar.training.engine.loop import Progress
from avatar.training.engine.optimization_task import CACHE_BYTES, PretrainConfig, PretrainTask
from avatar.training.engine.photometric_task import (
    ALONE,
    PhotometricConfig,
    PhotometricTask,
    TaskContext,
    with_surface_normals,
)
from avatar.training.engine.resources import compile_networks, fixed_seed
from avatar.training.engine.session import PRETRAIN, TRACK, Session
from avatar.training.tracking.config import JointConfig, TrackConfig
from avatar.training.tracking.follow import follow_surface
from avatar.training.tracking.joint import correct_jointly
from smplxpp.core.spread import spread_inside


class PretrainTeacherTask(PretrainTask):
    """Fits the networks to known displacements: `mean |dU - known|` where the Gaussians look the maps up.

    The mean is weighted by the track's confidence, in units of the maps. Without a track all residuals are fitted to 0.

    Args:
        sequence: of the training frames.
        teacher: whose networks learn.
        config: of the steps.
        seed: of the order of frames.
        track: the known displacements; the teacher's other residuals start at zero. None: zero residuals.
    """

    def __init__(
        self, sequence: AvatarSequence, teacher: TeacherAvatar, config: PretrainConfig, seed: int, track: Track | None
    ) -> None:
        networks = ParameterGroup(
            "networks", dict(teacher.networks.named_parameters()), config.lr, config.lr_final_factor
        )
        super().__init__([networks], config, len(sequence.train_frames), seed)
        self.sequence, self.teacher, self.track = sequence, teacher, track
        self._known = ByteCache(CACHE_BYTES)

    def name_of(self, item: tuple[int, ...]) -> str:
        """Return the name of a batch for messages: its frames."""
        return "frames " + " ".join(str(self.sequence.train_frames[k]) for k in item)

    def loss(self, item: tuple[int, ...]) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the loss of a batch of frames, in units of the maps."""
        frames = [self.sequence.train_frames[k] for k in item]
        # Without a track: the mean size of all residuals.
        if self.track is None:
            maps = [self._all_residuals(frame) for frame in frames]
            sizes = [m.shape.float().abs().mean() + m.colour.float().abs().mean() for m in maps]
            loss = sum(sizes[1:], sizes[0]) / len(maps)
            return loss, {"loss": loss.detach()}
        # With a track: weighted L1 distance at the Gaussians.
        inputs, known, weights = zip(*(self._training_pair(frame, self.track) for frame in frames), strict=True)
        with self.autocast():
            found = self.teacher.networks.positions(torch.cat(inputs), self.teacher.semantics)
        units = torch.stack(known) / self.teacher.config.position_scale
        apart, weight = (self.teacher.sampler(found.float()) - units).abs().sum(-1), torch.stack(weights)
        loss = (weight * apart).sum() / weight.sum()
        return loss, {"loss": loss.detach()}

    def _training_pair(self, frame: int, track: Track) -> tuple[Tensor, ...]:
        """Return the input map of a frame, the Gaussians' known displacements (N, 3) and their weights (N,).

        Displacements are in metres along the axes of the T-pose.
        """

        def make() -> tuple[Tensor, ...]:
            # Interpolate displacements and confidences from the vertices to the Gaussians.
            known = torch.cat([track.displacements(frame), track.confidence(frame)[:, None]], dim=1)
            corners = known[self.sequence.rig.faces[self.teacher.gaussians.face_index]]
            at_gaussians = on_triangles(corners, self.teacher.gaussians.barycentric)
            inputs = self.teacher.position_input(self.sequence.pose(frame))
            return inputs, at_gaussians[:, :3].contiguous(), at_gaussians[:, 3].contiguous()

        return self._known.get(frame, make)

    def _all_residuals(self, frame: int) -> Residuals:
        """Return all residual maps of a frame, seen by one of its cameras."""
        # The colour network needs a viewpoint; any camera serves, because the target is zero for all of them.
        cameras = self.sequence.cameras(frame, 0, 1, self.seed)
        positions = np.stack([self.sequence.capture.cameras[name].position for name in cameras])
        camera_centers = torch.tensor(positions, dtype=torch.float32, device=self.sequence.device)
        with self.autocast():
            return self.teacher.residual_maps(self.sequence.pose(frame), camera_centers)


@dataclass(frozen=True, kw_only=True)
class FitTeacherConfig(PhotometricConfig):
    """Choices of the teacher's tracking, pretraining and training.

    Attributes:
        iterations: 600k in the paper.
        pretrain: pretraining without rendering, to zero residuals (5k steps in Animatable Gaussians), or with `track`
            to the tracked displacements. None: none.
        view_jitter: standard deviation of the noise on camera centres for the colour network, as a share of their
            distance.
        displacement: weight of `mean |dU|^2` over the Gaussians, in units of the maps.
        track: of the surface tracking that comes first; None, as in the paper: none.
        joint: of the correction of tracked clothes and Gaussians by all frames at once; None: none. Not applied to a
            template without clothes.
    """

    iterations: int = 600_000
    pretrain: PretrainConfig | None = field(default_factory=lambda: PretrainConfig(iterations=5_000))
    view_jitter: float = 0.1
    displacement: float = 0.0
    track: TrackConfig | None = None
    joint: JointConfig | None = None

    def starting_at(self, frame: int | None) -> FitTeacherConfig:
        """Return the configuration with a reference frame for its tracking; None: the tracking's own choice."""
        if self.track is None:
            return self
        joint = self.joint and replace(self.joint, seed=self.seed)
        return replace(self, track=replace(self.track, reference=frame, seed=self.seed), joint=joint)


class TeacherTask(PhotometricTask):
    """Trains the teacher's networks by `L_rec` on photographs."""

    config: FitTeacherConfig

    def __init__(
        self,
        sequence: AvatarSequence,
        teacher: TeacherAvatar,
        config: FitTeacherConfig,
        context: TaskContext = ALONE,
    ) -> None:
        networks = ParameterGroup(
            "networks", dict(teacher.networks.named_parameters()), config.lr, config.lr_final_factor
        )
        super().__init__(sequence, teacher, config, [networks], context)
        self.teacher = teacher

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the loss of one frame; the networks run once for all its cameras."""
        views = self.views(item)
        pose, camera_centers = self.sequence.pose(item.frame), camera_centers_of(views)
        # Residual maps of the pose; one colour map for each camera.
        maps = self._maps(item, camera_centers)
        posed = self.teacher.posed(pose, camera_centers, maps)
        total, terms, _ = self.compared(posed, views)
        if self.config.displacement:
            # Penalty of large displacements: where photographs determine nothing, Gaussians stay on the skinned mesh.
            moved = maps.shape[..., :3].square().mean()
            total = total + self.config.displacement * moved
        return total, {"loss": total.detach(), **terms, "displacement_mm": _millimetres(posed, self.teacher)}

    def _maps(self, item: Item, camera_centers: Tensor) -> Residuals:
        """Return the residual maps of a frame, with noise on the camera centres of the colour network."""
        pose = self.sequence.pose(item.frame)
        # Few cameras train the colour network; noise on their places makes it smooth between them.
        noise = self.generator(item.frame).normal(size=camera_centers.shape) * self.config.view_jitter
        center = pose.root_from_world.inverse()[:3, 3]
        away = (camera_centers - center).norm(dim=-1, keepdim=True)
        jittered = camera_centers + away * torch.tensor(noise, dtype=camera_centers.dtype, device=camera_centers.device)
        # The networks alone run in half precision; rasteriser and losses need float32.
        with self.autocast():
            return self.teacher.residual_maps(pose, jittered).float()


def _millimetres(posed: PosedAvatar, teacher: TeacherAvatar) -> Tensor:
    """Return the mean length of the Gaussians' displacement, mm."""
    with torch.no_grad():
        return 1e3 * (posed.bound.offset - teacher.gaussians.offset).norm(dim=-1).mean()


def fit_teacher(
    sequence: AvatarSequence,
    gaussians: BoundGaussians,
    networks: TeacherConfig,
    config: FitTeacherConfig,
    session: Session,
) -> tuple[TeacherAvatar, Progress]:
    """Train a teacher on Gaussians of the template, after tracking the surface where the configuration requests it.

    Args:
        sequence: of the training frames.
        gaussians: from the fit, bound to the template.
        networks: architecture of the teacher.
        config: of tracking, pretraining and training.
        session: of the training; a stopped one continues from its checkpoints.

    Returns:
        The teacher and the progress of the last training that ran.
    """
    centred_on = 256  # frames of which mean and deviation of the input maps are taken
    with fixed_seed(config.seed):
        teacher = TeacherAvatar(networks, sequence.rig, gaussians)
    teacher.centre(sequence.pose(frame) for frame in spread_inside(sequence.train_frames, centred_on))
    compile_networks(teacher.networks.networks.values(), session.compile)
    # Track the surface.
    track = None
    if config.track is not None:
        track, progress = follow_surface(sequence, gaussians, config.track, session.within(TRACK))
        if not progress.finished:
            return teacher.eval(), progress
        teacher.remember(track)
        session = session.after(progress)
        # Correct it together with the Gaussians, with which the teacher starts.
        if config.joint is not None and bool(sequence.rig.cloth_mask.any()):
            gaussians, track, progress = correct_jointly(sequence, gaussians, track, config.joint, session)
            if not progress.finished:
                return teacher.eval(), progress
            teacher.gaussians.take(gaussians)
            teacher.remember(track)
            session = session.after(progress)
    # Pretrain on the track. Networks whose output starts at zero need no pretraining to zero residuals.
    if config.pretrain is not None and (track is not None or not networks.zero_output):
        pretrain = config.pretrain
        progress = session.within(PRETRAIN).run_alone(
            lambda: PretrainTeacherTask(sequence, teacher, pretrain, config.seed, track), pretrain
        )
        if not progress.finished:
            return teacher.eval(), progress
        session = session.after(progress)
    # Train on photographs.
    context = with_surface_normals(session.context, sequence, track if config.surface_normals else None)
    progress = session.run(lambda: TeacherTask(sequence, teacher, config, context), config)
    return teacher.eval(), progress
