"""Presets of a training: the configurations of all its stages, by name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

from avatar.gaussians.sampling import SamplingConfig
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.teacher import NetworkPreset, network_preset
from avatar.models.student import StudentConfig
from avatar.training.engine.adam import LearningRates
from avatar.training.engine.optimization_task import PretrainConfig
from avatar.training.fit.fit import PRESETS, FitConfig
from avatar.training.fit_teacher import FitTeacherConfig
from avatar.training.student.bake import BakeConfig
from avatar.training.student.compensate import CompensateConfig
from avatar.training.tracking.config import JointConfig, Level, TrackConfig
from smplxpp.core.errors import require_choice

LOCAL_PARTS = 256
# Of the fit to a turn, chosen among five settings by two held-out photographs of a real person and what they look like:
# slower rates along the normal blur the silhouette, those of a rig leave spots on sides that one view shows.
_TURN_RATES = LearningRates(offset=5e-3, log_scales=1e-3, quats=2e-4, opacity_logits=3e-3)


def with_local_shapes(shapes: BlendShapeConfig) -> BlendShapeConfig:
    """Return local blend shapes instead of the paper's: each part of the Gaussians has its own coefficients."""
    return replace(shapes, parts=LOCAL_PARTS, head_shapes=5, body_shapes=11)


@dataclass(frozen=True, kw_only=True)
class TrainingPreset:
    """Configurations of all stages of a training.

    Attributes:
        networks: sizes of the teacher and the field.
        fit: the fit, which makes the Gaussians.
        teacher: training of the teacher.
        bake: training of the student's field.
        compensate: training of the student's blend shapes.
        blend_shapes: of the student.
        control_points: number of vertices on which the field is evaluated, see `StudentConfig`.
        still_body: the body's own surface follows its joints alone, see `StudentConfig`.
    """

    networks: NetworkPreset
    fit: FitConfig
    teacher: FitTeacherConfig
    bake: BakeConfig
    compensate: CompensateConfig
    blend_shapes: BlendShapeConfig
    control_points: int = 0
    still_body: bool = False

    def student(self) -> StudentConfig:
        """Return the student of the bake; the compensation adds the blend shapes."""
        return StudentConfig(self.networks.field, None, self.control_points, self.still_body)

    def with_seed(self, seed: int) -> TrainingPreset:
        """Return the preset with another seed in all trainings."""
        track, joint = self.teacher.track, self.teacher.joint
        return replace(
            self,
            fit=replace(self.fit, seed=seed, sampling=replace(self.fit.sampling, seed=seed)),
            teacher=replace(
                self.teacher,
                seed=seed,
                track=track and replace(track, seed=seed),
                joint=joint and replace(joint, seed=seed),
            ),
            bake=replace(self.bake, seed=seed),
            compensate=replace(self.compensate, seed=seed),
        )

    def for_turn(self, views: int) -> TrainingPreset:
        """Return the preset for a person who turns before one camera: a fit to its views, which follows the joints.

        Each place is seen in a view or two, so that free Gaussians would explain every photograph and leave gaps and
        spots between them: they start wider and denser, their places and shapes learn little, and their colours do not
        depend on the direction. What field and blend shapes learn of one held pose helps no other: they stay as they
        start, without effect.

        Args:
            views: number of training views of the fit.
        """
        turn_steps_a_view = 25  # 50 gain nothing on held-out views
        sampling = replace(self.fit.sampling, touch=0.8, opacity=0.95, sh_degree=0)
        fit = replace(self.fit, sampling=sampling, rates=_TURN_RATES, iterations=turn_steps_a_view * views)
        # Learning rate of what stays as it starts; at usual rates six steps cost held-out views 0.3 dB.
        still = 1e-9
        bake = replace(self.bake, iterations=1, pretrain=None, attributes=0.0, views=1, lr=still)
        compensate = replace(self.compensate, iterations=1, attributes=0.0, views=1, lr=still)
        compensate = replace(compensate, position_lr=still, color_lr=still)
        return replace(self, fit=fit, bake=bake, compensate=compensate)

    def shortened(self, share: float) -> TrainingPreset:
        """Return the preset with `share` of the iterations of every training."""

        def fewer(iterations: int) -> int:
            return max(1, round(share * iterations))

        track, joint = self.teacher.track, self.teacher.joint
        teacher = replace(self.teacher, track=track and track.shortened(share), joint=joint and joint.shortened(share))
        return replace(
            self,
            fit=replace(self.fit, iterations=fewer(self.fit.iterations)),
            teacher=with_iterations(teacher, fewer(teacher.iterations)),
            bake=with_iterations(self.bake, fewer(self.bake.iterations)),
            compensate=replace(self.compensate, iterations=fewer(self.compensate.iterations)),
        )


Pretrained = TypeVar("Pretrained", FitTeacherConfig, BakeConfig)


def with_iterations(config: Pretrained, iterations: int) -> Pretrained:
    """Return a configuration with other iterations, and as large a share of its pretraining."""
    # A training of half the steps has a pretraining of half the steps.
    pretrain = config.pretrain and config.pretrain.shortened(iterations / config.iterations)
    return replace(config, iterations=iterations, pretrain=pretrain)


_LEAN_WEIGHTS = ReconstructionWeights(perceptual=0.0, alpha=0.1)
# Squared differences only in the compensation: before textures are in place, their least squares solution is a blur.
_LAST_WEIGHTS = replace(_LEAN_WEIGHTS, l2=5.0)
# The best of 0 to 10 on three captures (docs/training_choices.md, "denser where photographs change").
_DETAIL = 2.0


@dataclass(frozen=True)
class _Steps:
    """A training: its iterations, the networks' rate, and that of the Gaussians' attributes in multiples of `rates`."""

    iterations: int
    lr: float
    attributes: float = 1.0


@dataclass(frozen=True)
class _Size:
    """Values in which the presets that track the surface differ.

    Attributes:
        gaussians: number of Gaussians.
        head_share: share of them on the head.
        control_points: of the tracking and of the field.
        track: levels of the tracking.
        body_motion_weight: see `TrackConfig`.
        tight_reach: see `TrackConfig`.
        joint: correction of all frames at once, see `FitTeacherConfig`; None: none.
        pretrain: the teacher's iterations before it sees photographs.
        field: pretraining of the student's field before the bake.
        fit: iterations of the fit.
        rates: learning rates of the fit.
        teacher: training of the teacher.
        bake: training of the field.
        compensate: training of the blend shapes; its rate is that of the mapping networks, U and C in proportion.
        averaged: share of the last steps of bake and compensation over which parameters are averaged.
        penalties: factor of the compensation's penalties of large and far Gaussians.
        surface_normals: see `PhotometricConfig`.
        perceptual: weight of the perceptual term.
        poses: in a step of teacher, bake and compensation.
        evaluations: of each of them on held-out views, for its log alone.
    """

    gaussians: int
    head_share: float
    control_points: int
    track: tuple[Level, ...]
    body_motion_weight: float
    tight_reach: float
    pretrain: int
    field: _Steps
    fit: int
    rates: LearningRates
    teacher: _Steps
    bake: _Steps
    compensate: _Steps
    averaged: float = 0.2
    penalties: float = 1.0
    joint: JointConfig | None = None
    surface_normals: bool = False
    perceptual: float = 0.0
    poses: tuple[int, int, int] = (1, 1, 1)
    evaluations: int = 6


def _tracked(name: str, size: _Size) -> TrainingPreset:
    """Make a preset in which the surface is tracked first and networks learn it before they see photographs.

    A teacher trained for minutes draws worse pictures than the photographs, so that the bake compares with photographs
    and takes from the teacher the tracked surface. Several views a step, attributes that learn in every stage.
    """
    weights = replace(_LEAN_WEIGHTS, perceptual=size.perceptual)
    # A step without rendering costs little, so that it has eight poses.
    pretrain = PretrainConfig(
        iterations=size.pretrain, batch=8, lr=1e-2, lr_final_factor=0.02, warmup=20, betas=(0.9, 0.99)
    )
    return TrainingPreset(
        networks=network_preset(name),
        fit=FitConfig(
            sampling=SamplingConfig(count=size.gaussians, head_share=size.head_share),
            detail=_DETAIL,
            iterations=size.fit,
            rates=size.rates,
        ),
        # Tracking, pretraining on the track, then photographs of three views a step.
        teacher=FitTeacherConfig(
            iterations=size.teacher.iterations,
            pretrain=pretrain,
            evaluations=size.evaluations,
            poses_per_step=size.poses[0],
            views=3,
            lr=size.teacher.lr,
            attributes=size.teacher.attributes,
            weights=weights,
            surface_normals=size.surface_normals,
            track=TrackConfig(
                levels=size.track,
                control_points=size.control_points,
                body_motion_weight=size.body_motion_weight,
                tight_reach=size.tight_reach,
                still_body=True,
            ),
            joint=size.joint,
        ),
        bake=BakeConfig(
            iterations=size.bake.iterations,
            # Many steps of few frames: with three times as many frames a step the field learned less in the same time.
            pretrain=replace(pretrain, iterations=size.field.iterations, batch=4, lr=size.field.lr),
            images="photographs",
            semantic=0.0,
            attributes=size.bake.attributes,
            regression=True,
            code_lr_factor=5.0,
            evaluations=size.evaluations,
            poses_per_step=size.poses[1],
            views=3,
            lr=size.bake.lr,
            null_share=0.2,
            averaged=size.averaged,
            weights=weights,
            surface_normals=size.surface_normals,
        ),
        # Rates of U and C in proportion to that of the mapping networks.
        compensate=CompensateConfig(
            iterations=size.compensate.iterations,
            evaluations=size.evaluations,
            poses_per_step=size.poses[2],
            views=3,
            lr=size.compensate.lr,
            position_lr=20.0 * size.compensate.lr,
            color_lr=size.compensate.lr,
            null_share=0.2,
            attributes=size.compensate.attributes,
            scale_penalty=size.penalties * CompensateConfig.scale_penalty,
            offset_penalty=size.penalties * CompensateConfig.offset_penalty,
            # At the usual rate highlights, above all of hair, are not learned in these steps.
            rates=LearningRates(sh=1e-3),
            init_from_track=True,
            coherence=200.0,
            averaged=size.averaged,
            weights=replace(_LAST_WEIGHTS, perceptual=size.perceptual),
            surface_normals=size.surface_normals,
        ),
        blend_shapes=BlendShapeConfig(jaw=True, gated=True),
        control_points=size.control_points,
        still_body=True,
    )


def _paper_small() -> TrainingPreset:
    """Make the paper's recipe in the minutes of `cpu`: no surface is tracked, the bake imitates the teacher.

    Losses, views and rates are those of `cpu` wherever the paper states none, so that the two differ in the recipe
    alone.
    """
    return TrainingPreset(
        networks=network_preset("paper-small"),
        fit=FitConfig(sampling=SamplingConfig(count=50_000, head_share=70 / 270), detail=_DETAIL, iterations=600),
        teacher=FitTeacherConfig(
            iterations=1500, pretrain=None, views=3, lr=2e-3, attributes=1.0, weights=_LEAN_WEIGHTS
        ),
        bake=BakeConfig(
            iterations=1200, semantic_map="mesh", views=3, lr=2e-3, code_lr_factor=5.0, weights=_LEAN_WEIGHTS
        ),
        compensate=CompensateConfig(iterations=1200, lr=1e-3, weights=_LAST_WEIGHTS),
        blend_shapes=BlendShapeConfig(),
        control_points=2400,
    )


TRAINING_PRESETS: dict[str, TrainingPreset] = {
    "paper": TrainingPreset(
        networks=network_preset("paper"),
        fit=PRESETS["paper"],
        teacher=FitTeacherConfig(),
        bake=BakeConfig(semantic_map="mesh"),
        compensate=CompensateConfig(),
        blend_shapes=BlendShapeConfig(),
    ),
    # What `cpu` does, with the Gaussians, perceptual term and poses a step of `paper`, and the steps of an hour or two
    # on a GPU. Sizes and rates were not chosen by measurements at this size.
    "gpu": _tracked(
        "gpu",
        _Size(
            gaussians=270_000,
            head_share=70 / 270,
            control_points=2400,
            track=TrackConfig().levels,
            body_motion_weight=1.0,
            tight_reach=0.04,
            joint=JointConfig(),
            pretrain=2000,
            field=_Steps(10_000, 3e-3),
            fit=10_000,
            rates=LearningRates(),
            # Ten times the steps of `cpu`, so that attributes need no higher rates than in the fit.
            teacher=_Steps(4000, 1e-3, 1.0),
            bake=_Steps(8000, 5e-4, 1.0),
            compensate=_Steps(20_000, 5e-4, 1.0),
            penalties=5.0,
            perceptual=ReconstructionWeights().perceptual,
            poses=(2, 2, 4),
        ),
    ),
    "paper-small": _paper_small(),
    "cpu": _tracked(
        "cpu",
        _Size(
            gaussians=50_000,
            head_share=70 / 270,
            control_points=2400,
            track=TrackConfig().levels,
            body_motion_weight=1.0,
            # Photographs do not determine where a plain shirt lies on the skin; without this it drifts.
            tight_reach=0.04,
            joint=JointConfig(),
            pretrain=350,
            field=_Steps(3000, 3e-3),
            fit=600,
            rates=LearningRates(),
            # At the usual rates Gaussians of hair end millimetres short of their place, which costs heads a decibel.
            teacher=_Steps(200, 2e-3, 3.0),
            bake=_Steps(900, 1e-3, 3.0),
            compensate=_Steps(2000, 1e-3, 2.0),
            # Light that leaks through from hidden places moves Gaussians farther at these rates.
            penalties=5.0,
        ),
    ),
    "demo": _tracked(
        "demo",
        _Size(
            # In pictures of 250 pixels a head has 30, too few for a quarter of the Gaussians.
            gaussians=22_000,
            head_share=0.15,
            control_points=800,
            track=(Level(1, 12, 5e-3), Level(0, 12, 2e-3)),
            # A pixel is 6 mm of the person: photographs do not show cloth 1 cm off the skin sliding by 2 mm.
            body_motion_weight=4.0,
            tight_reach=0.02,
            pretrain=100,
            field=_Steps(600, 2e-3),
            fit=150,
            # Few steps, of one view each: colours need a high rate.
            rates=LearningRates(dc=6e-3, offset=0.03),
            # Where poses are tracked, networks of few frames learn the poses' errors; colours, which all frames share,
            # do not. So networks learn slowly and in few steps after their pretraining, and colours fast.
            teacher=_Steps(125, 3e-4, 3.5),
            bake=_Steps(250, 3e-4, 2.0),
            # Faster networks overfit to the poses of few frames; 500 steps gain less than .1 dB on held-out views.
            compensate=_Steps(350, 1.5e-4, 2.0),
            averaged=0.6,
            # Seven cameras of 250 pixels show less of folds than the tracked surface.
            surface_normals=True,
            evaluations=1,
        ),
    ),
}


def training_preset(name: str) -> TrainingPreset:
    """Return the preset "paper", "gpu", "paper-small", "cpu" or "demo".

    Raises:
        InputError: another name.
    """
    require_choice("preset", name, tuple(TRAINING_PRESETS))
    return TRAINING_PRESETS[name]
