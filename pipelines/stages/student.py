"""Stages 85 and 90: the student distilled from the teacher's maps, then its blend shapes compensated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.student import StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.training.engine.session import Session
from avatar.training.student.bake import BakeConfig, bake
from avatar.training.student.compensate import CompensateConfig, compensate
from avatar.training.student.write_student import write_student
from pipelines.runs.layout import COMPACT_STUDENT
from pipelines.runs.stage import StageOutput
from pipelines.stages.cloth import clothed_sequence
from pipelines.stages.models import ModelStage, Trainer
from pipelines.stages.train_results import training_output, write_model


@dataclass(frozen=True, kw_only=True)
class BakeStage(ModelStage):
    """A student before its blend shapes: field and attributes from a teacher, or from photographs.

    Attributes:
        source: stage of a teacher, whose Gaussians are the start; or of a fit, to learn from photographs alone.
        cloth: stage of the loose clothes, which are simulated in poses that count as new; None simulates none.
        student: architecture of the student.
        config: configuration of the training.
    """

    file = "student.safetensors"

    source: ModelStage
    cloth: ModelStage | None = None
    student: StudentConfig
    config: BakeConfig

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        return {"source": self.source, **({} if self.cloth is None else {"cloth": self.cloth})}

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        return {
            "training": self.config,
            "student": self.student,
            "perceptual": trainer.perceptual_name(self.config),
        }

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        sequence = clothed_sequence(trainer, self.ground, self.cloth)
        source = self.source.read(trainer.path(self.source), sequence.rig)
        teacher = source if isinstance(source, TeacherAvatar) else None
        gaussians = source if teacher is None else teacher.gaussians.snapshot()
        model, done = bake(sequence, gaussians, self.student, self.config, session, teacher=teacher)
        return training_output(trainer, session, folder, model, done, lambda: write_model(folder / self.file, model))


@dataclass(frozen=True, kw_only=True)
class CompensateStage(ModelStage):
    """A baked student with trained blend shapes.

    Attributes:
        student: stage of the baked student.
        teacher: stage of the teacher whose tracked surface initialises the blend shapes; None starts from zero.
        cloth: stage of the loose clothes, which are simulated in poses that count as new; None simulates none.
        shapes: blend shapes; their number of expression inputs is replaced by that of the body.
        config: configuration of the training.
        max_bytes: largest size of the compact file, which leaves out blend shapes to meet it; None keeps all.
    """

    file = "student.safetensors"

    student: ModelStage
    teacher: ModelStage | None = None
    cloth: ModelStage | None = None
    shapes: BlendShapeConfig
    config: CompensateConfig
    max_bytes: float | None = None

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        others = {"teacher": self.teacher, "cloth": self.cloth}
        return {"student": self.student, **{part: stage for part, stage in others.items() if stage is not None}}

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        return {
            "training": self.config,
            "blend_shapes": self._shapes_of(trainer),
            "max_bytes": self.max_bytes,
            "perceptual": trainer.perceptual_name(self.config),
        }

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        # Garments are simulated in poses that count as new, so that blend shapes see the clothes that they will later.
        sequence = clothed_sequence(trainer, self.ground, self.cloth)
        teacher = None if self.teacher is None else trainer.model(self.teacher)
        student = self.student.read(trainer.path(self.student), sequence.rig)
        model, done = compensate(
            sequence,
            student,
            self._shapes_of(trainer),
            self.config,
            session,
            teacher=teacher,
        )
        return training_output(
            trainer,
            session,
            folder,
            model,
            done,
            lambda: write_student(
                folder / self.file,
                folder / Path(COMPACT_STUDENT).name,
                model,
                sequence,
                self.config,
                max_bytes=self.max_bytes,
                context=session.context,
            ),
        )

    def _shapes_of(self, trainer: Trainer) -> BlendShapeConfig:
        """Return blend shapes that the expressions of the template's body drive."""
        return replace(self.shapes, expression_size=trainer.scene.template.body.num_expressions)
