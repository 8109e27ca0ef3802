"""Differentiable rasterisation: one signature, the backend chosen by the tensors' device."""

from avatar.rendering.api import rasterize
from avatar.rendering.settings import RasterMeta, RasterSettings

__all__ = ["RasterMeta", "RasterSettings", "rasterize"]
