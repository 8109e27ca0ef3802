"""Configuration of the refinement of poses: unknowns, noise, priors and resolution levels."""

from __future__ import annotations

from dataclasses import dataclass, field

from avatar.gaussians.sampling import SamplingConfig
from smplxpp.core import InputError, require_at_least, require_positive


@dataclass(frozen=True)
class Level:
    """A resolution of the photographs and the passes at it.

    Attributes:
        halvings: of the photographs' size.
        steps: Gauss-Newton steps; each one is a pass over all frames and cameras.
    """

    halvings: int
    steps: int


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """Choices of a refinement of poses.

    Attributes:
        sampling: Gaussians that carry the appearance, one colour each.
        reference_levels: levels of the reference frame alone, which comes first.
        levels: levels of all frames, from coarse to fine.
        jaw: refine the jaw too.
        expression: refine the expression too.
        hands: refine the fingers too.
        cameras: correct the training cameras' poses too; the mean correction is zero, intrinsics stay.
        robust: scale s of the Geman-McClure kernel, a difference of colours in [0, 1].
        alpha: weight of the squared difference of opacity and mask, relative to a colour channel.
        pixel_sigma: standard deviation of a pixel's colour.
        pixels_per_error: number of full-size pixels with one common error.
        rotation_sigma: standard deviation of a joint's start, degrees.
        translation_sigma: standard deviation of the start's translation, metres.
        expression_sigma: standard deviation of the start's expression coefficients.
        camera_rotation_sigma: standard deviation of a camera's rotation, degrees.
        camera_translation_sigma: standard deviation of a camera's position, metres at the person.
        acceleration_sigma: scale of a joint's acceleration, degrees a frame squared at 20 frames a second; it falls
            with the square of the frame rate. Accelerations above twice the scale cost little (Student's t), so that
            fast motion is kept.
        translation_acceleration_sigma: the same for the translation, metres a frame squared.
        reach: distance from the skin over which the rigidity of clothes falls to 1/e, metres.
        chunk_frames: frames whose sums are computed together; several processes share the chunks of a take.
        seed: of the Gaussians' positions.
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
    chunk_frames: int = 200
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
        require_at_least("refinement: chunk_frames", self.chunk_frames, 1)
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
