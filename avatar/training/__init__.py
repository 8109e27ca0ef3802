"""Optimisation: from a template and photographs to Gaussians, a teacher and a student."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "ClothConfig": "avatar.training.loose_clothes",
    "LooseClothes": "avatar.training.loose_clothes",
    "Recipe": "avatar.training.recipe",
    "STEPS": "avatar.training.recipe",
    "TRAINING_PRESETS": "avatar.training.presets",
    "TrainConfig": "avatar.training.recipe",
    "TrainScene": "avatar.training.scene",
    "TrainingPreset": "avatar.training.presets",
    "UnfinishedTrainingError": "avatar.training.train",
    "find_garments": "avatar.training.loose_clothes",
    "prepare_scene": "avatar.training.scene",
    "training_preset": "avatar.training.presets",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.training", _EXPORTS)
