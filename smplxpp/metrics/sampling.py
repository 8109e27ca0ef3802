"""Points on a surface: area-weighted samples, vertices, and the labels they carry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, Integer, Shaped

from smplxpp.core import (
    METRES_PER_UNIT,
    InputError,
    MeshLike,
    PointsLike,
    TriangleMesh,
    as_mesh,
    as_points,
    normalize_rows,
    require_at_least,
    require_choice,
)
from smplxpp.core.errors import one_line
from smplxpp.core.surface_points import draw_on_surface


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """P points on the surface of a mesh.

    Attributes:
        points: (P, 3) float64 metres.
        face: (P,) int64 the face that each point lies on; -1 of a point cloud.
        normals: (P, 3) float64 unit normals, see `interpolated_normals`; NaN where a point cloud has none.
    """

    points: Float64[np.ndarray, "P 3"]
    face: Int64[np.ndarray, " P"]
    normals: Float64[np.ndarray, "P 3"]

    __repr__ = one_line

    def __len__(self) -> int:
        return len(self.points)

    def select(self, mask: Bool[np.ndarray, " P"] | Integer[np.ndarray, " p"]) -> SurfaceSamples:
        """The points selected by a mask or index array."""
        return SurfaceSamples(self.points[mask], self.face[mask], self.normals[mask])


def sample_surface(mesh: MeshLike, count: int, *, seed: int | tuple[int, ...] = 0) -> SurfaceSamples:
    """Sample `count` points of a surface in proportion to area, ordered by face.

    The samples are stratified (`draw_on_surface`): unbiased like independent ones, with less variance. Neighbouring
    samples are near each other, which makes tree queries faster.

    Raises:
        InputError: `count` below 1, or a mesh without area.
    """
    mesh = as_mesh(mesh, subject="mesh")
    require_at_least("sample count", count, 1)
    require_surface(mesh, "mesh to sample")
    face, weights = draw_on_surface(mesh, count, seed=seed)
    points = np.einsum("pk,pkd->pd", weights, mesh.triangles[face])
    return SurfaceSamples(points, face, interpolated_normals(mesh, face, weights))


def vertex_samples(mesh: TriangleMesh) -> SurfaceSamples:
    """Every referenced vertex once, with one of its faces and its angle-weighted normal."""
    require_surface(mesh, "mesh to sample")
    vertex, first = np.unique(mesh.faces.ravel(), return_index=True)
    return SurfaceSamples(mesh.vertices[vertex], first // 3, mesh.vertex_normals[vertex])


def cloud_samples(points: PointsLike, *, subject: str = "points", unit: str = "m") -> SurfaceSamples:
    """Take every point of a cloud (P, 3) as a sample, in metres, with the cloud's normals where it has some.

    Raises:
        InputError: no points, NaN, another shape, or an unknown unit.
    """
    require_choice("unit", unit, tuple(METRES_PER_UNIT))
    found, normals = as_points(points, subject=subject)
    if not len(found):
        raise InputError(subject, expected="points", received="none")
    normals = np.full_like(found, np.nan) if normals is None else normals
    return SurfaceSamples(METRES_PER_UNIT[unit] * found, np.full(len(found), -1), normals)


def interpolated_normals(
    mesh: TriangleMesh, face: Integer[np.ndarray, " P"], barycentric: Float[np.ndarray, "P 3"]
) -> Float64[np.ndarray, "P 3"]:
    """The unit normals at barycentric coordinates of faces, from the angle-weighted vertex normals.

    Not the faces' own normals: the closest point of a convex surface often lies on an edge or a vertex, where the
    choice of the face, and so the angle, would be left to rounding.
    """
    return normalize_rows(np.einsum("pk,pkd->pd", barycentric, mesh.vertex_normals[mesh.faces[face]]))


def check_labels(mesh: TriangleMesh, labels: Shaped[np.ndarray, " N"], name: str) -> Int64[np.ndarray, " N"]:
    """Labels of faces (M,) or vertices (N,) as int64.

    Raises:
        InputError: not integers, or a length that fits neither or both.
    """
    labels = np.asarray(labels)
    fits = (labels.shape == (mesh.face_count,)) + (labels.shape == (mesh.vertex_count,))
    if not np.issubdtype(labels.dtype, np.integer) or fits != 1:
        raise InputError(
            name,
            expected=f"integers, one a face ({mesh.face_count}) or one a vertex ({mesh.vertex_count})",
            received=f"{labels.dtype} of shape {labels.shape}",
            remedy="give labels a face where a mesh has as many faces as vertices" if fits == 2 else "",
        )
    return labels.astype(np.int64)


def labels_at(
    mesh: TriangleMesh,
    labels: Integer[np.ndarray, " N"],
    face: Integer[np.ndarray, " P"],
    points: Float[np.ndarray, "P 3"],
) -> Int64[np.ndarray, " P"]:
    """The labels of points that lie on `face`: the face's own, or that of its corner nearest to the point."""
    if len(labels) == mesh.face_count:
        return labels[face]
    corner = np.linalg.norm(mesh.triangles[face] - points[:, None], axis=2).argmin(axis=1)
    return labels[mesh.faces[face, corner]]


def require_surface(mesh: TriangleMesh, name: str) -> None:
    """Refuse a mesh on which nothing can be measured.

    Raises:
        InputError: no faces, or no area.
    """
    if not mesh.face_count or not mesh.face_areas.any():
        raise InputError(
            name,
            expected="a surface with some area",
            received=f"{mesh.vertex_count} vertices, {mesh.face_count} faces, area 0",
        )
