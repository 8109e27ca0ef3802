"""Where labels are doubtful: patches of low confidence, the largest doubts first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from smplxpp.core.mesh import normalize_rows
from smplxpp.core.topology import component_labels
from smplxpp.segment.corrected_faces import ScanSurface

DOUBTFUL = 0.6
"""Confidence below which a face is doubtful."""
_LEAST_AREA = 2e-4  # square metres
_MOST = 40


@dataclass(frozen=True, eq=False)
class DoubtfulRegion:
    """A patch of doubtful faces.

    Attributes:
        label: that most of its area has. area: square metres. confidence: its mean.
        center: of its area, metres. normal: its mean, outward, unit length.
    """

    label: int
    area: float
    confidence: float
    center: Float64[np.ndarray, " 3"]
    normal: Float64[np.ndarray, " 3"]


def doubtful_regions(
    surface: ScanSurface,
    labels: Int[np.ndarray, " M"],
    confidence: Float[np.ndarray, " M"],
    corrected: Bool[np.ndarray, " M"],
) -> list[DoubtfulRegion]:
    """Connected patches of faces with a confidence below 0.6 that no hand has set, of 2 square centimetres and more,
    at most 40, by area times doubt."""
    doubtful = (confidence < DOUBTFUL) & ~corrected
    mesh, pairs = surface.mesh, surface.pairs
    patch = component_labels(pairs[doubtful[pairs].all(axis=1)], mesh.face_count)
    area = mesh.face_areas * doubtful
    of_patch = np.bincount(patch, area)
    doubt = np.bincount(patch, area * (1.0 - confidence))
    out = []
    for k in np.argsort(-doubt, kind="stable")[:_MOST]:
        if of_patch[k] < _LEAST_AREA:
            continue
        own = np.flatnonzero((patch == k) & doubtful)
        weight = mesh.face_areas[own]
        center = weight @ mesh.face_centers[own] / weight.sum()
        out.append(
            DoubtfulRegion(
                label=int(np.bincount(labels[own], weight).argmax()),
                area=float(weight.sum()),
                confidence=float(weight @ confidence[own] / weight.sum()),
                center=center,
                normal=normalize_rows((weight @ mesh.face_normals[own])[None])[0],
            )
        )
    return out
