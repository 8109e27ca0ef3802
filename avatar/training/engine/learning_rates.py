"""Learning rates of the Gaussians' attributes, and the size of a pixel at the person as their unit."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from avatar.data.sequence import FrameSequence
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from avatar.training.engine.adam import ParameterGroup
from smplxpp.core.errors import require_positive


@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Learning rate of every attribute at the start; all fall exponentially to `lr_final_factor` times that.

    Attributes:
        normal_offset: pixels along the normal, which silhouettes determine. A pixel is the median over the training
            views of its size at the person, so that the rate fits any distance and image size.
        offset: pixels in every direction; slow, so that texture stays where several views agree on it.
        log_scales: of the logarithms of scales in the triangle's frame.
        quats: of the quaternions' components.
        opacity_logits: of the logits of opacities.
        dc: of colours in [0, 1].
        sh: of the harmonics' coefficients that depend on the view.
        lr_final_factor: share of all rates left at the last step.
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
            require_positive(f"learning rate {f.name}", getattr(self, f.name))


def attribute_groups(
    gaussians: LearnedGaussians, multiple: float, pixel: float, rates: LearningRates
) -> list[ParameterGroup]:
    """Return parameter groups of the Gaussians' attributes at `multiple` times `rates`; none for 0, which freezes them.

    Args:
        gaussians: whose attributes learn.
        multiple: factor on all rates.
        pixel: size of a pixel at the person, metres, the unit of the offsets' rates.
        rates: of the attributes.
    """
    if not multiple:
        gaussians.requires_grad_(False)
        return []
    # Rates of offsets are in pixels, all others in the attribute's own unit.
    unit = {"normal_offset": pixel, "offset": pixel}
    gaussians.requires_grad_(True)
    return [
        ParameterGroup(
            f"gaussians.{name}",
            {name: getattr(gaussians, name)},
            multiple * getattr(rates, name) * unit.get(name, 1.0),
            rates.lr_final_factor,
        )
        for name in LEARNED
        if getattr(gaussians, name).numel()
    ]


def pixel_size(sequence: FrameSequence) -> float:
    """Return the size of a pixel at the person, metres: the median of `distance / f` over the training cameras."""
    # A pixel at distance d has the size d / f, f the focal length in pixels.
    center = sequence.person_center()
    cameras = [sequence.camera(name) for name in sequence.train_cameras]
    return float(np.median([np.linalg.norm(c.position - center) / c.K[0, 0] for c in cameras]))
