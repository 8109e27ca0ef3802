"""Run the stages that only an ablation has: students with pruned blend shapes, and avatars of other kinds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from avatar.baselines.avatar_base import Baseline, PhotographConfig, PhotographTask
from avatar.baselines.build import BaselineConfig, make_baseline
from avatar.gaussians.tensor_file import open_tensor_file, require_finite, require_like
from avatar.models.model_file import save_avatar
from avatar.models.networks.deformation_field import show_null_code
from avatar.training.engine.resources import fixed_seed
from avatar.training.engine.session import Session
from avatar.training.student.prune import coefficient_std, pruned_to
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import ModelStage, Trainer
from pipelines.stages.train_results import training_output
from smplxpp.core.files.atomic import atomic_write_bytes


@dataclass(frozen=True, kw_only=True)
class PruneConfig:
    """How a student's blend shapes are pruned.

    Attributes:
        keep: share of the Gaussians that keep their blend shapes, less if `max_bytes` requires it.
        max_bytes: limit of the compact file's size.
        seed: unused, because nothing is random; stages ask for it.
        iterations: one, because pruning is a single step.
    """

    keep: float
    max_bytes: float
    seed: int = 0
    iterations: int = 1


@dataclass(frozen=True, kw_only=True)
class PrunedStage(ModelStage):
    """A student whose least important Gaussians have lost their blend shapes.

    Attributes:
        student: the stage that trains it.
    """

    file = "student.safetensors"
    resumable = False
    alone = True

    student: ModelStage
    config: PruneConfig

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        return {"student": self.student}

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        return {"pruning": self.config}

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        student, sequence = trainer.model(self.student), trainer.sequence(self.ground)
        shapes = student.blend_shapes.pruned(coefficient_std(student, sequence), keep=self.config.keep)
        small, kept = pruned_to(student.with_blend_shapes(shapes), sequence, self.config.max_bytes)
        size = save_avatar(folder / self.file, small.eval())
        return StageOutput(numbers={"bytes": {self.file: size}, "kept_blend_shapes": kept, "finished": True})


@dataclass(frozen=True, kw_only=True)
class BaselineStage(ModelStage):
    """An avatar of another kind, trained on photographs.

    Attributes:
        gaussians: the fit that it starts from.
        model: configuration of the kind of avatar.
        config: configuration of the training.
    """

    file = "baseline.safetensors"

    gaussians: ModelStage
    model: BaselineConfig
    config: PhotographConfig

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        return {"gaussians": self.gaussians}

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        return {
            "model": {"kind": type(self.model).__name__, **asdict(self.model)},
            "training": self.config,
            "perceptual": trainer.perceptual_name(self.config),
        }

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        sequence = trainer.sequence(self.ground)
        with fixed_seed(self.config.seed):
            model = self._untrained(trainer)
        done = session.run(lambda: PhotographTask(sequence, model, self.config, session.context), self.config)

        def write() -> Mapping[str, Any]:
            write_baseline(folder / self.file, model)
            return {"bytes": {self.file: (folder / self.file).stat().st_size}}

        return training_output(trainer, session, folder, model.eval(), done, write)

    def read_by(self, trainer: Trainer, path: Path) -> Baseline:
        model = self._untrained(trainer)
        read_baseline(path, model)
        return model.eval()

    def write_player(self, path: Path, model: Any) -> None:
        write_baseline(path, model, compact=True)

    def _untrained(self, trainer: Trainer) -> Baseline:
        sequence = trainer.sequence(self.ground)
        model = make_baseline(self.model, sequence.rig, trainer.model(self.gaussians), sequence.train_frames)
        if self.config.null_share:
            show_null_code(model)
        return model


def read_baseline(path: Path, model: Baseline) -> None:
    """Load the state that `write_baseline` wrote into a baseline; half precision is cast.

    Raises:
        InputError: a missing or damaged file, tensors that are not the model's, or not finite.
    """
    subject = f"baseline {path}"
    tensors = open_tensor_file(path, subject=subject, header=None).tensors()
    own: Mapping[str, Tensor] = model.state_dict()
    # A player's file stores bools as integers.
    given = {
        name: value.bool() if name in own and own[name].dtype == torch.bool else value
        for name, value in tensors.items()
    }
    require_like(given, own, subject=subject)
    require_finite(given, subject=subject)
    model.load_state_dict({name: given[name] for name in own})


def write_baseline(path: Path, model: Baseline, *, compact: bool = False) -> None:
    """Write the state of a baseline, in half precision with `compact`, as players take it."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()}
    atomic_write_bytes(path, save({name: _halved(v) for name, v in tensors.items()} if compact else tensors))


def _halved(value: Tensor) -> Tensor:
    """Return a value as a player's file stores it."""
    return value.half() if value.is_floating_point() else value.int()
