"""Take meshes, points and arrays of other libraries; none of these libraries is required.

Objects are recognised by their attributes, so that no other library is imported before its own object arrives.
"""

from __future__ import annotations

from typing import Any, Protocol, TypeAlias

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from smplxpp.core.errors import InputError, require_choice
from smplxpp.core.mesh import TriangleMesh

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}


class HasVerticesAndFaces(Protocol):
    """A mesh as trimesh has it: arrays of vertices and of faces."""

    @property
    def vertices(self) -> Any: ...

    @property
    def faces(self) -> Any: ...


class HasVerticesAndTriangles(Protocol):
    """A mesh as open3d's legacy geometry has it."""

    @property
    def vertices(self) -> Any: ...

    @property
    def triangles(self) -> Any: ...


class HasVertexAndTriangleTables(Protocol):
    """A mesh as open3d's tensor geometry has it: `vertex["positions"]` and `triangle["indices"]`."""

    @property
    def vertex(self) -> Any: ...

    @property
    def triangle(self) -> Any: ...


class HasPoints(Protocol):
    """A point cloud as open3d's legacy geometry has it."""

    @property
    def points(self) -> Any: ...


MeshLike: TypeAlias = (
    TriangleMesh
    | HasVerticesAndFaces
    | HasVerticesAndTriangles
    | HasVertexAndTriangleTables
    | tuple[ArrayLike, ArrayLike]
)
"""What public functions take as a mesh; `as_mesh` converts it."""

PointsLike: TypeAlias = ArrayLike | HasPoints | MeshLike
"""What public functions take as points, a mesh for its vertices; `as_points` converts it."""


def as_array(values: Any) -> np.ndarray:
    """Return numbers as a numpy array: of lists, torch tensors on any device, open3d's tensors, sparse matrices.

    Example:
        >>> as_array([[0, 1]]).shape
        (1, 2)
    """
    if isinstance(values, np.ndarray):
        return values
    if hasattr(values, "toarray"):  # scipy.sparse
        return values.toarray()
    for step in ("detach", "cpu", "numpy"):  # torch: all three; open3d's tensors: the last two
        values = getattr(values, step)() if hasattr(values, step) else values
    return np.asarray(values)


def mesh_arrays(mesh: Any, *, subject: str = "mesh") -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a mesh of any library as they are, without a check of their values.

    Raises:
        InputError: not a mesh.
    """
    if isinstance(mesh, tuple | list) and len(mesh) == 2:
        return as_array(mesh[0]), as_array(mesh[1])
    if hasattr(mesh, "geometry") and hasattr(mesh, "to_mesh"):  # trimesh.Scene, which trimesh.load gives for a GLB
        mesh = mesh.to_mesh()
    if hasattr(mesh, "vertex_matrix") and hasattr(mesh, "face_matrix"):  # pymeshlab.Mesh
        return mesh.vertex_matrix(), mesh.face_matrix()
    if hasattr(mesh, "vertex") and hasattr(mesh, "triangle"):
        return as_array(mesh.vertex["positions"]), as_array(mesh.triangle["indices"])
    # trimesh has `triangles` too, the corners' positions: `faces` come first.
    faces = getattr(mesh, "faces", getattr(mesh, "triangles", None))
    if faces is None or not hasattr(mesh, "vertices"):
        raise InputError(
            subject,
            expected="a TriangleMesh, a mesh of trimesh, open3d or pymeshlab, or a pair (vertices, faces)",
            received=type(mesh).__name__,
            remedy="read a file with smplxpp.read_mesh",
        )
    return as_array(mesh.vertices), as_array(faces)


def as_mesh(mesh: MeshLike, *, subject: str = "mesh", unit: str = "m") -> TriangleMesh:
    """Convert a mesh of another library, or a pair (vertices, faces), to a `TriangleMesh` in metres.

    Args:
        mesh: a `TriangleMesh`, which is returned as it is if it is in metres; a `trimesh.Trimesh` or `Scene`, a legacy
            or tensor `TriangleMesh` of open3d, a `pymeshlab.Mesh`; or a pair (N, 3) and (M, 3) of arrays or of torch
            tensors on any device.
        subject: what the mesh is called in errors.
        unit: of its coordinates: "m", "cm", "mm" or "inch".

    Raises:
        InputError: something else, an unknown unit, or arrays that a `TriangleMesh` refuses.

    Example:
        >>> as_mesh(([[0, 0, 0], [1000, 0, 0], [0, 1000, 0]], [[0, 1, 2]]), unit="mm").face_areas
        array([0.5])
    """
    require_choice("unit", unit, tuple(METRES_PER_UNIT))
    if not isinstance(mesh, TriangleMesh):
        mesh = TriangleMesh(*mesh_arrays(mesh, subject=subject))
    return mesh if unit == "m" else mesh.with_vertices(METRES_PER_UNIT[unit] * mesh.vertices)


def is_cloud(points: Any) -> bool:
    """Return whether something is points without faces: an array (P, 3), or a point cloud of open3d or trimesh."""
    if any(hasattr(points, name) for name in ("faces", "triangles", "triangle", "vertex_matrix", "geometry")):
        return False
    if any(hasattr(points, name) for name in ("points", "point", "vertices")):
        return True
    if isinstance(points, tuple | list) and len(points) == 2:
        return as_array(points[0]).ndim == 1  # two points, not a pair of tables
    return not isinstance(points, str | bytes) and as_array(points).ndim == 2


def point_arrays(points: PointsLike) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the points of an array, a cloud or a mesh's vertices as float64, and a cloud's normals; unchecked."""
    table: Any = points
    normals = None
    if hasattr(table, "vertices"):
        found = table.vertices
    elif hasattr(table, "point"):  # open3d's tensor cloud
        found = table.point["positions"]
        normals = table.point["normals"] if "normals" in table.point else None
    elif hasattr(table, "points"):
        found, normals = table.points, getattr(table, "normals", None)
    else:
        found = table if is_cloud(table) else mesh_arrays(table)[0]
    return as_array(found).astype(np.float64), None if normals is None else as_array(normals).astype(np.float64)


def as_points(
    points: PointsLike, *, subject: str = "points"
) -> tuple[Float64[np.ndarray, "P 3"], Float64[np.ndarray, "P 3"] | None]:
    """Return the points of an array, a point cloud or a mesh's vertices, and a cloud's unit normals where it has some.

    Raises:
        InputError: not (P, 3), or NaN.

    Example:
        >>> as_points([[0.0, 1.0, 2.0]])
        (array([[0., 1., 2.]]), None)
    """
    found, normals = point_arrays(points)
    if found.ndim != 2 or found.shape[1] != 3 or not np.isfinite(found).all():
        raise InputError(subject, expected="finite values of shape (P, 3)", received=f"shape {found.shape} or NaN")
    if normals is None or normals.shape != found.shape:
        return np.ascontiguousarray(found), None
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = np.divide(normals, length, out=np.full_like(normals, np.nan), where=length > 0)
    return np.ascontiguousarray(found), unit
