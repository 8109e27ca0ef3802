"""What a comparison of two surfaces is asked for and gives: options, distances of each direction, statistics."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core import LABELS, Labels
from smplxpp.core.errors import one_line
from smplxpp.metrics.conventions import Convention
from smplxpp.metrics.sampling import SurfaceSamples

MM = 1e3


@dataclass(frozen=True)
class CompareConfig:
    """Less common options of `compare`.

    Attributes:
        threshold_mm: of precision, recall and F-score; of several, the first is that of `MeshComparison.fscore`, and
            `MeshComparison.scores` has all.
        visible_only: measure from the points of each mesh that some camera outside could see. The skin under clothes
            has no counterpart on a scan; with it, template to scan measures the clothes' depth. Targets stay whole.
        visible_tolerance: metres that another face may hide a point by and still count as seen.
        certified: bound the Hausdorff distance from above, too (`hausdorff`).
        unit: of both meshes: "m", "cm", "mm" or "inch". Results stay in the units that they name.
    """

    threshold_mm: float | tuple[float, ...] = 5.0
    visible_only: bool = False
    visible_tolerance: float = 1e-3
    certified: bool = False
    unit: str = "m"

    @property
    def thresholds_mm(self) -> tuple[float, ...]:
        """All thresholds; at least one."""
        return self.threshold_mm if isinstance(self.threshold_mm, tuple) else (self.threshold_mm,)


@dataclass(frozen=True, eq=False)
class DirectedDistances:
    """What was measured from P samples of one mesh or point cloud to the other.

    Attributes:
        samples: the points, their faces and normals.
        distance: (P,) float64 metres, unsigned.
        closest: (P, 3) float64 the target's point.
        face: (P,) int64 the target's face there; -1 of a point cloud.
        angle: (P,) float64 degrees in [0, 180] between the normals; a target with reversed winding gives 180; NaN
            where either has no normal.
        label: (P,) int64, or None without labels.
    """

    samples: SurfaceSamples
    distance: Float64[np.ndarray, " P"]
    closest: Float64[np.ndarray, "P 3"]
    face: Int64[np.ndarray, " P"]
    angle: Float64[np.ndarray, " P"]
    label: Int64[np.ndarray, " P"] | None = None

    __repr__ = one_line


@dataclass(frozen=True)
class DirectionStats:
    """Statistics of unsquared distances in mm from `count` points, and of the normals there, None without normals.

    Attributes:
        count, mean, median, rms, p95, max: of the points and their distances.
        normal_angle_deg: mean angle of the normals, degrees; meaningless where winding is mixed.
        normal_consistency: mean |cos| of that angle, in [0, 1], whatever the winding (Occupancy Networks, PyTorch3D).
    """

    count: int
    mean: float
    median: float
    rms: float
    p95: float
    max: float
    normal_angle_deg: float | None
    normal_consistency: float | None


@dataclass(frozen=True)
class ThresholdScores:
    """Precision, recall and their harmonic mean within a threshold; None where a side has no point."""

    threshold_mm: float
    precision: float | None
    recall: float | None
    fscore: float | None


@dataclass(frozen=True)
class MeshComparison:
    """Distances between two surfaces, in both directions.

    Attributes:
        convention, unit: what `p2s` and `chamfer` mean and their unit; everything else is in mm whatever the preset.
        p2s, chamfer: as the convention defines them; None where it does not, or where a label has no point on a side.
        pred_to_gt, gt_to_pred: statistics of both directions (gt_to_pred is also called completeness).
        hausdorff: the largest distance of the samples and, but for labels, of all vertices, mm: a lower bound.
        hausdorff_upper: certified upper bound of the distance of the whole surfaces, mm; None unless asked for.
        precision, recall, fscore: shares within `threshold_mm` from pred to gt, from gt to pred, their harmonic mean.
        scores: the same for every threshold.
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
    hausdorff_upper: float | None = None
    scores: tuple[ThresholdScores, ...] = ()

    __repr__ = one_line

    def as_dict(self) -> dict:
        """Return the figures as plain nested dictionaries and lists for JSON."""
        plain = asdict(self)
        labels = {name: label.as_dict() for name, label in self.labels.items()}
        return {**plain, "scores": list(plain["scores"]), "labels": labels}


def summarize(
    pred_to_gt: DirectedDistances,
    gt_to_pred: DirectedDistances,
    *,
    convention: Convention,
    threshold_mm: float | tuple[float, ...],
    names: Labels = LABELS,
) -> MeshComparison:
    """The comparison that two sets of distances give, with one a label where they carry labels, by the label's name."""
    thresholds = CompareConfig(threshold_mm=threshold_mm).thresholds_mm
    every = [np.ones(len(d.distance), dtype=bool) for d in (pred_to_gt, gt_to_pred)]
    labels = {}
    if pred_to_gt.label is not None and gt_to_pred.label is not None:
        called = {label.id: label.name for label in names}
        for k in np.union1d(pred_to_gt.label, gt_to_pred.label).tolist():
            masks = [pred_to_gt.label == k, gt_to_pred.label == k]
            labels[called.get(k, str(k))] = _summary(pred_to_gt, gt_to_pred, masks, convention, thresholds, {})
    return _summary(pred_to_gt, gt_to_pred, every, convention, thresholds, labels)


def _summary(
    forth: DirectedDistances,
    back: DirectedDistances,
    masks: list[np.ndarray],
    convention: Convention,
    thresholds: tuple[float, ...],
    labels: dict[str, MeshComparison],
) -> MeshComparison:
    there, back_again = _stats(forth, masks[0]), _stats(back, masks[1])
    # Precision is the share of predicted points within the threshold, recall that of the true points, F-score their
    # harmonic mean. The Chamfer distance follows the convention; Hausdorff is the larger of the two maxima.
    distances = [d.distance[mask] for d, mask in zip((forth, back), masks, strict=True)]
    directed = [convention.directed(d) if len(d) else None for d in distances]
    scores = tuple(_scores(distances[0], distances[1], threshold) for threshold in thresholds)
    chamfer = hausdorff = None
    if directed[0] is not None and directed[1] is not None:
        chamfer = convention.chamfer(directed[0], directed[1])
    if there is not None and back_again is not None:
        hausdorff = max(there.max, back_again.max)
    return MeshComparison(
        convention=convention.name,
        unit=convention.unit,
        p2s=directed[0 if convention.p2s_direction == "pred_to_gt" else 1],
        chamfer=chamfer,
        pred_to_gt=there,
        gt_to_pred=back_again,
        hausdorff=hausdorff,
        precision=scores[0].precision,
        recall=scores[0].recall,
        fscore=scores[0].fscore,
        threshold_mm=thresholds[0],
        labels=labels,
        scores=scores,
    )


def _scores(forth: np.ndarray, back: np.ndarray, threshold_mm: float) -> ThresholdScores:
    precision, recall = (float(np.mean(d * MM <= threshold_mm)) if len(d) else None for d in (forth, back))
    fscore = None
    if precision is not None and recall is not None:
        # Nothing within the threshold on either side is a score of 0, not an undefined one.
        total = precision + recall
        fscore = 2.0 * precision * recall / total if total else 0.0
    return ThresholdScores(threshold_mm, precision, recall, fscore)


def _stats(directed: DirectedDistances, mask: np.ndarray) -> DirectionStats | None:
    # All distances in millimetres, the angle between normals in degrees.
    mm = directed.distance[mask] * MM
    if not len(mm):
        return None
    median, p95 = np.percentile(mm, (50, 95))
    angle = directed.angle[mask]
    known = angle[~np.isnan(angle)]
    return DirectionStats(
        count=len(mm),
        mean=float(mm.mean()),
        median=float(median),
        rms=float(np.sqrt(np.mean(mm**2))),
        p95=float(p95),
        max=float(mm.max()),
        normal_angle_deg=float(known.mean()) if len(known) else None,
        normal_consistency=float(np.abs(np.cos(np.radians(known))).mean()) if len(known) else None,
    )
