"""The three trainings as functions: a task, the loop, the trained avatar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.binding import BoundGaussians
from avatar.losses.perceptual import PerceptualDistance
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.deformation_field import show_null_code
from avatar.models.networks.teacher import TeacherConfig
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import Track, TrackedAvatar
from avatar.training.engine.device import fixed_seed
from avatar.training.engine.loop import LoopConfig, Progress, run_training
from avatar.training.engine.optimization_task import OptimizationTask
from avatar.training.engine.photometric_task import PhotometricConfig, Preview, TaskContext
from avatar.training.engine.pretraining import PretrainConfig
from avatar.training.engine.processes import Distributed
from avatar.training.student.bake import BakeConfig, BakeTask
from avatar.training.student.compensate import CompensateConfig, CompensateTask
from avatar.training.student.init_blend_shapes import init_blend_shapes
from avatar.training.student.pretrain import PretrainFieldTask
from avatar.training.teacher.fit_teacher import FitTeacherConfig, TeacherTask
from avatar.training.teacher.pretrain import PretrainTeacherTask
from avatar.training.tracking.track import TrackConfig, TrackTask
from smplxpp.core.spread import spread_inside

TRACK, PRETRAIN = "track", "pretrain"
"""Folders of what comes before a training."""
CENTRED_ON = 256
"""Frames, spread over the training's, that centred inputs are measured on."""


@dataclass(frozen=True, eq=False)
class Session:
    """Where and how a training runs; of all this the perceptual distance alone changes what comes out of its steps.

    Attributes:
        folder: for metrics and the checkpoint. key: names configuration and inputs.
        perceptual: for the perceptual term, None leaves it out.
        distributed: the processes that train together.
        max_seconds: stop with a checkpoint after as much work.
        tensorboard: log for TensorBoard too.
        report: called after logged steps and evaluations. preview: with rendered images at evaluations.
    """

    folder: Path
    key: str = ""
    perceptual: PerceptualDistance | None = None
    distributed: Distributed | None = None
    max_seconds: float = float("inf")
    tensorboard: bool = False
    report: Callable[[Progress], None] = lambda progress: None
    preview: Preview = lambda images: None

    @property
    def context(self) -> TaskContext:
        """What a `PhotometricTask` takes of it."""
        return TaskContext(self.perceptual, self.distributed, self.preview)

    def run(
        self,
        make: Callable[[], OptimizationTask[Any]],
        config: PhotometricConfig | PretrainConfig,
        *,
        keep_end: bool = False,
    ) -> Progress:
        """Train what `make` gives."""
        loop = LoopConfig(
            iterations=config.iterations,
            evaluate_every=config.evaluate_every,
            max_seconds=self.max_seconds,
            keep_end=keep_end,
            tensorboard=self.tensorboard,
        )
        return run_training(make(), loop, self.folder, key=self.key, report=self.report)

    def run_alone(
        self, make: Callable[[], OptimizationTask[Any]], config: PhotometricConfig | PretrainConfig
    ) -> Progress:
        """Train what `make` gives on the first process; the others wait. A checkpoint of the end is kept."""
        processes = self.distributed or Distributed()
        return processes.run_on_rank0(lambda: self.run(make, config, keep_end=True))

    def within(self, name: str) -> Session:
        """Return the same in a folder of its own, without previews."""
        return replace(self, folder=self.folder / name, preview=lambda images: None)

    def after(self, progress: Progress) -> Session:
        """Return the session with what is left of the time after a training that came first."""
        return replace(self, max_seconds=max(self.max_seconds - progress.session_seconds, 0.0))


def fit_teacher(
    sequence: AvatarSequence,
    gaussians: BoundGaussians,
    networks: TeacherConfig,
    config: FitTeacherConfig,
    session: Session,
) -> tuple[TeacherAvatar, Progress]:
    """Train a teacher on Gaussians of the template, after following the surface where the configuration says so."""
    with fixed_seed(config.seed):
        teacher = TeacherAvatar(networks, sequence.rig, gaussians)
    teacher.centre(sequence.motion(frame) for frame in spread_inside(sequence.train_frames, CENTRED_ON))
    track = None
    if config.track is not None:
        track, progress = follow_surface(sequence, gaussians, config.track, session.within(TRACK))
        if not progress.finished:
            return teacher.eval(), progress
        teacher.remember(track)
        session = session.after(progress)
    # Networks whose output is zero know zero residuals already.
    if config.pretrain is not None and (track is not None or not networks.zero_output):
        pretrain = config.pretrain
        progress = session.within(PRETRAIN).run_alone(
            lambda: PretrainTeacherTask(sequence, teacher, pretrain, config.seed, track), pretrain
        )
        if not progress.finished:
            return teacher.eval(), progress
        session = session.after(progress)
    progress = session.run(lambda: TeacherTask(sequence, teacher, config, session.context), config)
    return teacher.eval(), progress


def follow_surface(
    sequence: AvatarSequence, gaussians: BoundGaussians, config: TrackConfig, session: Session
) -> tuple[Track, Progress]:
    """Find the displacements of every training frame, one frame after the other.

    Steps have one frame each: of several processes the first follows it, and the others hear what it found.
    """
    avatar = TrackedAvatar(sequence.rig, gaussians, min(config.control_points, len(sequence.rig.vertices)))
    task = TrackTask(sequence, avatar, config, replace(session.context, distributed=None))
    progress = session.run_alone(lambda: task, task.config)
    processes = session.distributed or Distributed()
    task.solved.copy_(processes.run_on_rank0(lambda: task.solved.cpu()))
    return task.track(), progress


def bake(
    sequence: AvatarSequence,
    gaussians: BoundGaussians,
    student: StudentConfig,
    config: BakeConfig,
    session: Session,
    *,
    teacher: TeacherAvatar | None,
) -> tuple[Student, Progress]:
    """Train a student's field, codes and attributes on what a teacher shows, or on photographs without one."""
    with fixed_seed(config.seed):
        made = Student(student, sequence.rig, gaussians, sequence.train_frames)
    if config.pretrain is not None and teacher is not None and made.field is not None:
        pretrain = config.pretrain
        progress = session.within(PRETRAIN).run_alone(
            lambda: PretrainFieldTask(
                sequence,
                made,
                teacher,
                pretrain,
                config.seed,
                code_lr_factor=config.code_lr_factor,
                null_share=config.null_share,
                imagined=config.imagined,
            ),
            pretrain,
        )
        if not progress.finished:
            return made.eval(), progress
        session = session.after(progress)
        if config.null_share or config.imagined:
            show_null_code(made)  # on the processes that only waited for the pretraining, too
    progress = session.run(lambda: BakeTask(sequence, made, config, session.context, teacher=teacher), config)
    return made.eval(), progress


def compensate(
    sequence: AvatarSequence,
    student: Student,
    shapes: BlendShapeConfig,
    config: CompensateConfig,
    session: Session,
    *,
    teacher: TeacherAvatar | None = None,
) -> tuple[Student, Progress]:
    """Give a baked student blend shapes and train them.

    Args:
        teacher: of the bake; the surface that it remembers, if any, seeds the blend shapes where `config` says so.
    """
    with fixed_seed(config.seed):
        made = student.with_blend_shapes(shapes)
        if config.init_from_track and teacher is not None and teacher.track is not None:
            init_blend_shapes(made, sequence, teacher.track)
    progress = session.run(lambda: CompensateTask(sequence, made, config, session.context), config)
    return made.eval(), progress
