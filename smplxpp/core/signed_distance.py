"""Compute signed distances to a triangle mesh, closed or open, and their gradients."""

from __future__ import annotations

import atexit
import hashlib
from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh, cross_rows, normalize_rows

_SOLIDS: dict[bytes, tuple[igl.FastWindingNumberBVH, np.ndarray]] = {}
"""The solids asked of last with their outer faces, because garments, layers and checks ask one after the other of the
same body, of which both take a tenth of a second."""
# What is alive when the interpreter ends, libigl's bindings report as a leak, in eleven lines below a command's answer.
atexit.register(_SOLIDS.clear)
_REMEMBERED = 5
"""Number of solids that are kept, 10 MB each of a body: as many as the poses that a check goes through, and one."""


@dataclass(frozen=True, eq=False)
class SignedDistance:
    """Signed distances of N points to a surface, with closest points and normals.

    Attributes:
        distance: (N,) metres, negative inside the solid.
        closest: (N, 3) closest point on the surface.
        gradient: (N, 3) unit direction in which `distance` grows; the pseudonormal for a point on the surface.
        normal: (N, 3) unit pseudonormal of the surface at `closest`.
        face: (N,) index of the face that holds `closest`.
        on_border: (N,) whether `closest` lies on a border edge, where an open surface has no sides.
    """

    distance: Float64[np.ndarray, " N"]
    closest: Float64[np.ndarray, "N 3"]
    gradient: Float64[np.ndarray, "N 3"]
    normal: Float64[np.ndarray, "N 3"]
    face: Int64[np.ndarray, " N"]
    on_border: Bool[np.ndarray, " N"]


class SignedDistanceField:
    """Answers signed distance queries against one surface, with search trees that are built once.

    A solid (`solid=True`: a body) is the union of the regions that its surfaces enclose. A point is inside where the
    generalised winding number is above 1/2 (Jacobson et al. 2013; fast evaluation of Barill et al. 2018), which
    tolerates small holes, overlapping limbs, and eyes and teeth within the head. Faces that lie within the solid, or in
    slits narrower than a thousandth of its size, are left out, so that the gradient leads out of the union.

    An open surface (`solid=False`: a garment) has a front and a back: the sign is that of (p - c) . n with c the
    closest point and n its pseudonormal: the face's normal, the sum of both normals on an edge, the angle-weighted
    normal at a vertex (Baerentzen and Aanaes, IEEE TVCG 2005). It is meaningless where `on_border`.

    Zero-area faces are left out.

    Args:
        mesh: the surface; N vertices, M faces, outward.
        solid: whether the surface bounds a solid.

    Raises:
        InputError: no face with an area; a solid that is wound inside out.
    """

    def __init__(self, mesh: TriangleMesh, *, solid: bool) -> None:
        kept = np.flatnonzero(mesh.face_areas > 0)
        if not len(kept):
            raise InputError("signed distance", expected="a mesh with faces that have an area", received="none")
        self._winding: igl.FastWindingNumberBVH | None = None
        # libigl's fast winding number works in float32; closer to the surface than this its sign is noise.
        self._resolution = 1e-6 * mesh.bbox_diagonal
        if solid:
            kept = kept[self._outer_faces(TriangleMesh(mesh.vertices, mesh.faces[kept]))]
        self._kept, self._mesh = kept, TriangleMesh(mesh.vertices, mesh.faces[kept])
        self._tree = igl.AABB()
        self._tree.init(self._mesh.vertices, self._mesh.faces)
        self._index_edges()

    def _outer_faces(self, mesh: TriangleMesh) -> np.ndarray:
        if np.einsum("ij,ij->", mesh.face_centers - mesh.vertices.mean(axis=0), mesh.face_cross) < 0:
            raise InputError(
                "signed distance",
                expected="a solid with counter-clockwise faces seen from outside",
                received="faces that point inward",
                remedy="reverse the order of the corners of every face",
            )
        key = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).digest()
        if key in _SOLIDS:
            self._winding, outer = _SOLIDS[key]
            return outer
        self._winding = igl.FastWindingNumberBVH()
        self._winding.init(mesh.vertices, mesh.faces)
        outer = self._unburied(mesh)
        assert len(outer), "a solid with a positive volume has an outside"
        _SOLIDS[key] = self._winding, outer
        for oldest in list(_SOLIDS)[:-_REMEMBERED]:
            _SOLIDS.pop(oldest, None)
        return outer

    def _unburied(self, mesh: TriangleMesh) -> np.ndarray:
        # A face is buried if the point a thousandth of the mesh's size (2 mm on a body) in front of it is inside: the
        # face lies within the solid or in a slit, such as a closed mouth or the fold of an eyelid.
        in_front = mesh.face_centers + 1e-3 * mesh.bbox_diagonal * mesh.face_normals
        return np.flatnonzero(~self._inside(in_front))

    def _inside(self, points: np.ndarray) -> np.ndarray:
        assert self._winding is not None, "asked of solids alone"
        return self._winding.winding_number(points) > 0.5

    def _index_edges(self) -> None:
        mesh = self._mesh
        edges, counts = mesh.edges_with_counts
        key = edges[:, 0] * mesh.vertex_count + edges[:, 1]
        # face_edges[f, k] is the edge opposite corner k.
        opposite = np.sort(mesh.faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
        self._face_edges = np.searchsorted(key, opposite[..., 0] * mesh.vertex_count + opposite[..., 1])
        index, normals = self._face_edges.ravel(), np.repeat(mesh.face_normals, 3, axis=0)
        sums = [np.bincount(index, normals[:, axis], minlength=len(edges)) for axis in range(3)]
        self._edge_normals = normalize_rows(np.stack(sums, axis=1))
        self._edge_border = counts == 1
        self._vertex_border = np.zeros(mesh.vertex_count, dtype=bool)
        self._vertex_border[edges[self._edge_border]] = True

    def query(self, points: Float[np.ndarray, "N 3"], *, sided: Bool[np.ndarray, " N"] | None = None) -> SignedDistance:
        """Return the signed distances of (N, 3) points, metres.

        Args:
            points: where to ask.
            sided: for a solid, the points whose side is asked, because winding numbers take most of the time; the
                others count as outside. None: all.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError("query points", expected="finite (N, 3)", received=f"shape {points.shape} or NaN")
        if not len(points):
            none, rows = np.zeros(0), np.zeros((0, 3))
            return SignedDistance(none, rows, rows, rows, none.astype(np.int64), none.astype(bool))
        mesh = self._mesh
        squared, face, closest = self._tree.squared_distance(mesh.vertices, mesh.faces, points)
        face, length = np.asarray(face).reshape(-1), np.sqrt(np.asarray(squared).reshape(-1))
        normal, on_border = self._pseudonormals(face, barycentric_coordinates(closest, mesh.triangles[face]))
        offset = points - closest
        inside = np.einsum("ij,ij->i", offset, normal) < 0
        if self._winding is not None:
            clear = length > self._resolution
            if sided is not None:
                inside &= sided
                clear &= sided
            inside[clear] = self._inside(points[clear])
        side = np.where(inside, -1.0, 1.0)
        # On the surface the direction to the closest point is noise; the normal is its limit.
        near = (length < 1e-12)[:, None]
        gradient = np.where(near, normal, side[:, None] * offset / np.where(near, 1.0, length[:, None]))
        return SignedDistance(side * length, closest, gradient, normal, self._kept[face], on_border)

    def _pseudonormals(self, face: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mesh = self._mesh
        normal = mesh.face_normals[face]
        on_border = np.zeros(len(face), dtype=bool)
        # A barycentric coordinate of 0, up to rounding, places the point on the opposite edge; two, on a vertex.
        zero = bary < 1e-9
        on_edge, on_vertex = zero.sum(axis=1) == 1, zero.sum(axis=1) >= 2
        edge = self._face_edges[face, np.argmax(zero, axis=1)][on_edge]
        normal[on_edge], on_border[on_edge] = self._edge_normals[edge], self._edge_border[edge]
        vertex = mesh.faces[face, np.argmax(bary, axis=1)][on_vertex]
        normal[on_vertex], on_border[on_vertex] = mesh.vertex_normals[vertex], self._vertex_border[vertex]
        return normal, on_border


def barycentric_coordinates(
    points: Float[np.ndarray, "N 3"], triangles: Float[np.ndarray, "N 3 3"]
) -> Float[np.ndarray, "N 3"]:
    """Return the barycentric coordinates of points in the planes of triangles with an area; rows sum to 1."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = points - triangles[:, 0]
    normal = cross_rows(a, b)
    squared = np.einsum("ij,ij->i", normal, normal)
    v = np.einsum("ij,ij->i", cross_rows(p, b), normal) / squared
    w = np.einsum("ij,ij->i", cross_rows(a, p), normal) / squared
    return np.stack([1.0 - v - w, v, w], axis=1)
