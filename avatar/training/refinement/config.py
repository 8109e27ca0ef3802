"""What decides a refinement of poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from avatar.gaussians.sampling import SamplingConfig
from smplxpp.core.errors import InputError
from smplxpp.core.validation import require_at_least, require_positive

CLOTH_FACTORS: Mapping[str, float] = {"upper": 1.0, "lower": 0.5, "outer": 0.5}
"""How firmly clothes of a label sit where they touch the skin; body, hair and shoes sit with 1."""


@dataclass(frozen=True)
class Level:
    """A part of the steps.

    Attributes:
        halvings: of the photographs. steps: passes over all frames and cameras.
    """

    halvings: int
    steps: int


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """Choices of a refinement.

    Attributes:
        sampling: Gaussians that carry the appearance, one colour each.
        levels: of all frames, from coarse to fine. reference_levels: of the reference frame alone, which comes first.
        jaw, expression, hands: refine them beside the body's joints and the translation.
        cameras: correct the training cameras' poses too; the mean correction is zero, intrinsics stay.
        robust: difference of colours from which a pixel counts ever less (Geman-McClure).
        alpha: weight of the difference between opacity and mask, against a channel of colour.
        pixel_sigma: difference of colours that a pixel is trusted to.
        pixels_per_error: neighbouring pixels err together: so many full-size pixels count as one.
        rotation_sigma: degrees that a joint of the start is trusted to; translation_sigma: metres;
            expression_sigma: coefficients. camera_rotation_sigma, camera_translation_sigma: degrees, and metres at
            the person.
        acceleration_sigma: degrees a frame squared that a joint turns unevenly by, at 20 frames a second (it falls
            with the square of the frame rate); translation_acceleration_sigma: metres. Beyond twice as much the
            motion is taken for true (Student-t), so that fast motion stays.
        reach: metres from the skin over which the pull of clothes on the body falls to 1/e.
        seed: of the Gaussians' places.
    """

    sampling: SamplingConfig = field(
        default_factory=lambda: SamplingConfig(count=30_000, head_share=0.15, sh_degree=0, opacity=0.95)
    )
    reference_levels: tuple[Level, ...] = (Level(3, 3), Level(2, 2), Level(1, 2))
    levels: tuple[Level, ...] = (Level(3, 2), Level(2, 2), Level(1, 2), Level(0, 3))
    jaw: bool = True
    expression: bool = True
    hands: bool = False
    cameras: bool = False
    robust: float = 0.5
    alpha: float = 0.5
    pixel_sigma: float = 0.05
    pixels_per_error: float = 4000.0
    rotation_sigma: float = 1.0
    translation_sigma: float = 0.008
    expression_sigma: float = 0.1
    camera_rotation_sigma: float = 0.2
    camera_translation_sigma: float = 0.005
    acceleration_sigma: float = 0.4
    translation_acceleration_sigma: float = 0.003
    reach: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        for level in (*self.reference_levels, *self.levels):
            if level.halvings < 0 or level.steps < 1:
                raise InputError(
                    "refinement: levels", expected="halvings of 0 or more, 1 step or more", received=str(level)
                )
        if not self.levels:
            raise InputError("refinement: levels", expected="one or more", received="none")
        require_at_least("refinement: alpha", self.alpha, 0.0)
        for name in _POSITIVE:
            require_positive(f"refinement: {name}", getattr(self, name))


_POSITIVE = (
    "robust",
    "pixel_sigma",
    "pixels_per_error",
    "rotation_sigma",
    "translation_sigma",
    "expression_sigma",
    "camera_rotation_sigma",
    "camera_translation_sigma",
    "acceleration_sigma",
    "translation_acceleration_sigma",
    "reach",
)
