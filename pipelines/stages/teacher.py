"""Stage 80: track the surface, pretrain the networks on it, train the teacher on the photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avatar.models.networks.teacher import TeacherConfig
from avatar.training.engine.session import Session
from avatar.training.fit_teacher import FitTeacherConfig, fit_teacher
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import ModelStage, Trainer
from pipelines.stages.train_results import training_output, write_model


@dataclass(frozen=True, kw_only=True)
class TeacherStage(ModelStage):
    """Stage that trains a teacher on fitted Gaussians.

    Attributes:
        gaussians: stage of the fit.
        networks: architecture of the teacher.
        config: configuration of tracking, pretraining and training.
    """

    file = "teacher.safetensors"

    gaussians: ModelStage
    networks: TeacherConfig
    config: FitTeacherConfig

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        return {"gaussians": self.gaussians}

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        return {
            "training": self.config.starting_at(trainer.scene.built_frame),
            "networks": self.networks,
            "perceptual": trainer.perceptual_name(self.config),
        }

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        # The configuration depends on the frame that the template was built from, where tracking starts.
        sequence = trainer.sequence(self.ground)
        gaussians = self.gaussians.read(trainer.path(self.gaussians), sequence.rig)
        model, done = fit_teacher(
            sequence, gaussians, self.networks, self.config.starting_at(trainer.scene.built_frame), session
        )
        return training_output(trainer, session, folder, model, done, lambda: write_model(folder / self.file, model))
