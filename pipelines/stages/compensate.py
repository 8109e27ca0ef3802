"""Stage 90: train blend shapes for the residual of the field, and write the compact file for players."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.training.engine.session import Session
from avatar.training.student.compensate import CompensateConfig, compensate, write_student
from pipelines.runs.layout import COMPACT_STUDENT
from pipelines.runs.stage import StageOutput
from pipelines.stages.cloth import clothed_sequence
from pipelines.stages.models import ModelStage, Trainer
from pipelines.stages.train_results import training_output


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
