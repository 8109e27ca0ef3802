"""Losses that trainings minimise, and the image metrics that they report."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "PerceptualDistance": "avatar.losses.perceptual",
    "ReconstructionWeights": "avatar.losses.reconstruction",
    "Target": "avatar.losses.reconstruction",
    "load_metric": "avatar.losses.perceptual_weights",
    "reconstruction_loss": "avatar.losses.reconstruction",
    "ssim_map": "avatar.losses.image_similarity",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.losses", _EXPORTS)
