"""Other kinds of avatars in the same harness: our rasteriser, data and losses, so that a table compares ideas alone."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "Baseline": "avatar.baselines.avatar_base",
    "make_baseline": "avatar.baselines.build",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.baselines", _EXPORTS)
