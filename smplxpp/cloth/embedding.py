"""Let a coarse mesh carry a fine one: vertices kept in frames of coarse triangles, and the kernels that move them."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
from jaxtyping import Float, Float32, Int, Int32, Int64
from scipy.sparse import csr_matrix

from smplxpp.body.model import PosedBody
from smplxpp.cloth.solver import Collider
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import barycentric_coordinates
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.native import address, native_library


class _Carried(ctypes.Structure):
    _fields_ = [
        *(
            (name, ctypes.c_int64)
            for name in ("vertices", "triangles", "particles", "faces", "collider_vertices", "collider_faces", "edges")
        ),
        *(
            (name, ctypes.c_void_p)
            for name in (
                *("triangle", "which", "weight", "offset", "face", "collider_face", "deepest"),
                *("edge", "most"),
            )
        ),
    ]


class CarriedVertices:
    """N vertices that n particles carry, kept out of a collider of c vertices; `Embedding.carried` by a kernel.

    Args:
        embedding: of the vertices.
        faces: of the particles.
        collider: what they keep out of.
        particles: their number n.
        bounds: drawn edges, as pairs of vertices, and how long each may be, metres; long ones are kept out of the
            collider between their ends, too. None: none.
    """

    def __init__(
        self,
        embedding: Embedding,
        faces: Int[np.ndarray, "m 3"],
        collider: Collider,
        particles: int,
        bounds: tuple[Int[np.ndarray, "e 2"], Float[np.ndarray, " e"]] | None = None,
    ) -> None:
        # Many vertices ride on one triangle; each distinct triangle is posed once.
        triangles, which = np.unique(embedding.corners, axis=0, return_inverse=True)
        edges, most = bounds if bounds is not None else (np.zeros((0, 2), np.int32), np.zeros(0))
        self._count, self._shapes = len(embedding.corners), ((particles, 3), (len(collider.margin), 3))
        arrays = (
            *((np.ascontiguousarray(triangles, dtype=np.int32), "int32"),),
            *((np.ascontiguousarray(which.ravel(), dtype=np.int32), "int32"),),
            *(
                (np.ascontiguousarray(embedding.weights), "float32"),
                (np.ascontiguousarray(embedding.offset), "float32"),
            ),
            *((np.ascontiguousarray(faces, dtype=np.int32), "int32"), (collider.faces, "int32")),
            (collider.deepest, "float32"),
            *((np.ascontiguousarray(edges, dtype=np.int32), "int32"), (most.astype(np.float32), "float32")),
        )
        self._kept = [address(array, dtype) for array, dtype in arrays]
        self._native = _Carried(
            *(self._count, len(triangles), particles, len(faces), len(collider.margin), len(collider.faces)),
            *(len(edges), *self._kept),
        )

    def at(
        self, particles: Float32[np.ndarray, "n 3"], surface: Float32[np.ndarray, "c 3"], *, margin: float
    ) -> Float32[np.ndarray, "N 3"]:
        """Return where the vertices are, metres: `margin` metres before the surface where they lie behind that.

        Args:
            particles: where they are.
            surface: where the collider's vertices are.
        """
        assert (particles.shape, surface.shape) == self._shapes
        out = np.empty((self._count, 3), dtype=np.float32)
        native_library().smplxpp_cloth_carry(
            *(ctypes.byref(self._native), address(particles), address(surface), ctypes.c_float(margin), address(out))
        )
        return out


class _Skinned(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in ("rows", "vertices", "joints", "influences")),
        *((name, ctypes.c_void_p) for name in ("row", "joint", "weight")),
    ]


class SkinnedRows:
    """R of V vertices under linear blend skinning, there and back.

    Args:
        weights: of all V vertices.
        rows: which of them.
    """

    def __init__(self, weights: SkinWeights, rows: Int64[np.ndarray, " R"]) -> None:
        arrays = (
            *((rows.astype(np.int32), "int32"), (np.ascontiguousarray(weights.joint_indices, dtype=np.int32), "int32")),
            (np.ascontiguousarray(weights.joint_weights, dtype=np.float32), "float32"),
        )
        self._kept = [address(array, dtype) for array, dtype in arrays]
        self._count, self._joints = len(rows), weights.joint_count
        self._native = _Skinned(
            self._count, len(weights), weights.joint_count, weights.joint_indices.shape[1], *self._kept
        )

    def posed(
        self, body: PosedBody, rest: Float32[np.ndarray, "V 3"], *, origin: Float[np.ndarray, " 3"]
    ) -> Float32[np.ndarray, "R 3"]:
        """Return where skinning takes them from rest, metres from the origin: `sum_j w_j G_j v`."""
        out = np.empty((self._count, 3), dtype=np.float32)
        native_library().smplxpp_cloth_posed(
            ctypes.byref(self._native), address(self._transforms(body, origin)), address(rest), address(out)
        )
        return out

    def unposed(
        self,
        body: PosedBody,
        rest: Float32[np.ndarray, "V 3"],
        places: Float32[np.ndarray, "R 3"],
        *,
        origin: Float[np.ndarray, " 3"],
        least_determinant: float,
    ) -> Float32[np.ndarray, "R 3"]:
        """Return the displacements in the T-pose that skinning takes to places: `(sum_j w_j G_j)^-1 x - v`, metres.

        Joints that turn against each other flatten a blend; a vertex whose blend has less than the least determinant
        stays with skinning.
        """
        assert places.shape == (self._count, 3)
        out = np.empty((self._count, 3), dtype=np.float32)
        native_library().smplxpp_cloth_unposed(
            *(ctypes.byref(self._native), address(self._transforms(body, origin)), address(rest), address(places)),
            *(ctypes.c_float(least_determinant), address(out)),
        )
        return out

    def _transforms(self, body: PosedBody, origin: Float[np.ndarray, " 3"]) -> Float32[np.ndarray, "J 12"]:
        transforms = np.array(body.posed_from_rest[0, :, :3])
        assert len(transforms) == self._joints
        transforms[:, :, 3] -= origin
        return transforms.reshape(-1, 12).astype(np.float32)


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


def embed(
    points: Float[np.ndarray, "N 3"], coarse: TriangleMesh, *, cell: Int[np.ndarray, " N"] | None = None
) -> Embedding:
    """Bind points to the nearest triangles of a mesh; `carried` by that mesh they stay where they are.

    Args:
        points: metres.
        coarse: the mesh at rest.
        cell: of each point its vertex of the coarse mesh along the cloth, -1: none. Only triangles at that vertex and
            at its neighbours carry it: the nearest one may belong to another layer, a second leg or the other end of a
            scarf, and would draw it along when that swings.
    """
    face, near = _nearest(points, coarse, cell)
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


def _nearest(
    points: Float[np.ndarray, "N 3"], coarse: TriangleMesh, cell: Int[np.ndarray, " N"] | None
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """The triangle that carries each point, and its nearest place there, metres."""
    points, faces = np.ascontiguousarray(points), coarse.faces
    found, near = igl.point_mesh_squared_distance(points, coarse.vertices, faces)[1:3]
    face = found.astype(np.int64)
    known = np.flatnonzero(cell >= 0) if cell is not None else np.zeros(0, np.int64)
    if cell is None or not len(known):
        return face, near
    # Faces with a corner that is the cell's vertex or beside it; most nearest faces are among them already.
    n, corners = coarse.vertex_count, faces.ravel()
    at = csr_matrix((np.ones(len(corners), bool), (corners, np.repeat(np.arange(len(faces)), 3))), (n, len(faces)))
    about = (at @ at.T @ at).tocsr()
    away = known[~np.asarray(about[cell[known], face[known]]).ravel().astype(bool)]
    for one in np.unique(cell[away]):
        mine, few = away[cell[away] == one], about[one].indices
        if len(few):
            found, near[mine] = igl.point_mesh_squared_distance(points[mine], coarse.vertices, faces[few])[1:3]
            face[mine] = few[found]
    return face, near


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
