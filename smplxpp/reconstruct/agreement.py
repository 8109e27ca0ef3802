"""How well a surface fills the masks that it is seen by."""

from __future__ import annotations

from collections.abc import Sequence

from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct.views import INSIDE, PhotoView


def silhouette_agreement(mesh: TriangleMesh, views: Sequence[PhotoView]) -> dict[str, float]:
    """Intersection over union of the surface's silhouette and the mask, by view; 0 where both are empty."""
    out = {}
    for view in views:
        drawn, mask = rasterize_mesh(mesh, view.camera).mask, view.opacity > INSIDE
        union = int((drawn | mask).sum())
        out[view.name] = float((drawn & mask).sum()) / union if union else 0.0
    return out
