"""Distances between two surfaces: point to surface, Chamfer, Hausdorff, normals' angle, F-score, per label."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import partial

import igl
import numpy as np
from jaxtyping import Float64, Int64, Num, Shaped
from scipy.spatial import cKDTree

from smplxpp.core import LABELS, InputError, MeshLike, as_mesh, require_at_least, require_positive
from smplxpp.core.signed_distance import barycentric_coordinates
from smplxpp.metrics.conventions import DEFAULT, Convention, convention_named
from smplxpp.metrics.sampling import (
    SurfaceSamples,
    check_labels,
    interpolated_normals,
    labels_at,
    require_surface,
    sample_surface,
    vertex_samples,
)
from smplxpp.raster import outer_visible_points

MM = 1e3


@dataclass(frozen=True)
class CompareConfig:
    """Less common options of `compare`.

    Attributes:
        threshold_mm: of precision, recall and F-score.
        visible_only: measure from the points of each mesh that some camera outside could see. The skin under clothes
            has no counterpart on a scan; with it, template to scan measures the clothes' depth. Targets stay whole.
        visible_tolerance: metres that another face may hide a point by and still count as seen.
    """

    threshold_mm: float = 5.0
    visible_only: bool = False
    visible_tolerance: float = 1e-3


@dataclass(frozen=True, eq=False)
class DirectedDistances:
    """What was measured from P samples of one mesh to the other.

    Attributes:
        samples: the points, their faces and normals.
        distance: (P,) float64 metres, unsigned.
        closest: (P, 3) float64 the target's point.
        face: (P,) int64 the target's face there.
        angle: (P,) float64 degrees in [0, 180] between the normals; a target with reversed winding gives 180.
        label: (P,) int64, or None without labels.
    """

    samples: SurfaceSamples
    distance: Float64[np.ndarray, " P"]
    closest: Float64[np.ndarray, "P 3"]
    face: Int64[np.ndarray, " P"]
    angle: Float64[np.ndarray, " P"]
    label: Int64[np.ndarray, " P"] | None = None


@dataclass(frozen=True)
class DirectionStats:
    """Statistics of unsquared distances in mm from `count` points; mean normals' angle in degrees."""

    count: int
    mean: float
    median: float
    rms: float
    p95: float
    max: float
    normal_angle_deg: float


@dataclass(frozen=True)
class MeshComparison:
    """Distances between two surfaces, in both directions.

    Attributes:
        convention, unit: what `p2s` and `chamfer` mean and their unit; everything else is in mm whatever the preset.
        p2s, chamfer: as the convention defines them; None where it does not, or where a label has no point on a side.
        pred_to_gt, gt_to_pred: statistics of both directions (gt_to_pred is also called completeness).
        hausdorff: the larger of both maxima, mm.
        precision, recall, fscore: shares within `threshold_mm` from pred to gt, from gt to pred, their harmonic mean.
        labels: the same for the samples of each label, against the whole of the other mesh.
    """

    convention: str
    unit: str
    p2s: float | None
    chamfer: float | None
    pred_to_gt: DirectionStats | None
    gt_to_pred: DirectionStats | None
    hausdorff: float | None
    precision: float | None
    recall: float | None
    fscore: float | None
    threshold_mm: float
    labels: dict[str, MeshComparison] = field(default_factory=dict)

    def as_dict(self) -> dict:
        """Return the figures as plain nested dictionaries for JSON."""
        return asdict(self)


def point_to_surface(
    points: Num[np.ndarray, "P 3"], mesh: MeshLike
) -> tuple[Float64[np.ndarray, " P"], Float64[np.ndarray, "P 3"], Int64[np.ndarray, " P"]]:
    """Closest points of `mesh` to (P, 3) points: distance (P,) metres, closest (P, 3), face (P,).

    Exact, in float64, by an axis-aligned box tree (libigl). Faces without area are not hit: they add no surface.

    Raises:
        InputError: NaN or infinite points, another shape, or a mesh without area.
    """
    mesh = as_mesh(mesh, subject="target mesh")
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError("points", expected="finite values of shape (P, 3)", received=f"shape {points.shape} or NaN")
    require_surface(mesh, "target mesh")
    # The tree is built over faces with an area; `solid` leads back to their indices in the mesh.
    solid = np.flatnonzero(mesh.face_areas > 0)
    faces = mesh.faces[solid]
    if not len(points):
        return np.zeros(0), np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    tree = igl.AABB()
    tree.init(mesh.vertices, faces)
    squared, face, closest = tree.squared_distance(mesh.vertices, faces, points)
    return np.sqrt(squared), closest, solid[face]


def directed_distances(
    source: MeshLike,
    target: MeshLike,
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
    source = as_mesh(source, subject="source mesh")
    target = as_mesh(target, subject="target mesh")
    convention, config = convention_named(preset), config or CompareConfig()
    require_surface(source, "source mesh")
    require_surface(target, "target mesh")
    points = sample_surface(source, samples, seed=seed) if convention.points == "area" else vertex_samples(source)
    # Inner sides and inner layers that no scanner sees exist in one of the meshes only and would count as errors.
    if config.visible_only:
        seen = outer_visible_points(source, points.points, tolerance=config.visible_tolerance)
        points = points.select(seen)
        if not len(points):
            raise InputError(
                "visible samples", expected="some", received="none", remedy="raise visible_tolerance or samples"
            )
    # Exact point-to-triangle distance, or, as some published protocols have it, to the nearest of sampled points.
    if convention.target == "surface":
        distance, closest, face = point_to_surface(points.points, target)
        barycentric = barycentric_coordinates(closest, target.triangles[face])
        normals = interpolated_normals(target, face, barycentric)
    else:
        # A stream of its own: two samplings of the same mesh must not coincide.
        cloud = sample_surface(target, samples, seed=(seed, 1))
        distance, index = cKDTree(cloud.points).query(points.points)
        closest, face, normals = cloud.points[index], cloud.face[index], cloud.normals[index]
    label = None
    if source_labels is not None:
        label = labels_at(source, check_labels(source, source_labels, "source labels"), points.face, points.points)
    elif target_labels is not None:
        label = labels_at(target, check_labels(target, target_labels, "target labels"), face, closest)
    return DirectedDistances(points, distance, closest, face, _angle_deg(points.normals, normals), label)


def compare(
    pred: MeshLike,
    gt: MeshLike,
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
        pred, gt: metres.
        samples: points a mesh, before the choice of visible ones.
        seed: of the samples; the same seed, the same bits.
        preset: the convention of `p2s` and `chamfer`.
        pred_labels, gt_labels: labels of the faces (M,) or vertices (N,) of either mesh; each adds a result a label. A
            mesh without labels takes those of the closest points of the other.
        config: threshold, visible-only.

    Raises:
        InputError: a mesh without area, unknown preset, wrong labels, a threshold that is not positive.

    Example:
        >>> result = compare(template, scan, gt_labels=scan_labels)
        >>> result.p2s, result.gt_to_pred.p95, result.labels["upper"].chamfer
    """
    pred = as_mesh(pred, subject="predicted mesh")
    gt = as_mesh(gt, subject="true mesh")
    convention, config = convention_named(preset), config or CompareConfig()
    require_positive("comparison config threshold_mm", config.threshold_mm)
    require_at_least("comparison config visible_tolerance", config.visible_tolerance, 0.0)
    measure = partial(directed_distances, samples=samples, seed=seed, preset=preset, config=config)
    forth = measure(pred, gt, source_labels=pred_labels, target_labels=gt_labels)
    back = measure(gt, pred, source_labels=gt_labels, target_labels=pred_labels)
    return summarize(forth, back, convention=convention, threshold_mm=config.threshold_mm)


def summarize(
    pred_to_gt: DirectedDistances, gt_to_pred: DirectedDistances, *, convention: Convention, threshold_mm: float
) -> MeshComparison:
    """The comparison that two sets of distances give, with one a label where they carry labels."""
    every = [np.ones(len(d.distance), dtype=bool) for d in (pred_to_gt, gt_to_pred)]
    labels = {}
    if pred_to_gt.label is not None and gt_to_pred.label is not None:
        names = {label.id: label.name for label in LABELS}
        for k in np.union1d(pred_to_gt.label, gt_to_pred.label).tolist():
            masks = [pred_to_gt.label == k, gt_to_pred.label == k]
            labels[names.get(k, str(k))] = _summary(pred_to_gt, gt_to_pred, masks, convention, threshold_mm, {})
    return _summary(pred_to_gt, gt_to_pred, every, convention, threshold_mm, labels)


def _summary(
    forth: DirectedDistances,
    back: DirectedDistances,
    masks: list[np.ndarray],
    convention: Convention,
    threshold_mm: float,
    labels: dict[str, MeshComparison],
) -> MeshComparison:
    there, back_again = _stats(forth, masks[0]), _stats(back, masks[1])
    # Precision is the share of predicted points within the threshold, recall that of the true points, F-score their
    # harmonic mean. The Chamfer distance follows the convention; Hausdorff is the larger of the two maxima.
    distances = [d.distance[mask] for d, mask in zip((forth, back), masks, strict=True)]
    directed = [convention.directed(d) if len(d) else None for d in distances]
    precision, recall = (float(np.mean(d * MM <= threshold_mm)) if len(d) else None for d in distances)
    chamfer = hausdorff = fscore = None
    if directed[0] is not None and directed[1] is not None:
        chamfer = convention.chamfer(directed[0], directed[1])
    if there is not None and back_again is not None:
        hausdorff = max(there.max, back_again.max)
    if precision is not None and recall is not None:
        # Nothing within the threshold on either side is a score of 0, not an undefined one.
        total = precision + recall
        fscore = 2.0 * precision * recall / total if total else 0.0
    return MeshComparison(
        convention=convention.name,
        unit=convention.unit,
        p2s=directed[0 if convention.p2s_direction == "pred_to_gt" else 1],
        chamfer=chamfer,
        pred_to_gt=there,
        gt_to_pred=back_again,
        hausdorff=hausdorff,
        precision=precision,
        recall=recall,
        fscore=fscore,
        threshold_mm=threshold_mm,
        labels=labels,
    )


def _stats(directed: DirectedDistances, mask: np.ndarray) -> DirectionStats | None:
    # All distances in millimetres, the angle between normals in degrees.
    mm = directed.distance[mask] * MM
    if not len(mm):
        return None
    median, p95 = np.percentile(mm, (50, 95))
    return DirectionStats(
        count=len(mm),
        mean=float(mm.mean()),
        median=float(median),
        rms=float(np.sqrt(np.mean(mm**2))),
        p95=float(p95),
        max=float(mm.max()),
        normal_angle_deg=float(directed.angle[mask].mean()),
    )


def _angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # Kahan's form: accurate at 0 and 180 degrees, where arccos of the dot product is not.
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)))
