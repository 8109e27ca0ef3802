"""Configurations of the surface tracking and of the joint correction of all frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from avatar.losses.reconstruction import ReconstructionWeights
from avatar.training.engine.photometric_task import PhotometricConfig
from avatar.training.fit.fit import FitConfig
from smplxpp.core import InputError, require_at_least, require_positive


@dataclass(frozen=True)
class Level:
    """A resolution of the photographs and the steps of a frame at it.

    Attributes:
        halvings: of the photographs' size.
        steps: of Adam.
        lr: learning rate at the first step, metres; it falls exponentially to a tenth (`track.LEVEL_DECAY`).
    """

    halvings: int
    steps: int
    lr: float


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Choices of the tracking. The loss and its terms are described in `avatar.training.tracking`.

    Attributes:
        levels: from coarse to fine. In coarse images stripes melt into one colour, so that silhouettes dominate.
        control_points: K, number of control points on the template.
        views: cameras a step.
        smoothness: weight of the mean squared difference of neighbouring control points' displacements, after the
            predicted shape is subtracted, 1/m^2.
        strain_weight: weight of the mean squared strain of simulated clothes; without `simulate` there is none. Cloth
            hardly stretches, and where a pattern is matched a period off, it does on one side. Five times as much slows
            a swing down.
        prior_weight: weight of the Gaussian prior of simulated clothes about their prediction, along the surface in
            directions that photographs do not determine (along stripes; any on plain cloth), 1/m^2.
        body_motion_weight: weight of the mean displacement of control points off the clothes, 1/m. Parameters locate
            the body better than few pixels do. Not applied to a template without clothes.
        still_body: the body's own surface follows its joints alone, because poses locate it better than photographs of
            a few hundred pixels. Not applied to a template that is a body alone.
        tight_reach: distance from the skin in the T-pose, metres, within which clothes share the body's penalty,
            falling linearly to 0 there. 0: none do.
        extrapolation: share of the velocity of the two frames before with which a frame starts.
        simulate: use simulated clothes as predictions, weighted by their errors in the frames before; needs `reference`
            and the capture's frame rate.
        weights: of the photometric loss.
        segment_frames: frames of a segment at most. Longer motions are split, and segments run side by side.
        run_in: frames before a segment that are tracked with it and thrown away, so that it forgets how it began: the
            prediction keeps e^-4 of an error over 24 frames at 20 a second.
        seam: distance, metres, of two segments' clothes in frames that both have, 95th percentile over the vertices,
            above which the later segment is tracked again from where the earlier one ended, until they meet.
        back: track back from the last frames to the first too, at all levels but the finest, and measure the drift.
        reference: frame on which the template was built, tracked first; None: the first training frame comes first.
        seed: of the order of views.
    """

    levels: tuple[Level, ...] = (Level(2, 40, 10e-3), Level(1, 16, 6e-3), Level(0, 20, 3e-3))
    control_points: int = 2400
    views: int = 4
    smoothness: float = 80.0
    strain_weight: float = 1.0
    prior_weight: float = 1500.0
    body_motion_weight: float = 0.0
    tight_reach: float = 0.0
    still_body: bool = False
    extrapolation: float = 1.0
    simulate: bool = True
    weights: ReconstructionWeights = field(
        default_factory=lambda: ReconstructionWeights(perceptual=0.0, normal=0.0, alpha=0.5)
    )
    segment_frames: int = 250
    run_in: int = 24
    seam: float = 0.01
    back: bool = False
    reference: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.levels or any(level.steps < 1 or level.halvings < 0 or level.lr <= 0 for level in self.levels):
            raise InputError("tracking: levels", expected="one or more, each with steps", received=str(self.levels))
        for name, least in (
            ("control_points", 1),
            ("views", 1),
            ("smoothness", 0),
            ("strain_weight", 0),
            ("prior_weight", 0),
            ("body_motion_weight", 0),
            ("tight_reach", 0),
            ("extrapolation", 0),
            ("segment_frames", 1),
            ("run_in", 1),
            ("seam", 0),
        ):
            require_at_least(f"tracking: {name}", getattr(self, name), least)

    @property
    def steps(self) -> int:
        """Number of steps of one frame, over all levels."""
        return sum(level.steps for level in self.levels)

    def shortened(self, share: float) -> TrackConfig:
        """Return the configuration with `share` of the steps of every level."""
        levels = tuple(replace(level, steps=max(1, round(share * level.steps))) for level in self.levels)
        return replace(self, levels=levels)

    def coarse(self) -> TrackConfig:
        """Return the configuration without its finest level, if it has others."""
        return replace(self, levels=self.levels[:-1] or self.levels)


@dataclass(frozen=True, kw_only=True)
class JointConfig:
    """Choices of the joint correction (`joint.correct_jointly`): by the fit's losses and rates.

    Attributes:
        control_points: number of control points on the template.
        iterations: number of views at least; with fewer, Gaussians have not settled.
        frame_iterations: views of each training frame at least.
        poses: frames a step.
        views: cameras of each frame; posing it costs as much as drawing it once. Steps of n views are n times fewer,
            at sqrt(n) times the rates.
        lr: learning rate of the corrections at the start, metres; it falls exponentially to a tenth.
        smoothness: weight of the mean squared difference of neighbouring control points' corrections, 1/m^2.
        tight_reach: distance from the naked body in the T-pose, metres, from which clothes are corrected in full;
            nearer ones in proportion; 0: all in full. What a tight shirt gains in training frames, new poses lose.
        seed: of the order of views.

    Example:
        >>> from avatar.training.presets import training_preset
        >>> cpu = training_preset("cpu")
        >>> without = replace(cpu, teacher=replace(cpu.teacher, joint=None))  # for `avatar.train`
    """

    control_points: int = 6000
    iterations: int = 3000
    frame_iterations: int = 60
    poses: int = 1
    views: int = 3
    lr: float = 1e-3
    smoothness: float = 1000.0
    tight_reach: float = 0.04
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (
            ("control_points", 1),
            ("iterations", 1),
            ("frame_iterations", 0),
            ("poses", 1),
            ("views", 1),
            ("smoothness", 0),
            ("tight_reach", 0),
            ("seed", 0),
        ):
            require_at_least(f"joint correction: {name}", getattr(self, name), least)
        require_positive("joint correction: lr", self.lr)

    def steps(self, frames: int) -> int:
        """Return the number of steps of a motion."""
        return math.ceil(max(self.iterations, self.frame_iterations * frames) / self.looks)

    @property
    def looks(self) -> int:
        """Number of views a step."""
        return self.poses * self.views

    @property
    def rate(self) -> float:
        """Factor on the rates of a step of one view."""
        return math.sqrt(self.looks)

    def photometric(self, frames: int) -> PhotometricConfig:
        """Return the fit's losses and rates with the steps of a motion."""
        return replace(
            FitConfig().photometric(),
            iterations=self.steps(frames),
            poses_per_step=self.poses,
            views=self.views,
            attributes=self.rate,
            evaluations=1,
            seed=self.seed,
        )

    def shortened(self, share: float) -> JointConfig:
        """Return the configuration with `share` of the steps."""
        return replace(
            self,
            iterations=max(1, round(share * self.iterations)),
            frame_iterations=round(share * self.frame_iterations),
        )
