"""Compare a body with the dressed surface around it: the term that fits it, and the misfit that ranks candidates.

The term `Dressed` sums over points of the surface, with d the signed distance to the nearest place of the body, gap and
spread of its region (`COVERS`), and b the offset of its cell of cloth (`ClothOffsets`):

    skin               GM(d - gap; reach) / spread^2
    cloth, outside     GM(d - gap - b; 2.5 spread) / spread^2, weighted by region, with b eliminated
    inside the body    GM(d; 3 reach) / (4 mm)^2, whatever lies there

and, in the other direction, over points of the body's hands and face: `GM(distance; reach) (n . (v - p))^2 / (3 mm)^2`
with p the nearest point of the surface and n its normal. GM is the robust weight of Geman and McClure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import barycentric_coordinates
from smplxpp.core.surface_points import SurfacePoints, position_normal_features
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.landmarks import visible_vertices
from smplxpp.register.locate.cloth_offsets import NO_CELL, SKIN_COVER, ClothOffsets, CoverPrior
from smplxpp.register.locate.proxy import BodyProxy, Region, regions
from smplxpp.register.normal_equations import NormalEquations, geman_mcclure

# Cosine between the normals of body and surface, from which points of both can correspond.
_FACING = 0.3
_BARE = (Region.HAND, Region.FACE)
# Parts that the scan of a whole person shows, with their joints.
PARTS = {
    "head": "head",
    "left hand": "left_wrist",
    "right hand": "right_wrist",
    "left forearm": "left_elbow",
    "right forearm": "right_elbow",
    "left lower leg": "left_knee",
    "right lower leg": "right_knee",
    "left foot": "left_ankle",
    "right foot": "right_ankle",
}


@dataclass(frozen=True, eq=False)
class Match:
    """The nearest places of a body to N points of a surface.

    Attributes:
        corners: vertices of the face in which the place lies.
        bary: barycentric coordinates of the place.
        distance: metres, positive outside the body.
        normal: unit normal of the body at the place.
        facing: cosine between the normals of body and surface.
        region: `Region` of the place.
        cell: cell of cloth over the place; see `ClothOffsets`.
    """

    corners: Int64[np.ndarray, "N 3"]
    bary: Float64[np.ndarray, "N 3"]
    distance: Float64[np.ndarray, " N"]
    normal: Float64[np.ndarray, "N 3"]
    facing: Float64[np.ndarray, " N"]
    region: Int64[np.ndarray, " N"]
    cell: Int64[np.ndarray, " N"]


class OuterBody:
    """The visible part of a body, on which nearest places are searched."""

    def __init__(self, kinematics: Kinematics) -> None:
        body = kinematics.body
        self.kinematics, self.points = kinematics, BodyPoints.of_vertices(body, np.arange(body.vertex_count))
        outer = np.zeros(body.vertex_count, dtype=bool)
        outer[visible_vertices(body)] = True
        self.faces = body.faces[outer[body.faces].all(axis=1)]
        self.region, self.offsets = regions(body), ClothOffsets.of(body)

    def mesh(self, posture: Posture) -> TriangleMesh:
        """Return the posed body without eyes, teeth and tongue."""
        return TriangleMesh(self.kinematics.points(self.points, posture), self.faces)

    def match(self, mesh: TriangleMesh, surface: SurfacePoints) -> Match:
        """Find the nearest place of the body to each point of a surface.

        Args:
            mesh: the posed body.
            surface: points with normals.
        """
        tree = igl.AABB()
        tree.init(mesh.vertices, mesh.faces)
        squared, face, closest = tree.squared_distance(mesh.vertices, mesh.faces, np.ascontiguousarray(surface.points))
        face = np.asarray(face).reshape(-1)
        corners = mesh.faces[face]
        bary = barycentric_coordinates(closest, mesh.vertices[corners])
        normal = np.einsum("nc,ncx->nx", bary, mesh.vertex_normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        # The sign of the distance comes from the interpolated normal; the region from the nearest corner.
        side = np.where(np.einsum("nx,nx->n", surface.points - closest, normal) < 0, -1.0, 1.0)
        near = corners[np.arange(len(corners)), np.argmax(bary, axis=1)]
        return Match(
            corners,
            bary,
            side * np.sqrt(np.asarray(squared).reshape(-1)),
            normal,
            np.einsum("nx,nx->n", normal, surface.normals),
            self.region[near],
            self.offsets.cell[near],
        )


@dataclass
class Dressed:
    """The term of a dressed surface; see the module's docstring.

    Attributes:
        outer: the visible body.
        bare: points of its hands and face, which are compared with the surface too.
        surface: points of the scan.
        skin: whether a point of the surface is known to be bare skin.
        reach: cutoff of skin, metres.
        count: number of independent points that the whole surface counts as.
        inside: standard deviation of a point inside the body, metres.
    """

    outer: OuterBody
    bare: BodyProxy
    surface: SurfacePoints
    skin: np.ndarray
    reach: float = 0.03
    count: float = 1000.0
    inside: float = 0.004

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add the term to the normal equations of one posture."""
        # Distances minus the mean gap, with the weights of the prior.
        found = self.outer.match(self.outer.mesh(posture), self.surface)
        expected, offsets = CoverPrior.over(found.region, self.skin), self.outer.offsets
        residual = found.distance - expected.gap
        wide = np.maximum(self.reach * expected.skin, 2.5 * expected.spread)
        weight = (found.facing > _FACING) * expected.weight / expected.spread**2 * self.count / len(self.surface)
        # Points of cloth outside the body share the offset of their cell; all others stand alone.
        below = (found.distance < 0) & ~expected.skin
        worn = np.flatnonzero((found.cell != NO_CELL) & ~expected.skin & ~below)
        alone = np.setdiff1d(np.arange(len(residual)), worn)
        cell, off = found.cell[worn], np.zeros(len(residual))
        off[worn] = offsets.offsets(cell, residual[worn], weight[worn], wide[worn])
        # Robust weights about the most likely offsets; points inside the body have a weight of their own.
        weight *= geman_mcclure(residual - off, wide)
        inside = geman_mcclure(found.distance, 3 * self.reach) / self.inside**2 * self.count / len(self.surface)
        weight, residual = np.where(below, inside, weight), np.where(below, found.distance, residual)
        # Jacobian of the distances: the place moves with the body, d(distance) = -n . dx.
        points = self.outer.points.mixed(found.corners, found.bary)
        jacobian = equations.columns.jacobian(kinematics.motion(points, posture, equations.columns.joints))
        rows = np.einsum("nx,nxp->np", -found.normal, jacobian, optimize=True)
        root = np.sqrt(weight[alone])
        equations.add(0, rows[alone] * root[:, None], residual[alone] * root, shape=True)
        equations.add(0, *offsets.eliminated(cell, weight[worn], rows[worn], residual[worn]), shape=True)
        self._add_bare(equations, kinematics, posture)

    def _add_bare(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add the distances of the body's hands and face to the surface, along its normal."""
        motion = kinematics.motion(self.bare.points, posture, equations.columns.joints)
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


@dataclass(frozen=True)
class Misfit:
    """How badly a body and a surface explain each other; lower is better.

    Attributes:
        surface: mean truncated distance of the surface's points to the body, metres.
        bare: mean truncated distance of the body's hands, face and feet to the surface, metres.
        covered: share of the surface that the body explains.
        shown: share of the body's hands, face and feet that the surface shows.
        parts: share of each of `PARTS` that the surface shows.
        unexplained: whether a point of the surface is farther from the body than any cloth.
    """

    surface: float
    bare: float
    covered: float
    shown: float
    parts: Mapping[str, float]
    unexplained: Bool[np.ndarray, " N"] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def total(self) -> float:
        """The mean of both directions, metres."""
        return 0.5 * (self.surface + self.bare)


def misfit(
    kinematics: Kinematics, outer: OuterBody, proxy: BodyProxy, surface: SurfacePoints, posture: Posture
) -> Misfit:
    """Measure how well a posture and a surface explain each other.

    Distances are truncated at 4 cm. Over hands and face the distance itself counts; elsewhere cloth may stand off 2.5
    cm for free, and depth inside the body counts double.
    """
    cap, loose_cloth = 0.04, 0.025  # metres
    # From the surface to the body.
    found = outer.match(outer.mesh(posture), surface)
    tight = np.isin(found.region, _BARE)
    loose = np.where(found.distance < 0, -2.0 * found.distance, np.maximum(found.distance - loose_cloth, 0.0))
    each = np.minimum(np.where(tight, np.abs(found.distance), loose), cap)
    each[found.facing < 0.0] = cap
    # From hands, face and feet of the body to the surface, along its normal where it is near.
    points, normals = proxy.posed(kinematics, posture)
    shown = np.isin(proxy.region, (*_BARE, Region.FOOT))
    _, nearest = surface.tree.query(position_normal_features(points, normals))
    apart = points - surface.points[nearest]
    along = np.einsum("nx,nx->n", apart, surface.normals[nearest])
    distance = np.linalg.norm(apart, axis=1)
    off = np.minimum(np.where(distance < cap, np.abs(along), distance), cap)
    facing = np.einsum("nx,nx->n", normals, surface.normals[nearest])
    off[facing < _FACING] = cap
    return Misfit(
        float(each.mean()),
        float(off[shown].mean()),
        float((each < cap).mean()),
        float((off[shown] < cap).mean()),
        {name: float((off[rows] < cap).mean()) for name, rows in _rows_of_parts(kinematics, proxy).items()},
        each >= cap,
    )


def _rows_of_parts(kinematics: Kinematics, proxy: BodyProxy) -> dict[str, np.ndarray]:
    """Return the points of each part: those of its joint, and of its descendants for head, hands and feet."""
    names = list(kinematics.body.joint_names)
    out = {}
    for part, joint in PARTS.items():
        index = names.index(joint)
        whole = part.split()[-1] in ("head", "hand", "foot")
        limbs = kinematics.descends_from[:, index] if whole else np.arange(len(names)) == index
        out[part] = np.flatnonzero(limbs[proxy.limb])
    return out
