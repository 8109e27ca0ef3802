"""Where each vertex of the target meets the source, and whether that is believed."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy.spatial import cKDTree

from smplxpp.core.errors import GeometryWarning
from smplxpp.core.mesh import TriangleMesh, normalize_rows, row_lengths

# Beyond this angle a closest point faces against the target: an arm against the bodice beside it.
_AGAINST = np.radians(70.0)
# Lengths within which another point may take its place: as far as a confident match goes.
_NEAR_LENGTHS = 0.75


@dataclass(frozen=True)
class Correspondence:
    """The closest point of the source, or one near that faces better, for each of N target vertices.

    Attributes:
        face: (N,) source face.
        barycentric: (N, 3) weights of its corners, none negative, rows sum to 1.
        distance: (N,) metres.
        angle: (N,) radians between the normals, NaN where a normal is missing.
    """

    face: Int64[np.ndarray, " N"]
    barycentric: Float64[np.ndarray, "N 3"]
    distance: Float64[np.ndarray, " N"]
    angle: Float64[np.ndarray, " N"]

    def interpolate(self, source: TriangleMesh, values: Float[np.ndarray, "V D"]) -> Float64[np.ndarray, "N D"]:
        """The values at the closest points, from those at the source's vertices."""
        rows = np.repeat(np.arange(len(self.face)), 3)
        corners = source.faces[self.face].ravel()
        matrix = sp.csr_matrix((self.barycentric.ravel(), (rows, corners)), (len(self.face), source.vertex_count))
        return matrix @ values

    def matched(self, *, max_distance: float, max_angle: float) -> Bool[np.ndarray, " N"]:
        """The points near enough (metres) and facing the same way (radians)."""
        return (self.distance <= max_distance) & (self.angle <= max_angle)


def closest_points(source: TriangleMesh, target: TriangleMesh) -> Correspondence:
    """Closest point of `source` for every vertex of `target`, in float64.

    Normals are weighted by angle on both meshes and interpolated on the source. Of several points
    as close as each other (borders of two layers that coincide) the first that the tree finds is taken.
    """
    points = np.ascontiguousarray(target.vertices)
    squared, face, closest = igl.point_mesh_squared_distance(points, source.vertices, source.faces)
    # The tree counts in C's `long long`, another type to numpy even where it is as wide.
    face = face.astype(np.int64)
    corners = source.faces[face]
    barycentric = _barycentric(closest, *(source.vertices[corners[:, k]] for k in range(3)))
    found = Correspondence(face, barycentric, np.sqrt(squared), np.full(len(face), np.nan))
    ours, theirs = target.vertex_normals, normalize_rows(found.interpolate(source, source.vertex_normals))
    angle = _angles(ours, theirs)
    missing = ~(ours.any(axis=1) & theirs.any(axis=1))
    angle[missing] = np.nan
    return Correspondence(face, barycentric, np.sqrt(squared), angle)


def prefer_facing(
    found: Correspondence,
    source: TriangleMesh,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    *,
    length: float,
) -> Correspondence:
    """Where the closest point faces another way, a near point that faces the same way, if there is one.

    What a garment covers lies behind it and faces as it does; a hand beside a skirt, the arm beside a bodice faces
    against it, however near, and the back of that hand lies before the cloth. For vertices whose closest point faces
    more than 70 degrees away, the face is taken whose centre y and normal n' minimise
    `|x - length n / 2 - y|^2 + length^2 |n - n'|^2`, and its point nearest to x, if x is outside of it, it is no
    farther than 3/4 `length` and faces better; so an opposite normal costs as much as `2 length` of distance. A
    lining, which faces against all that is near, keeps its closest point.

    Args:
        points, normals: of the target, turned outwards. length: metres.
    """
    rows = np.flatnonzero(~(found.angle <= _AGAINST) & normals.any(axis=1))
    if not len(rows):
        return found
    x, n = points[rows], normals[rows]
    tree = cKDTree(np.hstack([source.face_centers, length * source.face_normals]))
    face = tree.query(np.hstack([x - 0.5 * length * n, length * n]), workers=-1)[1]
    corners = source.faces[face]
    barycentric = _barycentric(x, *(source.vertices[corners[:, k]] for k in range(3)))
    there = Correspondence(face, barycentric, np.empty(len(rows)), np.empty(len(rows)))
    offset = x - there.interpolate(source, source.vertices)
    theirs = normalize_rows(there.interpolate(source, source.vertex_normals))
    distance, angle = row_lengths(offset), _angles(n, theirs)
    better = ~(angle >= found.angle[rows]) & (np.einsum("ij,ij->i", offset, theirs) >= 0)
    better &= distance <= _NEAR_LENGTHS * length
    out = {name: getattr(found, name).copy() for name in ("face", "barycentric", "distance", "angle")}
    for name, value in (("face", face), ("barycentric", barycentric), ("distance", distance), ("angle", angle)):
        out[name][rows[better]] = value[better]
    return Correspondence(**out)


def face_outward(
    found: Correspondence, target: TriangleMesh, component: Int32[np.ndarray, " N"], *, max_distance: float
) -> tuple[Correspondence, Float64[np.ndarray, "N 3"]]:
    """Turn the normals of components that are inside out: most of their near vertices face against the source.

    Args:
        component: (N,) ids. max_distance: metres, which vertices are near.

    Returns:
        The correspondence with the angles turned, and (N, 3) the target's normals, turned alike.
    """
    near = found.distance <= max_distance
    against = near & (found.angle > np.pi / 2)
    count = int(component.max(initial=-1)) + 1
    outward = np.bincount(component, near & (found.angle <= np.pi / 2), minlength=count)
    size = np.bincount(component, minlength=count)
    inward = np.bincount(component, against, minlength=count)
    turned = ((inward > 2 * outward) & (inward > 0.1 * size))[component]
    if not turned.any():
        return found, target.vertex_normals
    warnings.warn(
        f"target mesh: {int(turned.sum())} of {len(turned)} vertices lie in components that are inside out; "
        "their normals are turned for matching",
        GeometryWarning,
        stacklevel=3,
    )
    angle = np.where(turned, np.pi - found.angle, found.angle)
    return replace(found, angle=angle), np.where(turned[:, None], -1.0, 1.0) * target.vertex_normals


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Radians between unit vectors."""
    # arctan2 keeps its precision at small angles, where arccos of a rounded cosine does not.
    return np.arctan2(row_lengths(np.cross(a, b)), np.einsum("ij,ij->i", a, b))


def _barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Weights of points on triangles (Ericson 2004, 3.4); on a triangle without area, along its longest edge."""
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = (np.einsum("ij,ij->i", x, y) for x, y in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    det = uu * vv - uv * uv
    flat = det <= 1e-14 * np.maximum(uu, vv) ** 2
    safe = np.where(flat, 1.0, det)
    beta, gamma = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    along_u = flat & (uu >= vv)
    along_v = flat & ~along_u
    beta = np.where(flat, np.where(along_u, wu / np.where(uu > 0, uu, 1.0), 0.0), beta)
    gamma = np.where(flat, np.where(along_v, wv / np.where(vv > 0, vv, 1.0), 0.0), gamma)
    weights = np.clip(np.stack([1.0 - beta - gamma, beta, gamma], axis=1), 0.0, None)
    return weights / weights.sum(axis=1, keepdims=True)
