"""Reconstruct a person's surface from photographs, cameras and masks: soft visual hull, then a sweep along the normals.

>>> found = reconstruct([PhotoView(name, camera, photograph, mask), ...])
>>> found.mesh, found.colors, found.seen, found.confidence
"""

from smplxpp.reconstruct.reconstruct import ReconstructConfig, Reconstruction, adopt_surface, reconstruct
from smplxpp.reconstruct.sweep import SweepLevel
from smplxpp.reconstruct.views import Box, PhotoView, silhouette_agreement, usable_views

__all__ = [
    "Box",
    "PhotoView",
    "ReconstructConfig",
    "Reconstruction",
    "SweepLevel",
    "adopt_surface",
    "reconstruct",
    "silhouette_agreement",
    "usable_views",
]
