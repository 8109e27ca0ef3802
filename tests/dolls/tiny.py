"""Networks and stages so small that a doll's training takes a second."""

from __future__ import annotations

from avatar.gaussians.sampling import SamplingConfig
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.networks.teacher import NetworkPreset, TeacherConfig
from avatar.training.engine.optimization_task import PretrainConfig
from avatar.training.fit.fit import FitConfig
from avatar.training.fit_teacher import FitTeacherConfig
from avatar.training.presets import TrainingPreset
from avatar.training.student.bake import BakeConfig
from avatar.training.student.compensate import CompensateConfig
from avatar.training.tracking.config import Level, TrackConfig

TINY_TEACHER = TeacherConfig(
    in_size=16,
    out_size=32,
    bottleneck=4,
    channel_base=64,
    channel_max=8,
    style_size=4,
    style_layers=1,
    networks="shared",
    noise=False,
    zero_output=True,
)
TINY_FIELD = FieldConfig(width=8, hidden_layers=1, frequencies=2, code_size=4)


def tiny_preset(iterations: int = 3) -> TrainingPreset:
    """All stages in a second, on 500 Gaussians."""
    teacher = TeacherConfig(
        networks="shared",
        in_size=32,
        out_size=64,
        bottleneck=8,
        channel_base=64,
        channel_max=8,
        style_size=8,
        style_layers=1,
        noise=False,
        zero_output=True,
    )
    track = TrackConfig(levels=(Level(0, 2, 2e-3),), control_points=60, views=2)
    shared = {
        "iterations": iterations,
        "evaluations": 1,
        "evaluated": 1,
        "null_share": 0.2,
        "weights": ReconstructionWeights(perceptual=0.0, alpha=0.1),
    }
    return TrainingPreset(
        networks=NetworkPreset(teacher, FieldConfig(width=16, hidden_layers=2, code_size=4)),
        fit=FitConfig(sampling=SamplingConfig(count=500), iterations=iterations, margin=4),
        teacher=FitTeacherConfig(
            **{k: v for k, v in shared.items() if k != "null_share"},
            pretrain=PretrainConfig(iterations=2, batch=2),
            lr=2e-3,
            attributes=0.5,
            track=track,
        ),
        bake=BakeConfig(**shared, lr=2e-3, views=2, pretrain=PretrainConfig(iterations=2, batch=3), regression=True),
        compensate=CompensateConfig(**shared, lr=2e-3, poses_per_step=1, views=2),
        blend_shapes=BlendShapeConfig(head_shapes=2, body_shapes=3, width=8, jaw=True),
    )
