"""Measure the distance between an avatar's posed mesh and the true surface of a frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int

from smplxpp.core import LABELS, InputError, Labels, TriangleMesh
from smplxpp.metrics import CompareConfig, DirectedDistances, MeshComparison, directed_distances, summarize
from smplxpp.metrics.conventions import DEFAULT, convention_named
from smplxpp.metrics.distance import visible_samples
from smplxpp.metrics.sampling import SurfaceSamples, sample_surface

CONVENTION = (
    "P2S: mean distance of points of the posed mesh to the nearest point of the true surface. Truth to mesh: the other "
    "direction. Chamfer: the mean of both. Points are area-weighted samples that a view from outside can see; "
    "distances in mm, not squared, to the whole other surface; nothing is aligned. "
    "Of a label: the mesh's own points of that label, and points of the truth whose nearest point of the mesh has it. "
    'Head: likewise the faces that follow the joint "head" by more than half their weight, hair included.'
)
HEAD = "head"
"""Name of the head among the labels: a region of the mesh, whose faces have labels of their own."""
SAMPLES = 100_000
"""Points a mesh, before the choice of visible ones."""
_VISIBLE = CompareConfig(visible_only=True)


@dataclass(frozen=True)
class SurfaceQuality:
    """Distances between a posed mesh and a true surface, mm; None where a side has no point.

    Attributes:
        p2s: mean distance from the posed mesh to the truth.
        truth_to_mesh: mean distance in the other direction.
        chamfer: mean of both.
        p95: 95th percentile of the distances from the posed mesh to the truth.
        labels: the same for each label of the template, and for the region `HEAD` where the mesh has a head.
    """

    p2s: float | None
    truth_to_mesh: float | None
    chamfer: float | None
    p95: float | None
    labels: dict[str, SurfaceQuality] = field(default_factory=dict)


def surface_quality(
    mesh: TriangleMesh,
    vertex_labels: Int[np.ndarray, " V"],
    truth: TriangleMesh,
    *,
    head: Bool[np.ndarray, " F"] | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
    labels: Labels = LABELS,
    of_truth: SurfaceSamples | None = None,
) -> SurfaceQuality:
    """Compare a posed mesh with the truth over the surfaces that can be seen; see `CONVENTION`.

    Args:
        mesh: posed, metres.
        vertex_labels: ids of `labels` on the mesh.
        truth: the surface that the images show, metres.
        head: mask of the head's faces on the mesh; None: no head.
        samples: points on each surface, before the choice of visible ones.
        seed: of the samples.
        labels: the template's.
        of_truth: `points_of_truth`, where several meshes are compared with one truth.

    Raises:
        InputError: a mesh without area, or none of it to be seen.
    """
    # Points of one surface to the whole other one, both ways; labels of the truth are those of the nearest mesh point.
    forth = directed_distances(mesh, truth, samples=samples, seed=seed, source_labels=vertex_labels, config=_VISIBLE)
    of_truth = points_of_truth(truth, samples=samples, seed=seed) if of_truth is None else of_truth
    back = directed_distances(of_truth, mesh, target_labels=vertex_labels, config=_VISIBLE)
    quality = _quality(_summary(forth, back, labels))
    if head is None or not head.any():
        return quality
    # The head is a region across labels: relabel faces as head or rest, and summarise the same distances again.
    region, rest = len(labels), len(labels) + 1
    parts = (
        replace(forth, label=np.where(head[forth.samples.face], region, rest)),
        replace(back, label=np.where(head[back.face], region, rest)),
    )
    found = _quality(_summary(*parts, labels)).labels.get(str(region))
    return quality if found is None else replace(quality, labels={**quality.labels, HEAD: found})


def points_of_truth(truth: TriangleMesh, *, samples: int = SAMPLES, seed: int = 0) -> SurfaceSamples:
    """Sample the true surface where a view from outside can see it.

    Raises:
        InputError: a mesh without area, or none of it to be seen.
    """
    return visible_samples(truth, sample_surface(truth, samples, seed=seed), _VISIBLE)


def _summary(forth: DirectedDistances, back: DirectedDistances, labels: Labels) -> MeshComparison:
    config = CompareConfig()
    return summarize(forth, back, convention=convention_named(DEFAULT), threshold_mm=config.threshold_mm, names=labels)


def mean_surface(frames: Sequence[SurfaceQuality]) -> SurfaceQuality:
    """Return plain means of each figure over the frames that have it.

    Raises:
        InputError: no frame.
    """
    if not frames:
        raise InputError("surfaces to average", expected="at least one frame", received="none")
    return _over_frames(frames, lambda known: float(np.mean(known)) if known else None)


def surface_spread(frames: Sequence[SurfaceQuality]) -> SurfaceQuality:
    """Return standard deviations over the frames that have each figure, by n - 1; None for fewer than two frames."""
    return _over_frames(frames, lambda known: float(np.std(known, ddof=1)) if len(known) > 1 else None)


def _over_frames(
    frames: Sequence[SurfaceQuality], statistic: Callable[[Sequence[float]], float | None]
) -> SurfaceQuality:
    """Return a statistic of every figure over the frames that have it, for the whole surface and each label."""
    # A figure that a frame lacks (no visible point of a label) does not enter the statistic.
    figures = {
        name: statistic([value for one in frames if (value := getattr(one, name)) is not None])
        for name in ("p2s", "truth_to_mesh", "chamfer", "p95")
    }
    labels = dict.fromkeys(name for one in frames for name in one.labels)
    parts = {
        name: _over_frames([one.labels[name] for one in frames if name in one.labels], statistic) for name in labels
    }
    return SurfaceQuality(**figures, labels=parts)


def _quality(found: MeshComparison) -> SurfaceQuality:
    forth, back = found.pred_to_gt, found.gt_to_pred
    return SurfaceQuality(
        p2s=found.p2s,
        truth_to_mesh=None if back is None else back.mean,
        chamfer=found.chamfer,
        p95=None if forth is None else forth.p95,
        labels={name: _quality(part) for name, part in found.labels.items()},
    )
