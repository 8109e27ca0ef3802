"""Match each vertex of the target to the source: closest points, outward normals, components without a match."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy.spatial import cKDTree

from smplxpp.core import GeometryWarning, InputError, TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.mesh import cross_rows
from smplxpp.core.topology import component_labels
from smplxpp.transfer.config import TransferConfig


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
        """Interpolate values of the source's vertices at the closest points."""
        rows = np.repeat(np.arange(len(self.face)), 3)
        corners = source.faces[self.face].ravel()
        matrix = sp.csr_matrix((self.barycentric.ravel(), (rows, corners)), (len(self.face), source.vertex_count))
        return matrix @ values

    def instead(self, rows: Bool[np.ndarray, " N"], other: Correspondence) -> Correspondence:
        """Return these points with those of `other` in some rows."""
        names = ("face", "barycentric", "distance", "angle")
        values = {name: getattr(self, name).copy() for name in names}
        for name in names:
            values[name][rows] = getattr(other, name)[rows]
        return Correspondence(**values)

    def matched(self, *, max_distance: float, max_angle: float) -> Bool[np.ndarray, " N"]:
        """Return the points that are near enough (metres) and whose normals agree (radians)."""
        return (self.distance <= max_distance) & (self.angle <= max_angle)


def closest_points(
    source: TriangleMesh, target: TriangleMesh, *, among: Bool[np.ndarray, " V"] | None = None
) -> Correspondence:
    """Find the closest point of `source`, or of its faces `among` some vertices, for every vertex of `target`.

    Normals are weighted by angle on both meshes and interpolated on the source. Of several points
    as close as each other (borders of two layers that coincide) the first that the tree finds is taken.
    """
    points = np.ascontiguousarray(target.vertices)
    chosen = np.arange(source.face_count) if among is None else np.flatnonzero(among[source.faces].all(axis=1))
    squared, face, closest = igl.point_mesh_squared_distance(points, source.vertices, source.faces[chosen])
    # The tree counts in C's `long long`, another type to numpy even where it is as wide.
    face = chosen[face.astype(np.int64)]
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
    """Replace closest points that face another direction by near points that face the same direction, where possible.

    The body below a garment faces as the garment does. A hand beside a skirt or the arm beside a bodice faces against
    it, however near it is, and the back of that hand lies outside of the cloth. For vertices whose closest point faces
    more than 70 degrees away, take the face whose centre y and normal n' minimise

        |x - length n / 2 - y|^2 + length^2 |n - n'|^2

    and its point nearest to x, if x lies outside of it, it is no farther than 3/4 `length` (as far as a confident match
    may be) and it faces better. So an opposite normal costs as much as `2 length` of distance. A lining, which faces
    against all that is near, keeps its closest point.

    Args:
        found: closest points.
        source: the body.
        points: the target's vertices, metres.
        normals: of the target, outward.
        length: metres.
    """
    rows = np.flatnonzero(~(found.angle <= np.radians(70.0)) & normals.any(axis=1))
    if not len(rows):
        return found
    # Search positions and scaled normals together: one nearest neighbour in six dimensions.
    x, n = points[rows], normals[rows]
    tree = cKDTree(np.hstack([source.face_centers, length * source.face_normals]))
    face = tree.query(np.hstack([x - 0.5 * length * n, length * n]))[1]
    # Find the point of that face nearest to the vertex, and the angle there.
    corners = source.faces[face]
    barycentric = _barycentric(x, *(source.vertices[corners[:, k]] for k in range(3)))
    there = Correspondence(face, barycentric, np.empty(len(rows)), np.empty(len(rows)))
    offset = x - there.interpolate(source, source.vertices)
    theirs = normalize_rows(there.interpolate(source, source.vertex_normals))
    distance, angle = row_lengths(offset), _angles(n, theirs)
    # Take it only where it lies below the cloth, is near and faces better.
    better = ~(angle >= found.angle[rows]) & (np.einsum("ij,ij->i", offset, theirs) >= 0)
    better &= distance <= 0.75 * length
    out = {name: getattr(found, name).copy() for name in ("face", "barycentric", "distance", "angle")}
    for name, value in (("face", face), ("barycentric", barycentric), ("distance", distance), ("angle", angle)):
        out[name][rows[better]] = value[better]
    return Correspondence(**out)


def face_outward(
    found: Correspondence, target: TriangleMesh, component: Int32[np.ndarray, " N"], *, max_distance: float
) -> tuple[Correspondence, Float64[np.ndarray, "N 3"]]:
    """Flip the normals of components that are inside out.

    A closed component (a bag, a buckle) is inside out if it encloses a negative volume, however it lies on the source:
    the side that touches the body faces against it. Of an open one most near vertices face against the source.

    Args:
        found: closest points.
        target: the part.
        component: ids of the vertices' components.
        max_distance: metres, up to which a vertex is near.

    Returns:
        found: with the angles of the flipped normals.
        normals: (N, 3) of the target, flipped where needed.
    """
    # A component is inside out if more than twice as many near vertices face against the source as with it, and these
    # are more than a tenth of it.
    near = found.distance <= max_distance
    against = near & (found.angle > np.pi / 2)
    count = int(component.max(initial=-1)) + 1
    outward = np.bincount(component, near & (found.angle <= np.pi / 2), minlength=count)
    size = np.bincount(component, minlength=count)
    inward = np.bincount(component, against, minlength=count)
    closed, negative = _enclosed(target, component, count)
    turned = np.where(closed, negative, (inward > 2 * outward) & (inward > 0.1 * size))[component]
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


def _enclosed(
    target: TriangleMesh, component: Int32[np.ndarray, " N"], count: int
) -> tuple[Bool[np.ndarray, " P"], Bool[np.ndarray, " P"]]:
    """Return which components are closed (every edge has two faces), and which enclose a negative volume."""
    edges, faces_at = target.edges_with_counts
    open_edges = np.bincount(component[edges[:, 0]], faces_at != 2, minlength=count)
    of_face = component[target.faces[:, 0]]
    # Six times the volume by the divergence theorem, about a point near the part, which keeps the digits.
    arm = target.face_centers - target.vertices.mean(axis=0)
    volume = np.bincount(of_face, np.einsum("ij,ij->i", arm, target.face_cross), minlength=count)
    has_faces = np.bincount(of_face, minlength=count) > 0
    return has_faces & (open_edges == 0), volume < 0


def vertex_components(mesh: TriangleMesh) -> Int32[np.ndarray, " N"]:
    """Return the connected component of every vertex, numbered from 0."""
    return component_labels(mesh.edges, mesh.vertex_count).astype(np.int32)


def settle_unmatched(
    component: Int32[np.ndarray, " N"],
    matched: Bool[np.ndarray, " N"],
    weights: Float[np.ndarray, "N J"],
    config: TransferConfig,
) -> tuple[Bool[np.ndarray, " N"], Float64[np.ndarray, "N J"], tuple[str, ...]]:
    """Apply the policy `config.unmatched` to every component without a match.

    Args:
        component: ids 0 to P - 1.
        matched: vertices with a match.
        weights: of each vertex before the smooth fit.
        config: the policy.

    Returns:
        settled: (N,) bool, rows whose weights are final.
        weights: (N, J), with those rows set.
        policies: the policy of each of the P components.

    Raises:
        InputError: a component without a match under the policy "raise".
    """
    # A component is lost if none of its vertices is matched.
    count = int(component.max(initial=-1)) + 1
    lost = np.bincount(component, matched, minlength=count) == 0
    policies = tuple(np.where(lost, config.unmatched, "matched").tolist())
    rows = lost[component]
    if not rows.any() or config.unmatched == "extend":
        return np.zeros_like(rows), weights, policies
    message = f"{int(lost.sum())} of {count} components ({int(rows.sum())} of {len(rows)} vertices) have no match"
    if config.unmatched == "raise":
        raise InputError(
            "target mesh",
            expected="a matched vertex in every component",
            received=f"{message}, first at vertex {int(np.argmax(rows))}",
            remedy="choose the policy TransferConfig(unmatched='nearest') or 'rigid:JOINT', or remove those pieces",
        )
    if config.unmatched == "nearest":
        warnings.warn(f"skin weights: {message}; they take the nearest weights", GeometryWarning, stacklevel=3)
        return rows, weights, policies
    # All weight on one joint: the piece moves rigidly with it.
    out = weights.copy()
    out[rows] = 0.0
    out[rows, config.joint_index(config.unmatched.removeprefix("rigid:"), weights.shape[1])] = 1.0
    return rows, out, policies


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between unit vectors, radians."""
    # arctan2 keeps its precision at small angles, where arccos of a rounded cosine does not.
    return np.arctan2(row_lengths(cross_rows(a, b)), np.einsum("ij,ij->i", a, b))


def _barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return barycentric weights of points on triangles (Ericson 2004, 3.4), clipped to the triangle.

    On a triangle without area the point is placed along its longest edge.
    """
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = (np.einsum("ij,ij->i", x, y) for x, y in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    # Normal equations of p - a = beta u + gamma v by Cramer's rule; det = |u x v|^2, compared with the longest edge^4
    # to be independent of scale.
    det = uu * vv - uv * uv
    flat = det <= 1e-14 * np.maximum(uu, vv) ** 2
    safe = np.where(flat, 1.0, det)
    beta, gamma = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    along_u = flat & (uu >= vv)
    along_v = flat & ~along_u
    beta = np.where(flat, np.where(along_u, wu / np.where(uu > 0, uu, 1.0), 0.0), beta)
    gamma = np.where(flat, np.where(along_v, wv / np.where(vv > 0, vv, 1.0), 0.0), gamma)
    # Points whose projection is outside are clipped and renormalised, which keeps the weights convex.
    weights = np.clip(np.stack([1.0 - beta - gamma, beta, gamma], axis=1), 0.0, None)
    return weights / weights.sum(axis=1, keepdims=True)
