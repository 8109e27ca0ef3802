"""Stage 90: blend shapes for what the field leaves, and the compact file for players."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avatar.data.sequence import AvatarSequence
from avatar.models.model_file import load_avatar, save_avatar
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.student import Student
from avatar.training.engine.photometric_task import TaskContext
from avatar.training.engine.session import Session
from avatar.training.student.compensate import CompensateConfig, CompensateTask, compensate
from avatar.training.student.prune import pruned_to
from pipelines.runs.layout import COMPACT_STUDENT, STUDENT
from pipelines.runs.stage import StageOutput
from pipelines.stages.cloth import clothed_sequence
from pipelines.stages.models import ModelStage, Trainer
from pipelines.stages.train_names import KINDS
from pipelines.stages.train_results import training_output


@dataclass(frozen=True, kw_only=True)
class CompensateStage(ModelStage):
    """A baked student with trained blend shapes.

    Attributes:
        student: the bake. teacher: whose followed surface the blend shapes start from; None: from zero.
        cloth: the loose clothes, which poses that count as new are shown simulated; None: nothing is.
        shapes: as many as the expressions of the body are driven, whatever it says itself.
        max_bytes: of the compact file, which has to leave out blend shapes for it; None: it has all.
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
            "blend_shapes": self._fitting(trainer),
            "max_bytes": self.max_bytes,
            "perceptual": trainer.perceptual_name(self.config),
        }

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        sequence = clothed_sequence(trainer, self.ground, self.cloth)
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


def write_student(
    folder: Path,
    student: Student,
    sequence: AvatarSequence,
    config: CompensateConfig,
    *,
    max_bytes: float | None,
    context: TaskContext,
) -> dict[str, Any]:
    """Write a student with blend shapes, whole and compact; bytes, and figures of the compact one read back.

    Args:
        max_bytes: of the compact file, which has to leave out blend shapes for it; None: it has all.
        context: of the training.
    """
    name, compact = (Path(file).name for file in (STUDENT, COMPACT_STUDENT))
    small, keep = (student, 1.0) if max_bytes is None else pruned_to(student, sequence, max_bytes)
    bytes_of = {name: save_avatar(folder / name, student), compact: save_avatar(folder / compact, small, compact=True)}
    # As a player has it: half precision, and without what was pruned.
    stored = load_avatar(folder / compact, sequence.rig)
    assert isinstance(stored, Student)
    quiet = replace(context, preview=lambda images: None)
    # Measured alone: what holds neighbours in training is not made.
    task = CompensateTask(sequence, stored, replace(config, coherence=0.0), quiet)
    figures = task.evaluate(config.iterations)
    measured = {kind: figures[kind] for kind in KINDS if kind in figures}
    return {"bytes": bytes_of, "compact": {"kept_blend_shapes": keep, **measured}}
