"""A neural surface over the visual hull: signed distance on hash grids, fitted to photographs by volume rendering."""

from avatar.reconstruct.fit_surface import SurfaceConfig, SurfaceFit, fit_surface
from avatar.reconstruct.neural_surface import NeuralSurface

__all__ = ["NeuralSurface", "SurfaceConfig", "SurfaceFit", "fit_surface"]
