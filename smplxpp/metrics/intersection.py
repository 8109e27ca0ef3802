"""Penetration of one layer into another: signed distance to a body that is neither closed nor one piece."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from smplxpp.core import InputError, MeshLike, TriangleMesh, as_mesh, require_at_least
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.metrics.distance import MM

# Nearer to the surface than this share of the mesh's size the sign of the distance is rounding.
SIGN_RESOLUTION = 1e-6


@dataclass(frozen=True, eq=False)
class PenetrationReport:
    """Points of an outer layer against an inner surface.

    Attributes:
        count: points nearer to the inside than `clearance_mm` asks.
        fraction: of all points.
        depth_mean_mm, depth_max_mm: of the missing distance `clearance - signed distance` over those points; 0 if none.
        clearance_mm: asked for.
        signed_distance: (N,) float64 metres, negative inside.
        penetrating: (N,) bool.
    """

    count: int
    fraction: float
    depth_mean_mm: float
    depth_max_mm: float
    clearance_mm: float
    signed_distance: Float64[np.ndarray, " N"]
    penetrating: Bool[np.ndarray, " N"]

    def as_dict(self) -> dict:
        """Return the scalar figures as a dictionary for JSON."""
        names = ("count", "fraction", "depth_mean_mm", "depth_max_mm", "clearance_mm")
        return {name: getattr(self, name) for name in names}


def signed_distance(
    points: Float[np.ndarray, "P 3"], mesh: MeshLike
) -> tuple[Float64[np.ndarray, " P"], Float64[np.ndarray, "P 3"], Int64[np.ndarray, " P"]]:
    """Signed distance (P,) of (P, 3) points to `mesh`, negative inside; closest points (P, 3) and faces (P,).

    Inside is where the generalised winding number is above 1/2, the distance is to the outer surface
    (`SignedDistanceField`): a body has open borders, eyes and teeth inside the head and limbs that overlap, where the
    normal of the closest face answers wrongly.

    Raises:
        InputError: NaN or infinite points, another shape, a mesh without area or wound inside out.
    """
    mesh = as_mesh(mesh, subject="mesh")
    found = SignedDistanceField(mesh, solid=True).query(points)
    return found.distance, found.closest, found.face


def penetration(
    outer: TriangleMesh | Float[np.ndarray, "N 3"], inner: MeshLike, *, clearance: float = 0.0
) -> PenetrationReport:
    """How far vertices of `outer` (a mesh, or points (N, 3)) lie inside `inner` or nearer than `clearance` metres.

    Raises:
        InputError: no points, as `signed_distance`, or a clearance that is negative or not finite.
    """
    inner = as_mesh(inner, subject="inner mesh")
    points = outer.vertices if isinstance(outer, TriangleMesh) else np.asarray(outer, dtype=np.float64)
    if not len(points):
        raise InputError("outer layer", expected="points", received="none")
    require_at_least("clearance in metres", clearance, 0.0)
    signed, _, _ = signed_distance(points, inner)
    # A margin relative to the size of the mesh, below which the sign of a distance is round-off.
    penetrating = signed < clearance - SIGN_RESOLUTION * inner.bbox_diagonal
    depth = (clearance - signed[penetrating]) * MM
    return PenetrationReport(
        count=int(penetrating.sum()),
        fraction=float(penetrating.mean()),
        depth_mean_mm=float(depth.mean()) if len(depth) else 0.0,
        depth_max_mm=float(depth.max(initial=0.0)),
        clearance_mm=clearance * MM,
        signed_distance=signed,
        penetrating=penetrating,
    )
