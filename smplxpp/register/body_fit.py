"""BodyFit: what a registration gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from smplxpp.core.params import BodyParams


@dataclass(frozen=True, eq=False)
class BodyFit:
    """A body fitted to F frames.

    Attributes:
        frames: their numbers, ascending.
        params: a row a frame; one shape.
        confidence: from 0 (the priors alone) to 1, of each joint in each frame.
        residuals: by name, a number a frame, NaN where nothing of the kind was seen: `keypoints_px`, `silhouette_px`,
            `skin_mm` (bare skin to the scan), `inside_mm` (cloth of the scan inside the body), `surface_mm`.
        start: the residuals of where it began, where it began with a fit.
        problems: what was wrong with the inputs and what was done about it, in words.
    """

    frames: tuple[int, ...]
    params: BodyParams
    confidence: Float64[np.ndarray, "F J"]
    residuals: Mapping[str, Float64[np.ndarray, " F"]]
    start: Mapping[str, Float64[np.ndarray, " F"]] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
