"""Evaluate avatars: images, surface, speed and size, measured by the same rules for every model."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "EvalReport": "avatar.evaluation.report",
    "Evaluation": "avatar.evaluation.evaluate",
    "EvaluationConfig": "avatar.evaluation.evaluate",
    "ProtocolConfig": "avatar.evaluation.protocol",
    "evaluate_models": "avatar.evaluation.evaluate",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.evaluation", _EXPORTS)
