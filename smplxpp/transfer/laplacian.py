"""The cotangent Laplacian and the mass of a triangle mesh, also where faces are bad."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64

from smplxpp.core.mesh import TriangleMesh, row_lengths

_SLACK = 1e-4  # of the mean edge: how far mollification keeps a face from collapsing
_SMALL_ANGLE = np.radians(0.1)


def edge_lengths(mesh: TriangleMesh) -> Float64[np.ndarray, "M 3"]:
    """The lengths of the edges opposite to each corner."""
    t = mesh.triangles
    return np.stack([row_lengths(t[:, (k + 1) % 3] - t[:, (k + 2) % 3]) for k in range(3)], axis=1)


def mollify(lengths: Float[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 3"]:
    """Lengthen all edges by the least constant that makes every face a proper triangle.

    `l_a + l_b - l_c >= 1e-4 * mean` afterwards (Sharp and Crane, "A Laplacian for Nonmanifold Triangle Meshes", 2020,
    section 4.5); unchanged where all faces are proper already.
    """
    shortfall = _SLACK * lengths.mean() - (lengths.sum(axis=1, keepdims=True) - 2.0 * lengths)
    return lengths + max(0.0, float(shortfall.max(initial=0.0)))


def laplacian_and_mass(mesh: TriangleMesh, *, kind: str = "auto") -> tuple[sp.csc_matrix, Float64[np.ndarray, " N"]]:
    """Cotangent matrix C (N, N), negative semi-definite, and Voronoi masses (N,), all positive.

    Args:
        mesh: every vertex referenced by a face.
        kind: "cotangent": as the mesh is (zero-area faces are still mollified: their cotangents do not exist).
            "intrinsic": edges flipped to an intrinsic Delaunay triangulation (Bobenko and Springborn 2007), which has
            no negative weights; needs at most two faces at an edge, wound alike. "auto": "intrinsic"
            where some angle is below 0.1 degrees, else "cotangent".
    """
    lengths = edge_lengths(mesh)
    if kind == "auto":
        kind = "intrinsic" if _smallest_angle(lengths) < _SMALL_ANGLE else "cotangent"
    lengths, faces = mollify(lengths), mesh.faces
    if kind == "intrinsic" and igl.is_edge_manifold(faces)[0]:
        lengths, faces = igl.intrinsic_delaunay_triangulation(lengths, faces)[:2]
    cotangent = igl.cotmatrix_intrinsic(lengths, faces)
    mass = igl.massmatrix_intrinsic(lengths, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    return sp.csc_matrix(cotangent), mass


def _smallest_angle(lengths: np.ndarray) -> float:
    """Radians; 0 where a face has no area."""
    a, b, c = np.sort(lengths, axis=1).T  # the smallest angle lies opposite to a
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.where(b * c > 0, (b * b + c * c - a * a) / (2 * b * c), 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)).min(initial=np.pi / 3))
