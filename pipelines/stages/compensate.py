"""Stage 90: blend shapes for what the field leaves, and the compact file for players."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.training.student.compensate import CompensateConfig
from avatar.training.train import Session, compensate
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import ModelStage, Trainer
from pipelines.stages.train_results import training_output, write_student


@dataclass(frozen=True, kw_only=True)
class CompensateStage(ModelStage):
    """A baked student with trained blend shapes.

    Attributes:
        student: the bake. teacher: whose followed surface the blend shapes start from; None: from zero.
        shapes: as many as the expressions of the body are driven, whatever it says itself.
        max_bytes: of the compact file, which has to leave out blend shapes for it; None: it has all.
    """

    file = "student.safetensors"

    student: ModelStage
    teacher: ModelStage | None = None
    shapes: BlendShapeConfig
    config: CompensateConfig
    max_bytes: float | None = None

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        return {"student": self.student, **({} if self.teacher is None else {"teacher": self.teacher})}

    @property
    def seed(self) -> int:
        return self.config.seed

    @property
    def iterations(self) -> int:
        return self.config.iterations

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        return {
            "training": self.config,
            "blend_shapes": self._fitting(trainer),
            "max_bytes": self.max_bytes,
            "perceptual": trainer.perceptual_name(self.config),
        }

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        sequence = trainer.sequence(self.ground)
        teacher = None if self.teacher is None else trainer.model(self.teacher)
        student = self.student.read(trainer.path(self.student), sequence.rig)
        model, done = compensate(sequence, student, self._fitting(trainer), self.config, session, teacher=teacher)
        return training_output(
            trainer,
            session,
            folder,
            model,
            done,
            lambda: write_student(
                folder, model, sequence, self.config, max_bytes=self.max_bytes, context=session.context
            ),
        )

    def _fitting(self, trainer: Trainer) -> BlendShapeConfig:
        """The blend shapes of the template's body."""
        return replace(self.shapes, expression_size=trainer.scene.template.body.num_expressions)
