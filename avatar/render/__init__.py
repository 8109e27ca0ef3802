"""Differentiable rasterisation: one signature, the backend chosen by the tensors' device."""

from avatar.render.api import rasterize
from avatar.render.settings import RasterMeta, RasterSettings

__all__ = ["RasterMeta", "RasterSettings", "rasterize"]
