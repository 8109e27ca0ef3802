"""Differentiable rasterisation: one signature, the backend chosen by the tensors' device."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "RasterMeta": "avatar.rendering.settings",
    "RasterSettings": "avatar.rendering.settings",
    "Rendering": "avatar.rendering.avatar_view",
    "rasterize": "avatar.rendering.api",
    "render": "avatar.rendering.avatar_view",
    "render_view": "avatar.rendering.avatar_view",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.rendering", _EXPORTS)
