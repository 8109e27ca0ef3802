"""Baselines: other kinds of avatars with our rasteriser, data and losses, so that tables compare the models alone."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "Baseline": "avatar.baselines.avatar_base",
    "make_baseline": "avatar.baselines.build",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.baselines", _EXPORTS)
