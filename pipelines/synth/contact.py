"""Contacts of cloth particles with a moving surface: one plane a particle, found anew at every tick."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int

from smplxpp.core.mesh import TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.signed_distance import SignedDistanceField, barycentric_coordinates

# Particles farther than this from the surface make no contact in the coming tick (metres).
REACH = 0.025
# Closer than this the direction to the closest point is noise: the surface's normal stands for it.
_NEAR = 0.002


@dataclass(frozen=True, eq=False)
class Contacts:
    """K planes that follow a surface.

    Attributes:
        particle: index of the particle.
        corners, barycentric: vertices of the surface and weights of them: the closest point.
        normal: unit, from the surface towards the side that the particle belongs on.
        margin: metres to keep.
    """

    particle: Int[np.ndarray, " K"]
    corners: Int[np.ndarray, "K 3"]
    barycentric: Float[np.ndarray, "K 3"]
    normal: Float[np.ndarray, "K 3"]
    margin: float

    def points(self, surface: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "K 3"]:
        """Return the closest points on moved surface vertices."""
        b = self.barycentric
        return sum(b[:, k : k + 1] * surface.take(self.corners[:, k], axis=0) for k in range(3))

    def resolve(
        self,
        position: Float[np.ndarray, "N 3"],
        previous: Float[np.ndarray, "N 3"],
        surfaces: tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"]],
        friction: float,
    ) -> None:
        """Move `position`, in place, out of the surface; Coulomb friction against the surface's own motion.

        `surfaces` are its vertices before and after the step, `previous` the particles before it.
        """
        before, after = (self.points(surface) for surface in surfaces)
        at = position.take(self.particle, axis=0)
        depth = self.margin - np.einsum("ki,ki->k", at - after, self.normal)
        hit = np.flatnonzero(depth > 0)
        if not len(hit):
            return
        particle, normal, depth = self.particle[hit], self.normal[hit], depth[hit]
        slip = at[hit] - previous.take(particle, axis=0) - (after[hit] - before[hit])
        slip -= np.einsum("ki,ki->k", slip, normal)[:, None] * normal
        held = np.minimum(1.0, friction * depth / np.maximum(row_lengths(slip), 1e-12))
        position[particle] = at[hit] + depth[:, None] * normal - held[:, None] * slip


def body_contacts(
    surface: TriangleMesh,
    cloth: TriangleMesh,
    particles: Int[np.ndarray, " P"],
    *,
    margin: float,
    deepest: float = 0.05,
) -> Contacts:
    """Find contacts of the cloth's `particles` with a closed surface; those deeper than `deepest` metres are left.

    The side is told by the interpolated vertex normal at the closest point: a body's skin is smooth at that scale.
    Skin that faces the cloth's outer side makes no contact: where an arm lies on the flank, what the cloth covers
    decides alone, or it would be torn between the two.
    """
    points = cloth.vertices
    tree = igl.AABB()
    tree.init(surface.vertices, surface.faces)
    squared, face, closest = tree.squared_distance(
        surface.vertices, surface.faces, np.ascontiguousarray(points[particles])
    )
    offset, distance = points[particles] - closest, np.sqrt(squared)
    face = np.asarray(face)
    bary = barycentric_coordinates(closest, surface.triangles[face])
    corners = surface.faces[face]
    normal = normalize_rows(np.einsum("kc,kcd->kd", bary, surface.vertex_normals[corners]))
    side = np.where(np.einsum("ki,ki->k", offset, normal) < 0, -1.0, 1.0)
    far = distance > _NEAR
    normal[far] = (side[far] / distance[far])[:, None] * offset[far]
    covers = np.einsum("ki,ki->k", surface.face_normals[face], cloth.vertex_normals[particles]) > -0.3
    kept = (side * distance < REACH) & (side * distance > -deepest) & covers
    return Contacts(particles[kept], corners[kept], bary[kept], normal[kept], margin)


def sheet_contacts(
    sheet: TriangleMesh, cloth: TriangleMesh, particles: Int[np.ndarray, " P"], *, margin: float, deepest: float = 0.02
) -> Contacts:
    """Find contacts of the cloth's `particles` with the outer side of an open sheet; nothing beyond its border."""
    where = SignedDistanceField(sheet, solid=False).query(cloth.vertices[particles])
    kept = (where.distance < REACH) & (where.distance > -deepest) & ~where.on_border
    face = where.face[kept]
    return Contacts(
        particles[kept],
        sheet.faces[face],
        barycentric_coordinates(where.closest[kept], sheet.triangles[face]),
        where.gradient[kept],
        margin,
    )


def depths(surface: TriangleMesh, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    """Return how deep points lie inside a closed surface, metres; 0 outside. Winding numbers tell the sides exactly."""
    return np.maximum(-SignedDistanceField(surface, solid=True).query(points).distance, 0.0)
