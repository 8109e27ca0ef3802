"""Remesh parts with faces of equal size and nearly equal sides (isotropic explicit remeshing, Hoppe et al. 1993).

pymeshlab does it. It is under the GPL 3, no part of the package, and imported only when isotropic remeshing is chosen.
"""

from __future__ import annotations

import warnings
from typing import Any

import igl
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from smplxpp.clean.simplify import Simplified, opposed_faces, separate_doubled_vertices
from smplxpp.core import GeometryWarning, InputError, MeshLike, TriangleMesh, as_mesh, require_at_least
from smplxpp.core.lazy import import_extra
from smplxpp.core.topology import manifold_corners

METHODS = ("quadric", "isotropic")
"""Methods that bring a part to its face budget: `simplify`, or `remesh`."""


def remesh(mesh: MeshLike, face_budget: int) -> Simplified:
    """Remesh a surface with `face_budget` faces of about equal size, at most as many as it has.

    The edge length follows from the area A, L^2 = 4 A / (sqrt(3) faces). Openings stay; their edges are split and
    collapsed like all others. Folds and creases above 60 degrees keep more faces than that. Quadric edge collapse with
    a penalty on the faces' shape removes the surplus, which moves the surface less than longer edges everywhere would.
    Then the vertices are fitted to the source by least squares (`fit_to_source`). A warning names openings that alone
    need more faces than the budget.

    Args:
        mesh: manifold, possibly open (`sanitize`, `manifold_corners`).
        face_budget: number of faces.

    Returns:
        The mesh, with the source vertex nearest to each of its vertices and the reverse. Its `restored_faces` are 0.

    Raises:
        InputError: a budget below 4, or a surface that vanished.
        MissingExtraError: pymeshlab is not installed, or does not start.
    """
    mesh = as_mesh(mesh)
    require_at_least("face budget", face_budget, 4)
    wanted = min(face_budget, mesh.face_count)
    length = (4.0 * float(mesh.face_areas.sum()) / (3.0**0.5 * wanted)) ** 0.5
    # Remesh; if more than 5 % of the budget is unused, once more with shorter edges. Then remove the surplus.
    vertices, faces = _isotropic(mesh, length)
    if 0 < len(faces) < (1.0 - 0.05) * wanted:
        vertices, faces = _isotropic(mesh, length * (len(faces) / wanted) ** 0.5)
    if len(faces) > wanted:
        vertices, faces = _collapsed(vertices, faces, wanted)
    if not len(faces):
        raise InputError(
            "part to remesh",
            expected=f"a surface that {wanted} faces can cover",
            received=f"{mesh.face_count} faces of which none is left",
            remedy="give the part more faces, or keep the quadric method",
        )
    if len(faces) > (1.0 + 0.05) * wanted:
        note = f"isotropic remeshing made {len(faces)} faces where {wanted} were asked for: openings keep their edges"
        warnings.warn(note, GeometryWarning, stacklevel=2)
    # Cut non-manifold vertices, fit the vertices to the source, and map vertices in both directions.
    faces, source_of_cut = manifold_corners(faces)
    fitted = fit_to_source(TriangleMesh(vertices[source_of_cut], faces), mesh)
    result = separate_doubled_vertices(fitted, source_of_cut)
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    flipped = int(opposed_faces(result, mesh, tree).sum())
    return Simplified(result, _nearest(mesh, of=result), _nearest(result, of=mesh), 0, flipped)


def fit_to_source(mesh: TriangleMesh, source: TriangleMesh) -> TriangleMesh:
    """Move the vertices of a coarse mesh so that its faces, not its vertices, approximate the source surface.

    Faces whose vertices lie on a rounded surface cut through it. Two rounds of weighted least squares reduce that:

        min over x of sum_k a_k |p_k - B_k x|^2 + s |L (x - x0)|^2 + t |x - x0|^2

    where p_k is a vertex of the source, a_k its area, B_k the barycentric coordinates of the nearest point on the mesh,
    and L the uniform Laplacian. Vertices on borders stay, and so do those whose faces would turn by more than 60
    degrees.

    Args:
        mesh: the coarse mesh, every vertex used.
        source: the surface that it approximates.
    """
    # Area weights of the source's vertices; vertices inside the border are free.
    area = np.bincount(source.faces.ravel(), np.repeat(source.face_areas / 3.0, 3), minlength=source.vertex_count)
    points, area = source.vertices[area > 0], area[area > 0]
    free = np.ones(mesh.vertex_count, dtype=bool)
    free[mesh.border_edges] = False
    for _ in range(2):
        # Solve, then undo the moves of faces whose normal turns below a cosine of 0.5, until none does.
        moves = _least_squares_moves(mesh, points, area, free)
        while True:
            made = mesh.with_vertices(mesh.vertices + moves)
            turned = np.einsum("ij,ij->i", made.face_normals, mesh.face_normals) < 0.5
            back = np.unique(mesh.faces[turned])
            if not moves[back].any():
                break
            moves[back] = 0.0
        mesh = made
    return mesh


def _least_squares_moves(mesh: TriangleMesh, points: np.ndarray, area: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return (n, 3) displacements that solve the normal equations of `fit_to_source`; 0 where vertices are not free."""
    # B: barycentric coordinates of the nearest point to each source vertex.
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    _, face, nearest = tree.squared_distance(mesh.vertices, mesh.faces, points)
    corners, count = mesh.faces[face], mesh.vertex_count
    weights = igl.barycentric_coordinates(nearest, *(mesh.vertices[corners[:, k]] for k in range(3)))
    rows = np.repeat(np.arange(len(points)), 3)
    blend = sparse.csr_matrix((weights.ravel(), (rows, corners.ravel())), (len(points), count))
    # L: the uniform Laplacian. The weights s and t are shares of the mean data weight of a vertex: enough to regularise
    # vertices that few source points reach, too little to hold others back.
    edges = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    neighbours = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    degree = np.maximum(np.asarray(neighbours.sum(axis=1)).ravel(), 1.0)
    laplacian = sparse.identity(count) - sparse.diags(1.0 / degree) @ neighbours
    share = area.sum() / count
    system = (
        blend.T @ sparse.diags(area) @ blend
        + 0.05 * share * (laplacian.T @ laplacian)
        + 0.005 * share * sparse.identity(count)
    ).tocsr()
    aim = blend.T @ (area[:, None] * (points - blend @ mesh.vertices))
    moves = np.zeros((count, 3))
    if free.any():
        moves[free] = splu(system[free][:, free].tocsc()).solve(aim[free])
    return moves


def require_remesher(method: str) -> None:
    """Raise `MissingExtraError` if a method of `METHODS` needs a package that is not installed."""
    if method == "isotropic":
        _pymeshlab()


def _isotropic(mesh: TriangleMesh, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of the surface remeshed with edges of about a length."""
    pymeshlab = _pymeshlab()
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    # Creases above 60 degrees are kept. No edit moves the surface by more than a tenth of an edge: without this bound a
    # person's skin with its fingers, at a twelfth of its faces, shrinks by 40 mm (p95).
    meshes.meshing_isotropic_explicit_remeshing(
        iterations=10,
        targetlen=pymeshlab.PureValue(length),
        featuredeg=60.0,
        checksurfdist=True,
        maxsurfdist=pymeshlab.PureValue(0.1 * length),
    )
    return _arrays(meshes)


def _collapsed(vertices: np.ndarray, faces: np.ndarray, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges by quadric error, weighted by the faces' shape, until `wanted` faces are left."""
    pymeshlab = _pymeshlab()
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces.astype(np.int32)))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=wanted,
        qualitythr=1.0,
        preserveboundary=True,
        preservenormal=True,
        preservetopology=True,
        planarquadric=True,
    )
    return _arrays(meshes)


def _arrays(meshes: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of pymeshlab's current mesh."""
    made = meshes.current_mesh()
    return np.array(made.vertex_matrix(), dtype=np.float64), np.array(made.face_matrix(), dtype=np.int64)


def _nearest(mesh: TriangleMesh, *, of: TriangleMesh) -> np.ndarray:
    """Return, for every vertex of a mesh, the nearest corner of the nearest face of another mesh."""
    tree = igl.AABB()
    tree.init(of.vertices, of.faces)
    _, face, _ = tree.squared_distance(of.vertices, of.faces, mesh.vertices)
    corners = of.faces[face]
    distance = np.linalg.norm(of.vertices[corners] - mesh.vertices[:, None], axis=2)
    return corners[np.arange(len(corners)), distance.argmin(axis=1)].astype(np.int64)


def _pymeshlab():
    """Import pymeshlab when it is first needed."""
    return import_extra("pymeshlab", extra="remesh", purpose="isotropic remeshing", apt="libgl1 libopengl0")
