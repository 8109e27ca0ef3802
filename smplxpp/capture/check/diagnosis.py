"""Which of the usual mistakes would explain a calibration that does not fit the silhouettes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smplxpp.capture.check.mistakes import COMBINED, SINGLE, Mistake, Sample, shifts
from smplxpp.capture.check.silhouettes import (
    IOU_BAD,
    OUTSIDE_DOUBTFUL,
    SilhouetteFit,
    body_silhouette,
    compare_silhouettes,
)

# A correction explains the misfit if the body is then this far inside the masks, and the overlap this much larger.
_FITS_OUTSIDE, _GAIN = 2 * OUTSIDE_DOUBTFUL, 0.05
_FEW, _HOPELESS = 4, 6 * OUTSIDE_DOUBTFUL


@dataclass(frozen=True)
class Diagnosis:
    """The simplest correction that fits, and how well."""

    mistake: Mistake
    before: SilhouetteFit
    after: SilhouetteFit


def diagnose(samples: Sequence[Sample], extra: Sequence[Mistake] = ()) -> Diagnosis | None:
    """Find the correction that brings the body into the masks; None where none does.

    Args:
        samples: views that do not fit.
        extra: corrections to try besides the usual ones (another camera's calibration, say).
    """
    before = _score(samples, Mistake("", ""))
    # Single mistakes before combined ones: the simplest explanation wins.
    for level in ((*SINGLE, *extra, *shifts(samples)), COMBINED):
        # Most corrections are hopeless, which a few views show.
        likely = [mistake for mistake in level if _score(samples[::_FEW], mistake).outside < _HOPELESS]
        scored = [(_score(samples, mistake), mistake) for mistake in likely]
        fitting = [item for item in scored if _explains(before, item[0])]
        if fitting:
            # Overlap alone would prefer a large body; the share outside the mask tells whether it fits inside.
            after, mistake = max(fitting, key=lambda item: item[0].iou - item[0].outside)
            return Diagnosis(mistake, before, after)
    return None


def _explains(before: SilhouetteFit, after: SilhouetteFit) -> bool:
    inside = after.outside < min(_FITS_OUTSIDE, 0.5 * before.outside)
    return inside and after.iou > max(IOU_BAD, before.iou + _GAIN)


def _score(samples: Sequence[Sample], mistake: Mistake) -> SilhouetteFit:
    """Return mean figures over the samples that the correction applies to, which have to be half of them."""
    fits = []
    for sample in samples:
        vertices = mistake.body(sample)
        if vertices is not None:
            # A mistake corrects the camera, the body, or both; a body that is not seen counts as all outside.
            silhouette = body_silhouette(vertices, sample.faces, mistake.camera(sample.camera))
            fits.append(compare_silhouettes(silhouette, sample.mask) or SilhouetteFit(1.0, 0.0))
    # A correction that applies to fewer than half of the samples (a shift in time at the ends) proves nothing.
    if 2 * len(fits) < max(1, len(samples)):
        return SilhouetteFit(1.0, 0.0)
    return SilhouetteFit(float(np.mean([f.outside for f in fits])), float(np.mean([f.iou for f in fits])))
