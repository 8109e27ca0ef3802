"""What decides how a surface is followed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from avatar.losses.reconstruction import ReconstructionWeights
from smplxpp.core.errors import InputError
from smplxpp.core.validation import require_at_least


@dataclass(frozen=True)
class Level:
    """A part of the steps of a frame.

    Attributes:
        halvings: of the images. steps: of Adam. lr: metres, at its first step; it falls to `LEVEL_END` of that.
    """

    halvings: int
    steps: int
    lr: float


LEVEL_END = 0.1


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Choices of the tracking.

    Attributes:
        levels: from coarse to fine. Stripes melt into one colour in coarse images, and silhouettes lead.
        control_points: on the template. views: cameras a step.
        smoothness: weight of the mean squared difference of neighbouring control points' displacements from the shape
            that is foreseen, a square metre.
        held: weight of the mean squared distance of simulated clothes from where they were foreseen, a square metre, in
            the directions along the surface in which pictures do not tell: along stripes, and any on plain cloth.
        body_motion_weight: weight of the mean distance that control points off the clothes move, a metre:
            parameters say where the body is, and few pixels cannot tell better. Not applied to a template without
            clothes.
        still_body: the body's own surface follows its joints alone: poses say better where it is than photographs of a
            few hundred pixels do. Not applied to a template that is a body alone.
        tight_reach: metres from the skin, in the T-pose, within which clothes take part in that, the more the nearer:
            what lies on the body goes where the body goes. 0: no clothes do.
        extrapolation: share of the motion between the two frames before that a frame starts with.
        simulate: let simulated clothes say where frames start and what shape they are smooth about, the more the better
            they told the frames before; where `reference` and the capture's frames a second are known.
        weights: of the losses.
        back: follow the surface back from the last frames to the first too, in all sizes of images but the finest, and
            measure how far from its start it ends.
        reference: frame whose surface the template is, to begin with; None: no training frame's, and the first one
            comes first.
        seed: of the order of views.
    """

    levels: tuple[Level, ...] = (Level(2, 20, 5e-3), Level(1, 16, 4e-3), Level(0, 20, 2e-3))
    control_points: int = 2400
    views: int = 4
    smoothness: float = 80.0
    held: float = 1500.0
    body_motion_weight: float = 0.0
    tight_reach: float = 0.0
    still_body: bool = False
    extrapolation: float = 1.0
    simulate: bool = True
    weights: ReconstructionWeights = field(
        default_factory=lambda: ReconstructionWeights(perceptual=0.0, normal=0.0, alpha=0.5)
    )
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
            ("held", 0),
            ("body_motion_weight", 0),
            ("tight_reach", 0),
            ("extrapolation", 0),
        ):
            require_at_least(f"tracking: {name}", getattr(self, name), least)

    @property
    def steps(self) -> int:
        """Steps of one frame."""
        return sum(level.steps for level in self.levels)

    def shortened(self, share: float) -> TrackConfig:
        """Return the same with `share` of the steps of every level."""
        levels = tuple(replace(level, steps=max(1, round(share * level.steps))) for level in self.levels)
        return replace(self, levels=levels)

    def coarse(self) -> TrackConfig:
        """Return the same without the finest images, where there are others."""
        return replace(self, levels=self.levels[:-1] or self.levels)
