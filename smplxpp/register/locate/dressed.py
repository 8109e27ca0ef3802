"""A dressed surface about a body: skin lies on it, clothes, hair and shoes lie outside, near as they mostly are."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import barycentric_coordinates
from smplxpp.core.surface_points import SurfacePoints, position_normal_features
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.locate.cover import SKIN_COVER, Expected
from smplxpp.register.locate.drape import NO_CELL, Drape
from smplxpp.register.locate.proxy import BodyProxy, outer_vertices, regions
from smplxpp.register.normal_equations import NormalEquations
from smplxpp.register.robust import geman_mcclure

_FACING = 0.3


@dataclass(frozen=True, eq=False)
class Match:
    """The body's nearest place to N points of a surface.

    Attributes:
        corners, bary: the place. distance: metres, positive outside the body. normal: the body's there.
        facing: cosine between both normals. region, cell: of the place; see `Drape`.
    """

    corners: Int64[np.ndarray, "N 3"]
    bary: Float64[np.ndarray, "N 3"]
    distance: Float64[np.ndarray, " N"]
    normal: Float64[np.ndarray, "N 3"]
    facing: Float64[np.ndarray, " N"]
    region: Int64[np.ndarray, " N"]
    cell: Int64[np.ndarray, " N"]


class OuterBody:
    """The part of a body that can be seen, and nearest places on it."""

    def __init__(self, kinematics: Kinematics) -> None:
        body = kinematics.body
        self.kinematics, self.points = kinematics, BodyPoints.of_vertices(body, np.arange(body.vertex_count))
        outer = np.zeros(body.vertex_count, dtype=bool)
        outer[outer_vertices(body)] = True
        self.faces = body.faces[outer[body.faces].all(axis=1)]
        self.region, self.drape = regions(body), Drape.of(body)

    def mesh(self, posture: Posture) -> TriangleMesh:
        """The posed body without what lies inside."""
        return TriangleMesh(self.kinematics.points(self.points, posture), self.faces)

    def match(self, mesh: TriangleMesh, surface: SurfacePoints) -> Match:
        """The nearest place to each point.

        Args:
            mesh: of a posture.
        """
        tree = igl.AABB()
        tree.init(mesh.vertices, mesh.faces)
        squared, face, closest = tree.squared_distance(mesh.vertices, mesh.faces, np.ascontiguousarray(surface.points))
        face = np.asarray(face).reshape(-1)
        corners = mesh.faces[face]
        bary = barycentric_coordinates(closest, mesh.vertices[corners])
        normal = np.einsum("nc,ncx->nx", bary, mesh.vertex_normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        side = np.where(np.einsum("nx,nx->n", surface.points - closest, normal) < 0, -1.0, 1.0)
        near = corners[np.arange(len(corners)), np.argmax(bary, axis=1)]
        return Match(
            corners,
            bary,
            side * np.sqrt(np.asarray(squared).reshape(-1)),
            normal,
            np.einsum("nx,nx->n", normal, surface.normals),
            self.region[near],
            self.drape.cell[near],
        )


@dataclass
class Dressed:
    """Distances of a surface's points to the body as `Expected` and `Drape` say; hands and face also the other way.

    Attributes:
        skin: which of the surface's points are bare skin for sure.
        reach: beyond it skin counts less and less. count: independent points that all of them stand for.
    """

    outer: OuterBody
    bare: BodyProxy
    surface: SurfacePoints
    skin: np.ndarray
    reach: float = 0.03
    count: float = 1000.0
    inside: float = 0.004

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add what is seen."""
        found = self.outer.match(self.outer.mesh(posture), self.surface)
        expected, drape = Expected.over(found.region, self.skin), self.outer.drape
        residual = found.distance - expected.gap
        wide = np.maximum(self.reach * expected.skin, 2.5 * expected.spread)
        weight = (found.facing > _FACING) * expected.weight / expected.spread**2 * self.count / len(self.surface)
        below = (found.distance < 0) & ~expected.skin
        worn = np.flatnonzero((found.cell != NO_CELL) & ~expected.skin & ~below)
        alone = np.setdiff1d(np.arange(len(residual)), worn)
        cell, off = found.cell[worn], np.zeros(len(residual))
        off[worn] = drape.offsets(cell, residual[worn], weight[worn], wide[worn])
        weight *= geman_mcclure(residual - off, wide)
        inside = geman_mcclure(found.distance, 3 * self.reach) / self.inside**2 * self.count / len(self.surface)
        weight, residual = np.where(below, inside, weight), np.where(below, found.distance, residual)
        points = self.outer.points.mixed(found.corners, found.bary)
        jacobian = equations.columns.jacobian(kinematics.motion(points, posture))
        rows = np.einsum("nx,nxp->np", -found.normal, jacobian, optimize=True)
        root = np.sqrt(weight[alone])
        equations.add(0, rows[alone] * root[:, None], residual[alone] * root, shape=True)
        equations.add(0, *drape.eliminated(cell, weight[worn], rows[worn], residual[worn]), shape=True)
        self._add_bare(equations, kinematics, posture)

    def _add_bare(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """The body's bare points to the surface, along the surface's normal."""
        motion = kinematics.motion(self.bare.points, posture)
        _, normals = self.bare.posed(kinematics, posture)
        _, nearest = self.surface.tree.query(position_normal_features(motion.points, normals))
        apart, normal = motion.points - self.surface.points[nearest], self.surface.normals[nearest]
        residual = np.einsum("nx,nx->n", apart, normal)
        facing = np.einsum("nx,nx->n", normals, normal) > _FACING
        distance = np.linalg.norm(apart, axis=1)
        weight = facing * geman_mcclure(distance, self.reach) / SKIN_COVER.spread**2 * self.count / 4000
        jacobian = equations.columns.jacobian(motion)
        rows = np.einsum("nx,nxp->np", normal, jacobian, optimize=True) * np.sqrt(weight)[:, None]
        equations.add(0, rows, residual * np.sqrt(weight), shape=True)
