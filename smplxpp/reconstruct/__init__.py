"""A person's surface from photographs, cameras and masks: soft visual hull, then a search along the normals.

>>> found = reconstruct([PhotoView(name, camera, photograph, mask), ...])
>>> found.mesh, found.colors, found.seen, found.confidence
"""

from smplxpp.reconstruct.config import ReconstructConfig, SweepLevel
from smplxpp.reconstruct.reconstruct import Reconstruction, adopt_surface, reconstruct
from smplxpp.reconstruct.views import PhotoView

__all__ = ["PhotoView", "ReconstructConfig", "Reconstruction", "SweepLevel", "adopt_surface", "reconstruct"]
