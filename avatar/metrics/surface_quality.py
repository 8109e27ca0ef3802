"""How far the posed mesh of an avatar is from the true surface of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.metrics import CompareConfig, MeshComparison, compare

CONVENTION = (
    "P2S: mean distance of points of the posed mesh to the nearest point of the true surface. Truth to mesh: the other "
    "direction. Chamfer: the mean of both. Points are area-weighted samples that a view from outside can see; "
    "distances in mm, not squared, to the whole other surface; nothing is aligned. "
    "Of a label: the mesh's own points of that label, and points of the truth whose nearest point of the mesh has it."
)
SAMPLES = 100_000
"""Points a mesh, before the choice of visible ones."""


@dataclass(frozen=True)
class SurfaceQuality:
    """Distances between a posed mesh and a true surface, mm; None where a side has no point.

    Attributes:
        p2s: posed mesh to truth. truth_to_mesh: the other direction. chamfer: mean of both.
        p95: 95th percentile of the distances that `p2s` is the mean of.
        labels: the same for each label of the template.
    """

    p2s: float | None
    truth_to_mesh: float | None
    chamfer: float | None
    p95: float | None
    labels: dict[str, SurfaceQuality] = field(default_factory=dict)


def surface_quality(
    mesh: TriangleMesh,
    vertex_labels: np.ndarray,
    truth: TriangleMesh,
    *,
    samples: int = SAMPLES,
    seed: int = 0,
) -> SurfaceQuality:
    """Compare a posed mesh with the truth over the surfaces that can be seen; see `CONVENTION`.

    Args:
        mesh: posed. vertex_labels: (V,) ids of `smplxpp.core.labels` on it.
        truth: the surface that the images show.

    Raises:
        InputError: a mesh without area, or none of it to be seen.
    """
    found = compare(
        mesh,
        truth,
        samples=samples,
        seed=seed,
        pred_labels=vertex_labels,
        config=CompareConfig(visible_only=True),
    )
    return _quality(found)


def mean_surface(frames: Sequence[SurfaceQuality]) -> SurfaceQuality:
    """Plain means of each figure over the frames that have it.

    Raises:
        InputError: no frame.
    """
    if not frames:
        raise InputError("surfaces to average", expected="at least one frame", received="none")
    figures = {}
    for name in ("p2s", "truth_to_mesh", "chamfer", "p95"):
        known = [getattr(one, name) for one in frames if getattr(one, name) is not None]
        figures[name] = float(np.mean(known)) if known else None
    labels = dict.fromkeys(name for one in frames for name in one.labels)
    parts = {name: mean_surface([one.labels[name] for one in frames if name in one.labels]) for name in labels}
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
