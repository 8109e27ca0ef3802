"""The metrics of a model: images, surfaces, speed and size."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "Speed": "avatar.metrics.speed",
    "SurfaceQuality": "avatar.metrics.surface_quality",
    "ViewQuality": "avatar.metrics.view_quality",
    "mean_quality": "avatar.metrics.view_quality",
    "measure_speed": "avatar.metrics.speed",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.metrics", _EXPORTS)
