"""Optimisation: from a template and images to Gaussians."""

from avatar.training.fit_config import PRESETS, FitConfig, LearningRates
from avatar.training.fit_reference import FitResult, FitScene, choose_device, fit_reference
from avatar.training.gradient_task import DivergedError
from avatar.training.loop import Progress
from avatar.training.quality import ViewQuality, mean_quality
from avatar.training.views import View, read_views

__all__ = [
    "PRESETS",
    "DivergedError",
    "FitConfig",
    "FitResult",
    "FitScene",
    "LearningRates",
    "Progress",
    "View",
    "ViewQuality",
    "choose_device",
    "fit_reference",
    "mean_quality",
    "read_views",
]
