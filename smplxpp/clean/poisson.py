"""Reconstruct a surface from a point cloud by screened Poisson reconstruction (Kazhdan and Hoppe 2013), with open3d.

Where there are no points the Poisson surface continues as a bubble; faces far from every point are therefore cut away.
Normals come from principal component analysis of neighbourhoods, oriented by visibility from outside.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from smplxpp.clean.parts import drop_specks
from smplxpp.core import TriangleMesh, normalize_rows, require_at_least, row_lengths
from smplxpp.core.errors import GeometryWarning, InputError, one_line
from smplxpp.core.foreign import PointsLike, as_array, point_arrays
from smplxpp.core.lazy import OPEN3D_NEEDS, import_extra

FEWEST_POINTS = 500
"""Least number of points; fewer cannot show a person."""
NEIGHBOURS = 16
"""Points in the neighbourhood of a normal."""
# The octree: its cube relative to the cloud, and the range of its depth. Depth 10 is 2 mm on an adult.
_CUBE, _DEEPEST, _SHALLOWEST = 1.1, 10, 5


@dataclass(frozen=True)
class PoissonConfig:
    """Options of reconstructing a surface with `surface_from_points`.

    Attributes:
        reach: distance to the nearest point, in median point spacings, above which the surface is cut away.
        depth: depth of the octree; None chooses cells as wide as the mean distance of the points.
        speck_area: area fraction below which components are removed.
    """

    reach: float = 4.0
    depth: int | None = None
    speck_area: float = 1e-3

    def __post_init__(self) -> None:
        require_at_least("reach", self.reach, 1.0)
        if self.depth is not None and not _SHALLOWEST <= self.depth <= _DEEPEST:
            raise InputError("depth", expected=f"{_SHALLOWEST} to {_DEEPEST}", received=str(self.depth))


@dataclass(frozen=True, eq=False)
class PointSurface:
    """A surface reconstructed from a point cloud.

    Attributes:
        mesh: in the points' unit, oriented outward, with holes where there are no points.
        source_point: (n,) index of the point nearest to each vertex, which gives it labels and colours.
        note: summary of the reconstruction for logs.
    """

    mesh: TriangleMesh
    source_point: Int64[np.ndarray, " n"]
    note: str

    __repr__ = one_line


def surface_from_points(
    points: PointsLike,
    normals: ArrayLike | None = None,
    *,
    config: PoissonConfig | None = None,
) -> PointSurface:
    """Reconstruct the surface of a person from points; the same points give the same bits.

    Points that are not finite, duplicates and outliers are left out. Given normals are used as they are, flipped, or
    not at all, depending on their agreement with estimated ones (`estimate_normals`). A warning summarises the result.

    Args:
        points: points of the surface, sampled about evenly; may hold NaN.
        normals: normals of any length, outward or inward; zero or NaN where unknown; None takes a cloud's own.
        config: options.

    Raises:
        MissingExtraError: open3d is not installed, or lacks libraries of the system.
        InputError: too few points.
    """
    # Select usable points, orient their normals, choose the octree's depth.
    config = config or PoissonConfig()
    open3d = import_extra("open3d", extra="scan", purpose="a surface from a point cloud", apt=OPEN3D_NEEDS)
    points, own = point_arrays(points)
    normals = own if normals is None else normals
    kept = _usable(points)
    tree = cKDTree(points[kept])
    spacing = float(np.median(tree.query(points[kept], k=2)[0][:, 1]))
    outward, about_normals = _normals(points[kept], None if normals is None else as_array(normals)[kept])
    depth = config.depth or _depth(points[kept], spacing)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[kept]))
    cloud.normals = open3d.utility.Vector3dVector(np.ascontiguousarray(outward))
    # One thread, because the order of summation varies between runs of several threads.
    made, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, scale=_CUBE, n_threads=1)
    whole = TriangleMesh(np.asarray(made.vertices), np.asarray(made.triangles).astype(np.int64))
    # Cut away what is far from every point, and specks.
    distance, _ = tree.query(whole.vertices)
    near = (distance <= config.reach * spacing)[whole.faces].all(axis=1)
    if not near.any():
        raise InputError("point cloud", expected="points of a surface", received="points that no surface goes through")
    cut, _ = whole.submesh(near)
    mesh, _ = cut.submesh(drop_specks(cut, area_fraction=config.speck_area))
    note = (
        f"point cloud of {len(points)} points, {spacing:.2g} apart: surface of {mesh.face_count} faces by Poisson "
        f"reconstruction (depth {depth}), {about_normals}; {len(points) - len(kept)} points left out, "
        f"{1 - mesh.face_areas.sum() / whole.face_areas.sum():.0%} of the surface cut away, where no points are"
    )
    warnings.warn(note, GeometryWarning, stacklevel=2)
    return PointSurface(mesh, kept[tree.query(mesh.vertices)[1]], note)


def _usable(points: Float[np.ndarray, "N 3"]) -> Int64[np.ndarray, " n"]:
    """Return the indices of points that are finite, no duplicates, and no outliers.

    An outlier is ten times farther from its eight nearest points than the median point.
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    # `unique` sorts by position; sorting its indices restores the order of the file.
    kept = finite[np.sort(np.unique(points[finite], axis=0, return_index=True)[1])]
    if len(kept) >= FEWEST_POINTS:
        apart = cKDTree(points[kept]).query(points[kept], k=NEIGHBOURS // 2)[0].mean(axis=1)
        kept = kept[apart <= 10.0 * np.median(apart)]
    if len(kept) < FEWEST_POINTS:
        raise InputError(
            "point cloud",
            expected=f"at least {FEWEST_POINTS} points of a surface",
            received=f"{len(kept)} of use among {len(points)}",
            remedy="export more points, or the surface",
        )
    return kept


def _normals(
    points: Float[np.ndarray, "n 3"], given: Float[np.ndarray, "n 3"] | None
) -> tuple[Float64[np.ndarray, "n 3"], str]:
    """Return outward normals, and a description of their source.

    Given normals are used if at least 80 % agree with the estimated ones, and flipped if at most 20 % do.
    """
    agreement = 0.8
    estimated = estimate_normals(points)
    if given is None:
        return estimated, "normals estimated"
    # Rows that are not finite or zero have no normal and take the estimated one.
    known = np.isfinite(given).all(axis=1) & (row_lengths(np.nan_to_num(given)) > 0)
    own = normalize_rows(np.where(known[:, None], np.nan_to_num(given), 0.0))
    share = float(_agrees(own[known], estimated[known]).mean()) if known.any() else 0.5
    if share >= agreement:
        return np.where(known[:, None], own, estimated), "normals of the file"
    if share <= 1 - agreement:
        return np.where(known[:, None], -own, estimated), "normals of the file turned over: they point inward"
    return estimated, f"normals estimated: of those of the file {share:.0%} point outward"


def _agrees(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    return np.einsum("ij,ij->i", a, b) > 0


def _depth(points: Float[np.ndarray, "n 3"], spacing: float) -> int:
    """Return the octree's depth at which a cell is as wide as the mean distance of neighbouring points.

    For random points on a surface that is about 2.1 times `spacing`, the median distance to the nearest point.
    """
    cells = _CUBE * np.ptp(points, axis=0).max() / (2.1 * spacing)
    return int(np.clip(np.rint(np.log2(cells)), _SHALLOWEST, _DEEPEST))


def estimate_normals(points: PointsLike) -> Float64[np.ndarray, "N 3"]:
    """Estimate outward unit normals of a point cloud of a body's surface.

    A normal is that of the plane through the nearest neighbours. Its sign comes from visibility: a point that a view
    from outside sees faces it. Propagating signs along a minimum spanning tree would fail where sleeve and trunk touch.
    Points that no view sees take their neighbours' sign.

    Args:
        points: points without duplicates, of a surface that is sampled about evenly.
    """
    # Normals in batches, which bound the memory.
    points, _ = point_arrays(points)
    tree = cKDTree(points)
    near, neighbours = tree.query(points, k=min(NEIGHBOURS, len(points)))
    normals = np.concatenate(
        [_plane_normals(points[rows]) for rows in np.array_split(neighbours, len(neighbours) // (1 << 17) + 1)]
    )
    # Average the votes of neighbours eight times, weighted by the squared cosine of the normals, with its sign: a
    # neighbour with a parallel normal counts in full, one across an edge little.
    votes = _votes_of_views(points, normals, spacing=float(np.median(near[:, 1])))
    for _ in range(8):
        alike = np.einsum("ij,ikj->ik", normals, normals[neighbours])
        votes = np.einsum("ik,ik->i", alike * np.abs(alike), votes[neighbours]) / neighbours.shape[1]
    return np.where(votes[:, None] < 0, -normals, normals)


def _plane_normals(neighbourhoods: Float[np.ndarray, "n k 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the directions of least variance of neighbourhoods."""
    centred = neighbourhoods - neighbourhoods.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0]


def _votes_of_views(
    points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"], *, spacing: float
) -> Float64[np.ndarray, " N"]:
    """Return the mean cosine of each point's normal with the directions of the views that see it, over 96 views.

    A view is an orthographic depth buffer with cells of two point spacings, so that a surface that faces the view
    leaves few cells empty. A point is visible if it lies at most 1.5 cells behind the foremost one around it.
    """
    views, cell = 96, 2.0 * spacing
    votes = np.zeros(len(points))
    for direction in _directions(views):
        across = np.linalg.svd(direction[None])[2][1:]  # two axes of the image
        column = np.floor((points @ across.T) / cell).astype(np.int64)
        column -= column.min(axis=0)
        seen = _foremost(column, points @ direction, depth=1.5 * cell)
        votes += np.where(seen, normals @ direction, 0.0)
    return votes / views


def _foremost(cells: Int64[np.ndarray, "N 2"], height: Float[np.ndarray, " N"], *, depth: float) -> np.ndarray:
    """Return (N,) whether each point lies within `depth` of the highest one in its cell and the eight around it."""
    shape = cells.max(axis=0) + 1
    top = np.full(int(shape.prod()), -np.inf)
    index = cells[:, 0] * shape[1] + cells[:, 1]
    np.maximum.at(top, index, height)
    top = maximum_filter(top.reshape(shape), size=3, mode="constant", cval=-np.inf).ravel()
    return height >= top[index] - depth


def _directions(count: int) -> Float64[np.ndarray, "count 3"]:
    """Return unit vectors spread evenly over the sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z * z)
    return normalize_rows(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1))
