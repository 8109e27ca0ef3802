"""Distances between two surfaces: point to surface, Chamfer, Hausdorff, normals' angle, F-score, per label."""

from __future__ import annotations

import atexit
import math
from dataclasses import replace
from functools import partial
from typing import cast
from weakref import WeakKeyDictionary

import igl
import numpy as np
from jaxtyping import Float64, Int64, Shaped
from scipy.spatial import cKDTree

from smplxpp.core import (
    InputError,
    MeshLike,
    PointsLike,
    TriangleMesh,
    as_mesh,
    as_points,
    require_at_least,
    require_positive,
)
from smplxpp.core.foreign import is_cloud
from smplxpp.core.signed_distance import barycentric_coordinates
from smplxpp.metrics.comparison import MM, CompareConfig, DirectedDistances, MeshComparison, summarize
from smplxpp.metrics.conventions import DEFAULT, convention_named
from smplxpp.metrics.hausdorff import hausdorff
from smplxpp.metrics.quality import warn_of_mixed_winding
from smplxpp.metrics.sampling import (
    SurfaceSamples,
    check_labels,
    cloud_samples,
    interpolated_normals,
    labels_at,
    require_surface,
    sample_surface,
    vertex_samples,
)
from smplxpp.raster import outer_visible_points

_TREES: WeakKeyDictionary[TriangleMesh, tuple[igl.AABB, Int64[np.ndarray, "F 3"], Int64[np.ndarray, " F"]]] = (
    WeakKeyDictionary()
)
"""Search trees of the two meshes asked of last, because a comparison asks each of its meshes twice, and comparisons by
several conventions ask the same two."""
# What is alive when the interpreter ends, libigl's bindings report as a leak.
atexit.register(_TREES.clear)


def point_to_surface(
    points: PointsLike, mesh: MeshLike
) -> tuple[Float64[np.ndarray, " P"], Float64[np.ndarray, "P 3"], Int64[np.ndarray, " P"]]:
    """Closest points of `mesh` to (P, 3) points: distance (P,) metres, closest (P, 3), face (P,).

    Exact, in float64, by an axis-aligned box tree (libigl). Faces without area are not hit: they add no surface.

    Raises:
        InputError: NaN or infinite points, another shape, or a mesh without area.
    """
    mesh = as_mesh(mesh, subject="target mesh")
    found, _ = as_points(points)
    require_surface(mesh, "target mesh")
    if not len(found):
        return np.zeros(0), np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    tree, faces, solid = _tree_of(mesh)
    squared, face, closest = tree.squared_distance(mesh.vertices, faces, found)
    return np.sqrt(squared), closest, solid[face]


def _tree_of(mesh: TriangleMesh) -> tuple[igl.AABB, Int64[np.ndarray, "F 3"], Int64[np.ndarray, " F"]]:
    """Return the search tree over the faces with an area, these faces, and their indices in the mesh."""
    if mesh not in _TREES:
        solid = np.flatnonzero(mesh.face_areas > 0)
        faces, tree = mesh.faces[solid], igl.AABB()
        tree.init(mesh.vertices, faces)
        _TREES[mesh] = tree, faces, solid
        for oldest in list(_TREES)[:-2]:
            _TREES.pop(oldest, None)
    return _TREES[mesh]


def directed_distances(
    source: MeshLike | PointsLike,
    target: MeshLike | PointsLike,
    *,
    samples: int = 100_000,
    seed: int = 0,
    preset: str = DEFAULT,
    source_labels: Shaped[np.ndarray, " S"] | None = None,
    target_labels: Shaped[np.ndarray, " T"] | None = None,
    config: CompareConfig | None = None,
) -> DirectedDistances:
    """Distances from points of `source` to `target`, one by one (for histograms and heat maps); see `compare`.

    A point's label is the source's own where it has labels, else that of the closest point.

    Raises:
        InputError: as `compare`.
    """
    convention, config = convention_named(preset), config or CompareConfig()
    one, other = _side(source, "source mesh", config), _side(target, "target mesh", config)
    if isinstance(one, SurfaceSamples):
        points = one
    else:
        points = sample_surface(one, samples, seed=seed) if convention.points == "area" else vertex_samples(one)
        if config.visible_only:
            points = visible_samples(one, points, config)
    # Exact point-to-triangle distance, or, as some published protocols have it, to the nearest of sampled points.
    if not isinstance(other, SurfaceSamples) and convention.target == "surface":
        distance, closest, face = point_to_surface(points.points, other)
        barycentric = barycentric_coordinates(closest, other.triangles[face])
        normals, index = interpolated_normals(other, face, barycentric), face
    else:
        # A stream of its own: two samplings of the same mesh must not coincide.
        cloud = other if isinstance(other, SurfaceSamples) else sample_surface(other, samples, seed=(seed, 1))
        distance, index = cKDTree(cloud.points).query(points.points)
        closest, face, normals = cloud.points[index], cloud.face[index], cloud.normals[index]
    label = None
    if source_labels is not None:
        label = _labels_of(one, source_labels, "source labels", points.face, points.points)
    elif target_labels is not None:
        label = _labels_of(other, target_labels, "target labels", face if face.min() >= 0 else index, closest)
    return DirectedDistances(points, distance, closest, face, _angle_deg(points.normals, normals), label)


def visible_samples(mesh: TriangleMesh, samples: SurfaceSamples, config: CompareConfig) -> SurfaceSamples:
    """Choose the samples that a view from outside can see, within the tolerance of a configuration.

    Inner sides and inner layers that no scanner sees exist in one of two meshes only and would count as errors. Where
    one mesh is compared with several, the choice can be made once and given to `directed_distances`.

    Raises:
        InputError: none of them is visible.

    Example:
        >>> seen = visible_samples(scan, sample_surface(scan, 1000), CompareConfig())
        >>> len(seen) <= 1000
        True
    """
    return samples.select(_seen(mesh, samples.points, config))


def compare(
    pred: MeshLike | PointsLike,
    gt: MeshLike | PointsLike,
    *,
    samples: int = 100_000,
    seed: int = 0,
    preset: str = DEFAULT,
    pred_labels: Shaped[np.ndarray, " S"] | None = None,
    gt_labels: Shaped[np.ndarray, " T"] | None = None,
    config: CompareConfig | None = None,
) -> MeshComparison:
    """Compare a predicted surface with the true one.

    By default `p2s = mean d(pred -> gt surface)` and `chamfer = (mean d(pred -> gt) + mean d(gt -> pred)) / 2` in mm
    over `samples` area-weighted points a mesh, distances unsquared. Other papers' definitions are presets
    (`smplxpp.metrics.presets`).

    Args:
        pred: metres, or `config.unit`. A point cloud is measured from all of its points, and to the nearest.
        gt: the truth, likewise.
        samples: points a mesh, before the choice of visible ones.
        seed: of the samples; the same seed, the same bits.
        preset: the convention of `p2s` and `chamfer`.
        pred_labels: labels of the faces (M,) or vertices (N,) of `pred`; each adds a result a label. A mesh without
            labels takes those of the closest points of the other.
        gt_labels: those of `gt`.
        config: thresholds, visible-only, certified Hausdorff distance, unit.

    Raises:
        InputError: a mesh without area, unknown preset, wrong labels, a threshold that is not positive.

    Warns:
        GeometryWarning: the winding of a mesh is mixed, so that the angle of the normals means nothing.

    Example:
        >>> result = compare(template, scan, gt_labels=scan_labels)
        >>> result.p2s, result.gt_to_pred.p95, result.labels["upper"].chamfer
    """
    convention, config = convention_named(preset), config or CompareConfig()
    for threshold in config.thresholds_mm or (math.nan,):
        require_positive("comparison config threshold_mm", threshold)
    require_at_least("comparison config visible_tolerance", config.visible_tolerance, 0.0)
    # Convert once; from here on all is in metres.
    one, other = _side(pred, "predicted mesh", config), _side(gt, "true mesh", config)
    config = replace(config, unit="m")
    measure = partial(directed_distances, samples=samples, seed=seed, preset=preset, config=config)
    forth = measure(one, other, source_labels=pred_labels, target_labels=gt_labels)
    back = measure(other, one, source_labels=gt_labels, target_labels=pred_labels)
    result = summarize(forth, back, convention=convention, threshold_mm=config.thresholds_mm)
    if isinstance(one, SurfaceSamples) or isinstance(other, SurfaceSamples):
        return result
    for mesh, name in ((one, "predicted mesh"), (other, "true mesh")):
        warn_of_mixed_winding(mesh, (forth.angle, back.angle), name)
    # A spike's tip is a vertex, which samples miss.
    tips = [forth.distance, back.distance]
    if config.certified and not config.visible_only:
        bounds = hausdorff(one, other)
        found, upper = bounds.lower_mm, bounds.upper_mm
    else:
        seen = [m.vertices[m.referenced] for m in (one, other)]
        if config.visible_only:
            seen = [p[_seen(m, p, config)] for m, p in zip((one, other), seen, strict=True)]
        tips += [point_to_surface(p, m)[0] for p, m in zip(seen, (other, one), strict=True)]
        found, upper = 0.0, None
    sampled = max(float(d.max(initial=0.0)) for d in tips) * MM
    return replace(result, hausdorff=max(sampled, found), hausdorff_upper=upper)


def _side(given: MeshLike | PointsLike, subject: str, config: CompareConfig) -> TriangleMesh | SurfaceSamples:
    """Return a mesh with an area, or the points of a cloud, in metres."""
    if isinstance(given, SurfaceSamples):
        return given
    if is_cloud(given):
        if config.visible_only:
            raise InputError(subject, expected="a mesh, to see what is visible", received="a point cloud")
        return cloud_samples(given, subject=subject, unit=config.unit)
    mesh = as_mesh(cast(MeshLike, given), subject=subject, unit=config.unit)
    require_surface(mesh, subject)
    return mesh


def _seen(mesh: TriangleMesh, points: np.ndarray, config: CompareConfig) -> np.ndarray:
    seen = outer_visible_points(mesh, points, tolerance=config.visible_tolerance)
    if not seen.any():
        raise InputError(
            "visible samples", expected="some", received="none", remedy="raise visible_tolerance or samples"
        )
    return seen


def _labels_of(
    side: TriangleMesh | SurfaceSamples, labels: np.ndarray, name: str, index: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return labels at points of a mesh's faces, or of a cloud by the points' indices (-1: all of them, in order)."""
    if isinstance(side, TriangleMesh):
        return labels_at(side, check_labels(side, labels, name), index, points)
    labels = np.asarray(labels)
    if labels.shape != (len(side),) or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(name, expected=f"integers, one a point ({len(side)})", received=f"shape {labels.shape}")
    return labels.astype(np.int64)[index] if index.min() >= 0 else labels.astype(np.int64)


def _angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # Kahan's form: accurate at 0 and 180 degrees, where arccos of the dot product is not.
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)))
