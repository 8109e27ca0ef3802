"""A fine mesh carried by a coarse one: every vertex keeps its place in the frame of its nearest coarse triangle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
from jaxtyping import Float, Float32, Int32
from scipy.sparse import csr_matrix

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import barycentric_coordinates


@dataclass(frozen=True, eq=False)
class Embedding:
    """N fine vertices in the frames of m coarse triangles.

    Attributes:
        corners: of each vertex's triangle.
        weights: barycentric.
        offset: metres along the triangle's first edge, along the second direction in its plane, and along the coarse
            mesh's smooth normal.
    """

    corners: Int32[np.ndarray, "N 3"]
    weights: Float32[np.ndarray, "N 3"]
    offset: Float32[np.ndarray, "N 3"]

    def carried(self, coarse: TriangleMesh) -> Float[np.ndarray, "N 3"]:
        """Return the fine vertices where the coarse mesh takes them, metres."""
        return self.carried_with_normals(coarse)[0]

    def carried_with_normals(self, coarse: TriangleMesh) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
        """Return the fine vertices, metres, and the coarse mesh's smooth unit normals at them."""
        triangles, in_plane, among_corners = self._matrices
        x, count = coarse.vertices, among_corners.shape[1]
        place = in_plane @ np.concatenate([x[:count], *_tangents(x, triangles)])
        normal = _unit(among_corners @ _smooth_normals(coarse)[:count])
        return place + self.offset[:, 2:] * normal, normal

    @cached_property
    def _matrices(self) -> tuple[Int32[np.ndarray, "m 3"], csr_matrix, csr_matrix]:
        """The triangles that carry something; what takes corners and tangents to places; what mixes the corners.

        Both matrices have what they multiply a triangle once in the place of once a vertex.
        """
        triangles, which = np.unique(self.corners, axis=0, return_inverse=True)
        which, count = which.reshape(-1, 1), int(triangles.max(initial=-1)) + 1
        columns = np.concatenate([self.corners, count + which, count + len(triangles) + which], axis=1)
        values = np.concatenate([self.weights, self.offset[:, :2]], axis=1)
        in_plane = _rows(values, columns, count + 2 * len(triangles))
        return triangles, in_plane, _rows(self.weights, self.corners, count)


def embed(points: Float[np.ndarray, "N 3"], coarse: TriangleMesh) -> Embedding:
    """Bind points to the nearest triangles of a mesh; `carried` by that mesh they stay where they are."""
    face, near = igl.point_mesh_squared_distance(np.ascontiguousarray(points), coarse.vertices, coarse.faces)[1:3]
    # Barycentric coordinates of the foot point; those of triangles without area fall back to equal weights. Clipping
    # and normalising keep them a convex combination.
    corners = coarse.faces[face].astype(np.int32)
    with np.errstate(invalid="ignore", divide="ignore"):  # triangles without area
        weights = barycentric_coordinates(near, coarse.vertices[corners])
    weights = np.clip(np.nan_to_num(weights, nan=1 / 3, posinf=1.0, neginf=0.0), 1e-12, 1.0)
    weights /= weights.sum(axis=1, keepdims=True)
    zero = Embedding(corners, weights.astype(np.float32), np.zeros((len(points), 3), dtype=np.float32))
    # The rest between the point and the foot point is expressed in a frame of the triangle's tangents and the smooth
    # normal, which turns with the mesh when it deforms.
    missing = points - zero.carried(coarse)
    normals = _smooth_normals(coarse)
    normal = _unit(sum(weights[:, k : k + 1] * normals[corners[:, k]] for k in range(3)))
    along = np.einsum("ni,ni->n", missing, normal)
    left = missing - along[:, None] * normal
    first, second = _tangents(coarse.vertices, corners)
    # What is left may lean out of the triangle's plane by as much as the smooth normal does: solved exactly.
    frame = np.stack([first, second, normal], axis=2)
    # A frame that is nearly flat would amplify rounding; there the projections have to do.
    exact = np.linalg.det(frame) > 0.1
    offset = np.stack([np.einsum("ni,ni->n", left, first), np.einsum("ni,ni->n", left, second), along], axis=1)
    offset[exact] = np.linalg.solve(frame[exact], missing[exact][:, :, None])[:, :, 0]
    return Embedding(zero.corners, zero.weights, offset.astype(np.float32))


def _rows(values: Float[np.ndarray, "N k"], columns: np.ndarray, width: int) -> csr_matrix:
    """A float64 matrix of k entries a row, summed in their order."""
    starts = np.arange(0, values.size + 1, values.shape[1])
    return csr_matrix((values.astype(np.float64).ravel(), columns.ravel(), starts), shape=(len(values), width))


def _smooth_normals(mesh: TriangleMesh) -> Float[np.ndarray, "n 3"]:
    """Unit normals of the vertices, faces weighted by their area; cheaper than by their angles."""
    x, f = mesh.vertices, mesh.faces
    cross = np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]])
    total = np.stack(
        [sum(np.bincount(f[:, k], cross[:, axis], minlength=len(x)) for k in range(3)) for axis in range(3)], axis=1
    )
    return _unit(total)


def _tangents(
    x: Float[np.ndarray, "n 3"], corners: Int32[np.ndarray, "N 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Unit directions in the plane of each triangle: its first edge, and the one a quarter turn on."""
    edge = x[corners[:, 1]] - x[corners[:, 0]]
    normal = _unit(np.cross(edge, x[corners[:, 2]] - x[corners[:, 0]]))
    edge = _unit(edge)
    return edge, np.cross(normal, edge)


def _unit(rows: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return rows / np.maximum(np.sqrt(np.einsum("ni,ni->n", rows, rows)), 1e-12)[:, None]
