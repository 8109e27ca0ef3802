"""A surface through a cloud of points: Poisson reconstruction (Kazhdan and Hoppe 2013), by open3d.

Where there are no points Poisson's surface goes on as a bubble; what lies far from every point is cut away again.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.clean.components import drop_specks
from smplxpp.clean.point_normals import NEIGHBOURS, estimate_normals
from smplxpp.core.errors import GeometryWarning, InputError, MissingExtraError
from smplxpp.core.mesh import TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.validation import require_at_least

FEWEST_POINTS = 500
"""Fewer points show no person."""
# The cube in which it is solved is this much larger than the cloud, and is halved at most so often: 2 mm on an adult.
_CUBE, _DEEPEST, _SHALLOWEST = 1.1, 10, 5
# Of points spread at random over a surface the mean distance of neighbours is about this many median nearest ones.
_MEAN_SPACING = 2.1
# A point this many times farther from its neighbours than most is no part of the surface.
_STRAY = 10.0
# Normals of a file are taken where at least this share agrees with those that are seen from outside.
_AGREE = 0.8


@dataclass(frozen=True)
class PoissonConfig:
    """Options of `surface_from_points`.

    Attributes:
        reach: surface farther from every point than this many median nearest distances is cut away.
        depth: how often the cube about the cloud is halved; None: until a cell is as wide as points lie apart.
        speck_area: components below this fraction of the area go.
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
    """A surface through points.

    Attributes:
        mesh: in the points' unit, outward; with holes where there are no points.
        source_point: (n,) the point nearest to each vertex: labels and colours of points go along by it.
        said: what was done, in words.
    """

    mesh: TriangleMesh
    source_point: Int64[np.ndarray, " n"]
    said: str


def surface_from_points(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"] | None = None,
    *,
    config: PoissonConfig | None = None,
) -> PointSurface:
    """The surface of a person of whom points are known; the same points give the same bits. Warns with what was done.

    Points that are not finite, that repeat another or lie apart from all are left out. Normals that are given are used
    as they are, turned over, or not at all: whichever agrees with what is seen from outside (`estimate_normals`).

    Args:
        points: of the surface, sampled about evenly; may hold NaN.
        normals: of any length, outward or inward; zero or NaN where unknown.
        config: options.

    Raises:
        MissingExtraError: open3d is not installed, or lacks libraries of the system.
        InputError: too few points.
    """
    config = config or PoissonConfig()
    open3d = _open3d()
    points = np.asarray(points, np.float64)
    kept = _usable(points)
    tree = cKDTree(points[kept])
    spacing = float(np.median(tree.query(points[kept], k=2)[0][:, 1]))
    outward, about_normals = _normals(points[kept], None if normals is None else np.asarray(normals)[kept])
    depth = config.depth or _depth(points[kept], spacing)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[kept]))
    cloud.normals = open3d.utility.Vector3dVector(np.ascontiguousarray(outward))
    # Several threads add in another order each time.
    made, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, scale=_CUBE, n_threads=1)
    whole = TriangleMesh(np.asarray(made.vertices), np.asarray(made.triangles).astype(np.int64))
    distance, _ = tree.query(whole.vertices)
    near = (distance <= config.reach * spacing)[whole.faces].all(axis=1)
    if not near.any():
        raise InputError("point cloud", expected="points of a surface", received="points that no surface goes through")
    cut, _ = whole.submesh(near)
    mesh, _ = cut.submesh(drop_specks(cut, area_fraction=config.speck_area))
    said = (
        f"point cloud of {len(points)} points, {spacing:.2g} apart: surface of {mesh.face_count} faces by Poisson "
        f"reconstruction (depth {depth}), {about_normals}; {len(points) - len(kept)} points left out, "
        f"{1 - mesh.face_areas.sum() / whole.face_areas.sum():.0%} of the surface cut away, where no points are"
    )
    warnings.warn(said, GeometryWarning, stacklevel=2)
    return PointSurface(mesh, kept[tree.query(mesh.vertices)[1]], said)


def _open3d():
    """The package.

    Raises:
        MissingExtraError: it is not installed, or does not start.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        missing = isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "open3d"
        raise MissingExtraError(
            "open3d",
            extra="scan",
            purpose="a surface from a point cloud",
            apt="" if missing else "libusb-1.0-0 libgl1 libegl1 libx11-6",
        ) from error
    return open3d


def _usable(points: Float[np.ndarray, "N 3"]) -> Int64[np.ndarray, " n"]:
    """The points that are finite, no repetitions, and not apart from all others."""
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    kept = finite[np.sort(np.unique(points[finite], axis=0, return_index=True)[1])]
    if len(kept) >= FEWEST_POINTS:
        apart = cKDTree(points[kept]).query(points[kept], k=NEIGHBOURS // 2)[0].mean(axis=1)
        kept = kept[apart <= _STRAY * np.median(apart)]
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
    """Outward normals, and where they are from."""
    estimated = estimate_normals(points)
    if given is None:
        return estimated, "normals estimated"
    known = np.isfinite(given).all(axis=1) & (row_lengths(np.nan_to_num(given)) > 0)
    own = normalize_rows(np.where(known[:, None], np.nan_to_num(given), 0.0))
    share = float(_agrees(own[known], estimated[known]).mean()) if known.any() else 0.5
    if share >= _AGREE:
        return np.where(known[:, None], own, estimated), "normals of the file"
    if share <= 1 - _AGREE:
        return np.where(known[:, None], -own, estimated), "normals of the file turned over: they point inward"
    return estimated, f"normals estimated: of those of the file {share:.0%} point outward"


def _agrees(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    return np.einsum("ij,ij->i", a, b) > 0


def _depth(points: Float[np.ndarray, "n 3"], spacing: float) -> int:
    cells = _CUBE * np.ptp(points, axis=0).max() / (_MEAN_SPACING * spacing)
    return int(np.clip(np.rint(np.log2(cells)), _SHALLOWEST, _DEEPEST))
