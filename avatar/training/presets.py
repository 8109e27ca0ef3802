"""Everything that `smplxpp train` decides, under one name."""

from __future__ import annotations

from dataclasses import dataclass, replace

from avatar.gaussians.sampling import SamplingConfig
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.blend_shapes import BlendShapeConfig
from avatar.models.config import require_choice
from avatar.models.presets import NetworkPreset, network_preset
from avatar.models.student import StudentConfig
from avatar.training.bake import BakeConfig
from avatar.training.compensate import CompensateConfig
from avatar.training.fit_config import PRESETS, FitConfig
from avatar.training.fit_teacher import FitTeacherConfig
from avatar.training.track import TrackConfig


@dataclass(frozen=True, kw_only=True)
class TrainingPreset:
    """Configurations of all stages.

    Attributes:
        networks: sizes of the teacher and the field.
        fit: the reference fit, which makes the Gaussians.
        teacher, bake, compensate: the three trainings.
        blend_shapes: of the student. control_points: see `StudentConfig`.
    """

    networks: NetworkPreset
    fit: FitConfig
    teacher: FitTeacherConfig
    bake: BakeConfig
    compensate: CompensateConfig
    blend_shapes: BlendShapeConfig
    control_points: int = 0

    def student(self) -> StudentConfig:
        """Of the bake; the compensation adds the blend shapes."""
        return StudentConfig(self.networks.field, None, self.control_points)

    def seeded(self, seed: int) -> TrainingPreset:
        """The same with another seed everywhere."""
        track = self.teacher.track
        return replace(
            self,
            fit=replace(self.fit, seed=seed, sampling=replace(self.fit.sampling, seed=seed)),
            teacher=replace(self.teacher, seed=seed, track=track and replace(track, seed=seed)),
            bake=replace(self.bake, seed=seed),
            compensate=replace(self.compensate, seed=seed),
        )

    def shortened(self, share: float) -> TrainingPreset:
        """The same with `share` of the iterations of every training."""

        def fewer(iterations: int) -> int:
            return max(1, round(share * iterations))

        return replace(
            self,
            fit=replace(self.fit, iterations=fewer(self.fit.iterations)),
            teacher=replace(
                self.teacher, iterations=fewer(self.teacher.iterations), pretrain=round(share * self.teacher.pretrain)
            ),
            bake=replace(self.bake, iterations=fewer(self.bake.iterations), pretrain=round(share * self.bake.pretrain)),
            compensate=replace(self.compensate, iterations=fewer(self.compensate.iterations)),
        )


_LEAN_WEIGHTS = ReconstructionWeights(perceptual=0.0, alpha=0.1)


def _lean(name: str, *, count: int, fit: int, teacher: int, bake: int, compensate: int) -> TrainingPreset:
    """Presets for two cores: several views a step, attributes that learn in every stage, no perceptual term."""
    return TrainingPreset(
        networks=network_preset(name),
        fit=FitConfig(sampling=SamplingConfig(count=count), iterations=fit),
        teacher=FitTeacherConfig(
            iterations=teacher,
            pretrain=teacher // 2,
            views=3,
            rate=3e-3,
            attributes=0.3,
            weights=_LEAN_WEIGHTS,
            track=TrackConfig(),
        ),
        bake=BakeConfig(iterations=bake, pretrain=bake // 2, views=2, rate=2e-3, null_share=0.2, weights=_LEAN_WEIGHTS),
        compensate=CompensateConfig(
            iterations=compensate, items=1, views=2, rate=1e-3, null_share=0.2, attributes=0.2, weights=_LEAN_WEIGHTS
        ),
        blend_shapes=BlendShapeConfig(jaw=True),
    )


TRAINING_PRESETS: dict[str, TrainingPreset] = {
    "paper": TrainingPreset(
        networks=network_preset("paper"),
        fit=PRESETS["paper"],
        teacher=FitTeacherConfig(),
        bake=BakeConfig(),
        compensate=CompensateConfig(),
        blend_shapes=BlendShapeConfig(),
    ),
    "gpu": TrainingPreset(
        networks=network_preset("gpu"),
        fit=PRESETS["paper"],
        teacher=FitTeacherConfig(iterations=60_000, pretrain=0, rate=1e-3, attributes=0.2, amp=True),
        bake=BakeConfig(iterations=10_000, null_share=0.1),
        compensate=CompensateConfig(iterations=15_000, null_share=0.1),
        blend_shapes=BlendShapeConfig(jaw=True),
    ),
    "cpu": _lean("cpu", count=50_000, fit=300, teacher=1200, bake=1200, compensate=1200),
    "demo": _lean("demo", count=15_000, fit=100, teacher=100, bake=100, compensate=400),
}


def training_preset(name: str) -> TrainingPreset:
    """The preset "paper", "gpu", "cpu" or "demo".

    Raises:
        InputError: another name.
    """
    require_choice("preset", name, tuple(TRAINING_PRESETS))
    return TRAINING_PRESETS[name]
