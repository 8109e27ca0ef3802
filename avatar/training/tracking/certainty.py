"""How far from the truth control points may be: what photographs tell of a frame, and what the frame before leaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import exp

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.training.tracking.foresight import FADING

CONTRAST = 6.0
"""Change of colours, of 0 to 1, a metre: folds that are lit make as much on plain cloth, patterns more."""
LIT = 0.035
"""Colours, of 0 to 1, that light is off by where folds have moved."""
ASTRAY = 1.0 / 3.0
"""Of how far a point leaves skinning: what a simulation is off after a while, whatever was known at its start."""
KNOWN = 1e-3
"""Metres that the surface is known to where the template was built."""


def held_directions(structure: Float[Tensor, "K 3 3"], normals: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3 3"]:
    """Return how much of a forecast stands in every direction, `P (I + (G / CONTRAST^2)^2)^-2 P` of the structure G.

    1 where nothing else tells, 0 where patterns do, and 0 across the surface, `P = I - n n^T`: there outlines tell,
    those of other cameras and of the next moment, and a simulated fold is as wrong as a carried one.

    Args:
        normals: n, unit, of the surface in the T-pose; 0 where there is none.
    """
    scaled = structure / CONTRAST**2
    share = torch.linalg.inv(_unit(structure) + scaled @ scaled)
    in_plane = _unit(structure) - normals[:, :, None] * normals[:, None, :]
    return in_plane @ share @ share @ in_plane


def expected_distances(
    order: Sequence[int],
    seconds: float,
    structure: Mapping[int, Float[Tensor, "K 3 3"]],
    moved: Float[Tensor, " K"],
    *,
    known: bool,
) -> dict[int, Float[Tensor, " K"]]:
    """Return how far from the truth control points are to be expected in every frame, metres.

    A Kalman filter whose forecast is the simulated cloth's: from a frame `dt` away, of covariance C, it has `k^2 C +
    (1 - k^2) a^2 I` with `k = exp(-dt / FADING)`, so that what was known fades as the foresight lets it fade, and `a =
    ASTRAY moved + KNOWN`: a hem goes farther astray than a waistband. Pictures add `G / LIT^2` to its inverse. The
    distance is the root of the trace.

    Args:
        order: in which the frames were followed, each from its nearest. seconds: of one of their numbers.
        structure: G of each frame, see `picture_structure`.
        moved: how far points leave skinning, metres, the root of the mean square over the frames.
        known: whether the template is the surface in the first of them.
    """
    covariance: dict[int, Tensor] = {}
    astray = (ASTRAY * moved + KNOWN)[:, None, None] ** 2
    for frame in order:
        told = structure[frame] / LIT**2
        unit = _unit(told)
        if covariance:
            near = min(covariance, key=lambda other: abs(other - frame))
            kept = exp(-2.0 * abs(frame - near) * seconds / FADING)
            forecast = kept * covariance[near] + (1.0 - kept) * astray * unit
        else:
            forecast = (torch.full_like(astray, KNOWN**2) if known else astray) * unit
        covariance[frame] = torch.linalg.inv(torch.linalg.inv(forecast) + told)
    return {frame: one.diagonal(dim1=1, dim2=2).sum(-1).clamp(min=0.0).sqrt() for frame, one in covariance.items()}


def _unit(matrices: Float[Tensor, "K 3 3"]) -> Float[Tensor, "3 3"]:
    return torch.eye(3, dtype=matrices.dtype, device=matrices.device)
