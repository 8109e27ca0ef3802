"""Define TriangleMesh, the geometry that every stage takes and returns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, Integer

from smplxpp.core.errors import InputError
from smplxpp.core.lazy import OPEN3D_NEEDS, import_extra
from smplxpp.core.topology import edge_groups

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """An indexed triangle mesh; metres, +Y up, counter-clockwise faces seen from outside.

    Attributes:
        vertices: (N, 3) float64.
        faces: (M, 3) int64 indices into `vertices`.

    The constructor copies, converts and checks shapes, finite coordinates and index range; it changes nothing else
    (duplicate vertices, zero-area faces and several components are legal: see `smplxpp.clean`).

    Raises:
        InputError: wrong shapes, NaN or infinite coordinates, indices out of range.

    Example:
        >>> mesh = smplxpp.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> mesh.face_normals
        array([[0., 0., 1.]])
    """

    vertices: Float64[np.ndarray, "N 3"]
    faces: Int64[np.ndarray, "M 3"]

    def __post_init__(self) -> None:
        # Copies in C order: meshes are immutable and compiled kernels take contiguous arrays.
        vertices = np.array(self.vertices, dtype=np.float64, order="C")
        faces = np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise InputError("mesh vertices", expected="shape (N, 3)", received=f"shape {vertices.shape}")
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise InputError(
                "mesh faces", expected="shape (M, 3)", received=f"shape {faces.shape}", remedy="triangulate the mesh"
            )
        if faces.size and not np.issubdtype(faces.dtype, np.integer):
            raise InputError("mesh faces", expected="integers", received=str(faces.dtype))
        bad = ~np.isfinite(vertices).all(axis=1)
        if bad.any():
            raise InputError(
                "mesh vertices",
                expected="finite coordinates",
                received=f"{int(bad.sum())} vertices with NaN or infinity, first at index {int(np.argmax(bad))}",
                remedy="remove them with smplxpp.clean.sanitize(vertices, faces)",
            )
        # Zero-based indices; a file with indices from 1 shows itself by one index equal to the number of vertices.
        faces = faces.astype(np.int64, order="C")  # a copy; np.array would keep C's long long as it is
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise InputError(
                "mesh faces",
                expected=f"indices in [0, {len(vertices)})",
                received=f"indices in [{faces.min()}, {faces.max()}]",
                remedy="check for 1-based indices",
            )
        vertices.setflags(write=False)
        faces.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    def __repr__(self) -> str:
        return f"TriangleMesh({self.vertex_count:,} vertices, {self.face_count:,} faces)"

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return the mesh as a `trimesh.Trimesh` with the same vertices and faces in the same order.

        Raises:
            ImportError: trimesh is not installed.

        Example:
            >>> TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).to_trimesh().area
            np.float64(0.5)
        """
        try:
            import trimesh
        except ModuleNotFoundError as error:
            if error.name != "trimesh":  # a package that trimesh needs is missing, which its own words say
                raise
            raise ImportError(
                "TriangleMesh.to_trimesh needs trimesh, which is not installed: pip install trimesh"
            ) from None
        return trimesh.Trimesh(*self.arrays(), process=False)

    def show(self, **options: Any) -> Any:
        """Open the mesh in trimesh's viewer, a window or a cell of a notebook; options are those of `Trimesh.show`.

        Raises:
            ImportError: trimesh is not installed; a window needs `trimesh[easy]` and `pyglet<2`.
        """
        return self.to_trimesh().show(**options)

    def to_open3d(self) -> Any:
        """Return the mesh as an `open3d.geometry.TriangleMesh` with the same vertices and faces in the same order.

        Raises:
            MissingExtraError: open3d is not installed (extra `scan`), or lacks libraries of the system.
        """
        open3d = import_extra("open3d", extra="scan", purpose="a mesh for open3d", apt=OPEN3D_NEEDS)
        vertices, faces = self.arrays()
        corners = open3d.utility.Vector3iVector(faces.astype(np.int32))
        return open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(vertices), corners)

    def arrays(self) -> tuple[Float64[np.ndarray, "N 3"], Int64[np.ndarray, "M 3"]]:
        """Return writable copies of vertices and faces, as open3d's vectors and `torch.from_numpy` want them.

        The mesh's own arrays are read-only, because what is derived from them is kept.

        Example:
            >>> vertices, faces = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).arrays()
            >>> vertices.flags.writeable and faces.flags.writeable
            True
        """
        return self.vertices.copy(), self.faces.copy()

    @property
    def vertex_count(self) -> int:
        return len(self.vertices)

    @property
    def face_count(self) -> int:
        return len(self.faces)

    @cached_property
    def triangles(self) -> Float64[np.ndarray, "M 3 3"]:
        """Positions of the corners of each face."""
        return self.vertices[self.faces]

    @cached_property
    def face_centers(self) -> Float64[np.ndarray, "M 3"]:
        """Mean of the three corners of each face."""
        t = self.triangles
        return (t[:, 0] + t[:, 1] + t[:, 2]) / 3.0

    @cached_property
    def face_cross(self) -> Float64[np.ndarray, "M 3"]:
        """Face normals, of length twice the face's area."""
        t = self.triangles
        return cross_rows(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])

    @cached_property
    def face_areas(self) -> Float64[np.ndarray, " M"]:
        """Area of each face, square metres."""
        return 0.5 * row_lengths(self.face_cross)

    @cached_property
    def face_normals(self) -> Float64[np.ndarray, "M 3"]:
        """Unit normal of each face; zero for a face without area."""
        return normalize_rows(self.face_cross)

    @cached_property
    def vertex_normals(self) -> Float64[np.ndarray, "N 3"]:
        """Unit vertex normals, faces weighted by their angle at the vertex (Thuermer and Wuethrich 1998)."""
        import igl  # here, because most users of a mesh need no normals

        # libigl returns NaN around faces without area, at vertices without a face, and where normals cancel.
        solid = self.face_areas > 0
        faces, normals = (
            (self.faces, self.face_normals) if solid.all() else (self.faces[solid], self.face_normals[solid])
        )
        if not len(faces):
            return np.zeros_like(self.vertices)
        by_angle = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
        out = igl.per_vertex_normals(self.vertices, faces, by_angle, normals)
        return np.where(np.isfinite(out), out, 0.0)

    @cached_property
    def referenced(self) -> Int64[np.ndarray, " n"]:
        """Indices of vertices that a face uses, in increasing order."""
        return _occurring(self.faces, self.vertex_count)

    @cached_property
    def bbox_diagonal(self) -> float:
        """Length of the bounding box's diagonal of the referenced vertices; 0 for an empty mesh."""
        if not self.face_count:
            return 0.0
        used = self.vertices[self.referenced]
        return float(np.linalg.norm(used.max(axis=0) - used.min(axis=0)))

    @cached_property
    def edges(self) -> Int64[np.ndarray, "E 2"]:
        """Undirected edges, each once, lower index first, sorted."""
        return self.edges_with_counts[0]

    @cached_property
    def edges_with_counts(self) -> tuple[Int64[np.ndarray, "E 2"], Int64[np.ndarray, " E"]]:
        """Undirected edges, and the number of faces at each."""
        f = self.faces
        directed = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
        key = directed[:, 0] * max(self.vertex_count, 1) + directed[:, 1]
        unique, counts = np.unique(key, return_counts=True)
        n = max(self.vertex_count, 1)
        return np.stack([unique // n, unique % n], axis=1), counts

    @cached_property
    def border_edges(self) -> Int64[np.ndarray, "B 2"]:
        """Edges on the border, which have exactly one face."""
        edges, counts = self.edges_with_counts
        return edges[counts == 1]

    @cached_property
    def face_pairs(self) -> Int64[np.ndarray, "P 2"]:
        """Pairs of faces that share an edge with exactly two faces."""
        order, first, count = edge_groups(self.faces)
        start = first[count == 2]
        return np.stack([order[start], order[start + 1]], axis=1) // 3

    def with_vertices(self, vertices: Float[np.ndarray, "V 3"]) -> TriangleMesh:
        """Return a mesh with the same faces and other vertex positions."""
        return replace(self, vertices=vertices)

    def submesh(
        self, face_mask: Bool[np.ndarray, " M"] | Integer[np.ndarray, " m"]
    ) -> tuple[TriangleMesh, Int64[np.ndarray, " n"]]:
        """Return the faces that a mask or index array selects, without unreferenced vertices.

        Returns the mesh and (n,) the index in this mesh of each of its vertices, in increasing order.
        """
        faces = self.faces[face_mask]
        used = _occurring(faces, self.vertex_count)
        # Old index to new index, -1 for vertices that are dropped.
        lookup = np.full(self.vertex_count, -1, dtype=np.int64)
        lookup[used] = np.arange(len(used))
        return TriangleMesh(self.vertices[used], lookup[faces]), used


def _occurring(indices: np.ndarray, count: int) -> np.ndarray:
    """Return the distinct values among integers in [0, count), in increasing order."""
    mask = np.zeros(count, dtype=bool)
    mask[indices.ravel()] = True
    return np.flatnonzero(mask)


def row_lengths(x: Float[np.ndarray, "N D"]) -> Float[np.ndarray, " N"]:
    """Return the Euclidean length of each row; several times as fast as `np.linalg.norm` where D is small."""
    return np.sqrt(np.einsum("ij,ij->i", x, x))


def cross_rows(a: Float[np.ndarray, "N 3"], b: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "N 3"]:
    """Return the cross product of each row with that of `b`, or with the one vector b: the bits of `np.cross`.

    It takes a third of the time for a thousand rows, and a tenth for a few.
    """
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    out = np.empty(a.shape, np.result_type(a, b))
    out[:, 0], out[:, 1], out[:, 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return out


def normalize_rows(x: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N D"]:
    """Scale each row of (N, D) to unit length; zero rows stay zero."""
    length = row_lengths(x)[:, None]
    return np.divide(x, length, out=np.zeros_like(x), where=length > 0)


def concatenate_meshes(meshes: list[TriangleMesh]) -> TriangleMesh:
    """Concatenate meshes into one, in order, without merging vertices."""
    offsets = np.cumsum([0] + [m.vertex_count for m in meshes])
    return TriangleMesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets[:-1], strict=True)]),
    )
