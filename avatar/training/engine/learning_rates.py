"""Adam's steps of the Gaussians' attributes."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from smplxpp.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Adam's step of every attribute at the start; all fall exponentially to `lr_final_factor` times that.

    Attributes:
        normal_offset: pixels along the normal, which has the silhouettes to meet. A pixel is the median over the
            training views of what one covers at the person, so that the rate fits any distance and image size.
        offset: pixels in every direction; slow, so that texture stays where several views agree on it.
        log_scales, quats, opacity_logits: of the parameters as they are stored.
        dc: of colours in [0, 1]. sh: of the coefficients that depend on the view.
        lr_final_factor: share left at the last step.
    """

    normal_offset: float = 0.1
    offset: float = 0.015
    log_scales: float = 5e-3
    quats: float = 2e-3
    opacity_logits: float = 3e-2
    dc: float = 2e-3
    sh: float = 5e-4
    lr_final_factor: float = 0.1

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"learning rate {f.name}", expected="a positive number", received=repr(value))
