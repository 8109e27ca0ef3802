"""Configuration of a fit of Gaussians to one frame, and presets that differ in time and detail."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from avatar.gaussians.sampling import SamplingConfig
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.training.engine.learning_rates import LearningRates
from avatar.training.engine.photometric_task import PhotometricConfig
from smplxpp.core.errors import require_between


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Choices of a fit of Gaussians to one frame.

    Attributes:
        sampling: number and distribution of the Gaussians.
        detail: additional density where the photographs change quickly, see `density_of_detail`; 0, as in the paper:
            one density.
        iterations: number of steps; each renders one view.
        rates: learning rates of the attributes.
        dssim: share of `1 - SSIM` in the loss; the rest is L1.
        alpha: weight of the L1 distance of rendered opacity and mask. Without it dark hair on a black background could
            become holes.
        scale_penalty: weight of GaussianAvatars' penalty of large scales.
        offset_penalty: weight of GaussianAvatars' penalty of large offsets.
        eps2d: blur of every Gaussian by the rasteriser, pixels squared. 1/12 is the variance of a pixel's own square;
            the 0.3 of viewers widens silhouettes by a pixel, so that the surface shrinks to meet the masks.
        margin: pixels kept around the silhouette of a training view.
        evaluations: number of evaluations, evenly spaced.
        seed: of the views' order; `sampling` has the seed of the Gaussians' places.
    """

    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    detail: float = 0.0
    iterations: int = 800
    rates: LearningRates = field(default_factory=LearningRates)
    dssim: float = 0.2
    alpha: float = 0.1
    scale_penalty: float = 1.0
    offset_penalty: float = 1.0
    eps2d: float = 0.1
    margin: int = 12
    evaluations: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least, most in (
            ("detail", 0.0, math.inf),
            ("iterations", 1, math.inf),
            ("dssim", 0.0, 1.0),
            ("alpha", 0.0, math.inf),
            ("scale_penalty", 0.0, math.inf),
            ("offset_penalty", 0.0, math.inf),
            ("eps2d", 0.0, math.inf),
            ("margin", 0, math.inf),
            ("evaluations", 1, math.inf),
            ("seed", 0, math.inf),
        ):
            require_between(f"fit: {name}", getattr(self, name), least, most)

    def photometric(self) -> PhotometricConfig:
        """Return what the fit shares with the other trainings on photographs: everything but the start."""
        # The loss of all trainings, without normals and perceptual term.
        # (1 - s) L1 + s D-SSIM as in 3DGS, with the opacity term that keeps dark hair on a black background.
        return PhotometricConfig(
            iterations=self.iterations,
            scale_penalty=self.scale_penalty,
            offset_penalty=self.offset_penalty,
            schedule="exponential",
            attributes=1.0,
            rates=self.rates,
            weights=ReconstructionWeights(
                l1=1.0 - self.dssim, dssim=self.dssim, perceptual=0.0, normal=0.0, alpha=self.alpha
            ),
            eps2d=self.eps2d,
            betas=(0.9, 0.99),
            evaluations=self.evaluations,
            seed=self.seed,
        )


PRESETS: dict[str, FitConfig] = {
    "quick": FitConfig(sampling=SamplingConfig(count=60_000), iterations=200),
    "default": FitConfig(sampling=SamplingConfig(count=150_000), iterations=800),
    "paper": FitConfig(sampling=SamplingConfig(count=270_000, head_share=70 / 270), iterations=10_000),
}
"""quick shows whether all fits together; default ends where a dozen cameras have no more to give to views held out;
paper has the numbers that TaoAvatar states (270k Gaussians, 10k iterations); docs/training.md lists the others."""
