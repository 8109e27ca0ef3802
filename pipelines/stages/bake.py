"""Stage 85: distil the teacher's maps into a deformation field of the student's mesh.

Apart from the compensation, whose code would otherwise be in this stage's key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avatar.models.student import StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.training.engine.session import Session
from avatar.training.student.bake import BakeConfig, bake
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
