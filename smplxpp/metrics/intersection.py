"""Penetration of one layer into another: signed distance to a body that may be open, and volumes that solids share."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core import InputError, MeshLike, PointsLike, as_array, as_mesh, as_points, require_at_least
from smplxpp.core.errors import one_line
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.solids import solid_of_mesh
from smplxpp.metrics.comparison import MM

CM3 = 1e6
"""Cubic centimetres in a cubic metre."""


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

    __repr__ = one_line

    def as_dict(self) -> dict:
        """Return the scalar figures as a dictionary for JSON."""
        names = ("count", "fraction", "depth_mean_mm", "depth_max_mm", "clearance_mm")
        return {name: getattr(self, name) for name in names}


def signed_distance(
    points: PointsLike, mesh: MeshLike
) -> tuple[Float64[np.ndarray, " P"], Float64[np.ndarray, "P 3"], Int64[np.ndarray, " P"]]:
    """Signed distance (P,) of (P, 3) points to `mesh`, negative inside; closest points (P, 3) and faces (P,).

    Inside is where the generalised winding number is above 1/2, the distance is to the outer surface
    (`SignedDistanceField`): a body has open borders, eyes and teeth inside the head and limbs that overlap, where the
    normal of the closest face answers wrongly.

    Raises:
        InputError: NaN or infinite points, another shape, a mesh without area or wound inside out.
    """
    mesh = as_mesh(mesh, subject="mesh")
    found = SignedDistanceField(mesh, solid=True).query(as_points(points)[0])
    return found.distance, found.closest, found.face


def penetration(outer: PointsLike, inner: MeshLike, *, clearance: float = 0.0) -> PenetrationReport:
    """How far vertices of `outer` (a mesh, or points (N, 3)) lie inside `inner` or nearer than `clearance` metres.

    Raises:
        InputError: no points, as `signed_distance`, or a clearance that is negative or not finite.
    """
    # Nearer to the surface than this share of the mesh's size the sign of the distance is rounding.
    sign_resolution = 1e-6
    inner = as_mesh(inner, subject="inner mesh")
    points = as_array(outer) if isinstance(outer, np.ndarray) else as_points(outer, subject="outer layer")[0]
    if not len(points):
        raise InputError("outer layer", expected="points", received="none")
    require_at_least("clearance in metres", clearance, 0.0)
    signed, _, _ = signed_distance(points, inner)
    # A margin relative to the size of the mesh, below which the sign of a distance is round-off.
    penetrating = signed < clearance - sign_resolution * inner.bbox_diagonal
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


@dataclass(frozen=True)
class Interpenetration:
    """Volume and surface that two solids share.

    Attributes:
        volume_cm3: of what lies in both.
        share: of the smaller one's volume; 0 where it has none.
        volume_a_cm3, volume_b_cm3: of the two.
    """

    volume_cm3: float
    share: float
    volume_a_cm3: float
    volume_b_cm3: float

    def as_dict(self) -> dict:
        """Return the numbers as a dictionary for JSON."""
        return asdict(self)


def interpenetration(a: MeshLike, b: MeshLike) -> Interpenetration:
    """The volume of the intersection of two closed meshes in metres.

    An open surface has no volume: give it a thickness first (`smplxpp.clean.thickened`), or close it. Where a surface
    cuts itself, what it encloses twice counts once or twice.

    Raises:
        InputError: a mesh that is open, not manifold, or encloses nothing.
    """
    a = as_mesh(a, subject="first surface")
    b = as_mesh(b, subject="second surface")
    first, second = solid_of_mesh(a, subject="first surface"), solid_of_mesh(b, subject="second surface")
    shared = max((first ^ second).volume(), 0.0)
    smaller = min(first.volume(), second.volume())
    return Interpenetration(
        volume_cm3=shared * CM3,
        share=shared / smaller if smaller > 0 else 0.0,
        volume_a_cm3=first.volume() * CM3,
        volume_b_cm3=second.volume() * CM3,
    )
