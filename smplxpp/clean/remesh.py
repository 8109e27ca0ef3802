"""Faces of one size and near equal sides: isotropic explicit remeshing (Hoppe et al. 1993), by pymeshlab.

pymeshlab is under the GPL 3 and no part of the package: it is asked for here alone, where somebody wants it.
"""

from __future__ import annotations

import warnings
from typing import Any

import igl
import numpy as np

from smplxpp.clean.settle import settled
from smplxpp.clean.simplify import Simplified, drawn_apart, opposed
from smplxpp.core.errors import GeometryWarning, InputError, MissingExtraError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import manifold_corners
from smplxpp.core.validation import require_at_least

METHODS = ("quadric", "isotropic")
"""What a part's faces can be made by: `simplify`, or `remesh`."""
_ROUNDS = 10
# Edges that turn by more degrees than this stay where they are.
_CREASE = 60.0
# No edit moves the surface by more than this share of an edge: without it a person's skin with its fingers, covered
# with a twelfth of its faces, falls in by 40 mm (p95).
_MOVED = 0.1
# The edge length is made shorter once where fewer faces than this share of the budget came out.
_SPARE = 0.05
# More faces than this share above the budget are said.
_FAR_OFF = 0.05


def remesh(mesh: TriangleMesh, face_budget: int) -> Simplified:
    """Cover a surface anew with `face_budget` faces of about equal size, at most as many as it has.

    The edge length follows from the area, L^2 = 4 A / (sqrt(3) faces). Openings stay, and their edges are divided anew
    as all others are. Folds and edges that turn by more than 60 degrees keep more faces than that: what lies above the
    budget is taken away by quadric edge collapse that minds the faces' shape, which moves the surface less than longer
    edges all over would. Then vertices leave the source for where the faces lie nearest to it (`settled`). Openings
    that alone need more faces than the budget are warned of.

    Args:
        mesh: manifold, possibly open (`sanitize`, `manifold_corners`).

    Returns:
        The mesh, with the source vertices nearest to its own and the other way round. Its `restored_faces` are 0.

    Raises:
        InputError: a budget below 4, or a surface of which nothing was left.
        MissingExtraError: pymeshlab is not installed, or does not start.
    """
    require_at_least("face budget", face_budget, 4)
    wanted = min(face_budget, mesh.face_count)
    length = (4.0 * float(mesh.face_areas.sum()) / (3.0**0.5 * wanted)) ** 0.5
    vertices, faces = _covered(mesh, length)
    if 0 < len(faces) < (1.0 - _SPARE) * wanted:
        vertices, faces = _covered(mesh, length * (len(faces) / wanted) ** 0.5)
    if len(faces) > wanted:
        vertices, faces = _collapsed(vertices, faces, wanted)
    if not len(faces):
        raise InputError(
            "part to remesh",
            expected=f"a surface that {wanted} faces can cover",
            received=f"{mesh.face_count} faces of which none is left",
            remedy="give the part more faces, or keep the quadric method",
        )
    if len(faces) > (1.0 + _FAR_OFF) * wanted:
        said = f"isotropic remeshing made {len(faces)} faces where {wanted} were asked for: openings keep their edges"
        warnings.warn(said, GeometryWarning, stacklevel=2)
    faces, source_of_cut = manifold_corners(faces)
    result = drawn_apart(settled(TriangleMesh(vertices[source_of_cut], faces), mesh), source_of_cut)
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    flipped = int(opposed(result, mesh, tree).sum())
    return Simplified(result, _nearest(mesh, of=result), _nearest(result, of=mesh), 0, flipped)


def require_remesher(method: str) -> None:
    """Raise `MissingExtraError` unless what a method of `METHODS` needs is there."""
    if method == "isotropic":
        _pymeshlab()


def _covered(mesh: TriangleMesh, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the surface with edges of about a length."""
    pymeshlab = _pymeshlab()
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    meshes.meshing_isotropic_explicit_remeshing(
        iterations=_ROUNDS,
        targetlen=pymeshlab.PureValue(length),
        featuredeg=_CREASE,
        checksurfdist=True,
        maxsurfdist=pymeshlab.PureValue(_MOVED * length),
    )
    return _arrays(meshes)


def _collapsed(vertices: np.ndarray, faces: np.ndarray, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with edges collapsed by quadric error until `wanted` faces are left: the rounder of two faces stays."""
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
    """Vertices and faces of pymeshlab's current mesh."""
    made = meshes.current_mesh()
    return np.array(made.vertex_matrix(), dtype=np.float64), np.array(made.face_matrix(), dtype=np.int64)


def _nearest(mesh: TriangleMesh, *, of: TriangleMesh) -> np.ndarray:
    """For every vertex of a mesh the vertex nearest to it on the face of another that lies nearest."""
    tree = igl.AABB()
    tree.init(of.vertices, of.faces)
    _, face, _ = tree.squared_distance(of.vertices, of.faces, mesh.vertices)
    corners = of.faces[face]
    distance = np.linalg.norm(of.vertices[corners] - mesh.vertices[:, None], axis=2)
    return corners[np.arange(len(corners)), distance.argmin(axis=1)].astype(np.int64)


def _pymeshlab():
    """The package.

    Raises:
        MissingExtraError: it is not installed, or does not start.
    """
    try:
        import pymeshlab
    except (ImportError, OSError) as error:
        missing = isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "pymeshlab"
        raise MissingExtraError(
            "pymeshlab",
            extra="remesh",
            purpose="isotropic remeshing",
            apt="" if missing else "libgl1 libopengl0",
        ) from error
    return pymeshlab
