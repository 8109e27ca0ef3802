"""Uncertainty of tracked control points: structure tensors of photographs, and a Kalman filter of the errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import exp

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.views import View
from avatar.gaussians.binding import on_triangles
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.tensor_operations import gather_rows
from avatar.models.tracked_surface import TrackedAvatar
from avatar.rig.rig import Pose
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.photometric import PhotometricLoss
from avatar.training.tracking.cloth_prediction import CORRECTION_DECAY

# Structure tensors. The kernel is flat and the weight 1, so that every full-size pixel counts once.
_PLAIN_SUMS = RefineConfig(robust=1e3, pixel_sigma=1.0, pixels_per_error=1.0)

OBSERVED_GRADIENT = 6.0
"""Change of colours in [0, 1] per metre at which the prior is weakened to a quarter.

Shaded folds of plain cloth change colours by about this much; patterns change them more.
"""

# Noise of the Kalman filter.
SHADING_SIGMA = 0.035
"""Standard deviation of colours in [0, 1]: the error of the shading where folds have moved."""
SIMULATION_SHARE = 1.0 / 3.0
"""Steady-state error of a simulation, as a fraction of a point's RMS displacement from skinning."""
REFERENCE_SIGMA = 1e-3
"""Metres to which the surface is known in the reference frame, on which the template was built."""


def structure_tensors(
    avatar: TrackedAvatar,
    controls: Float[Tensor, "K 3"],
    pose: Pose,
    views: Sequence[View],
    background: Float[Tensor, " 3"],
    *,
    halvings: int,
) -> Float[Tensor, "K 3 3"]:
    """Return `G = mean J^T J` over the pixels of each control point, 1/m^2; 0 where no view shows the point.

    J is the derivative of the rendered colours and opacity by the displacement, along the axes of the T-pose. G is a
    mean, not a sum, because the error of the shading is the same in all pixels and cameras.

    Args:
        avatar: the Gaussians on their control points.
        controls: displacements in the frame, metres, about which J is taken.
        pose: of the frame.
        views: photographs of the frame, at `halvings`.
        background: sRGB.
        halvings: of the photographs' full size.
    """
    pixels_needed = 16.0  # full-size pixels of all views together at which a point's tensor has half its weight
    rig = avatar.rig
    with torch.no_grad():
        vertices = rig.skin(pose, avatar.cage(avatar.moves * controls))
        bound = avatar.gaussians.snapshot().to(device=rig.device)
    with torch.enable_grad():
        # Structure tensor of the rendering at every Gaussian, in the world.
        loss = PhotometricLoss(rig.faces, background, _PLAIN_SUMS)
        seen = loss.linearize(bound, vertices, views, halvings=halvings)
        # The interpolation from control points to Gaussians; its transpose distributes tensors to control points.
        table = torch.zeros(avatar.cage.count, 10, device=controls.device, requires_grad=True)
        spread = on_triangles(gather_rows(avatar.cage(table), rig.faces[bound.face_index]), bound.barycentric)
    # Rotate each tensor from the posed triangle to the triangle of the T-pose: G = R^T G_world R.
    here, rest = (triangle_frames(x, rig.faces).rotations[bound.face_index] for x in (vertices, rig.vertices))
    turned = here @ rest.transpose(1, 2)
    tensors = turned.transpose(1, 2) @ seen.curvature @ turned
    # Sum tensors (9 numbers) and pixel masses (1 number) with the interpolation's weights, then take the mean.
    (sums,) = torch.autograd.grad(spread, table, torch.cat([tensors.flatten(1), seen.color_mass[:, None]], dim=1))
    return (sums[:, :9] / (sums[:, 9:] + pixels_needed)).view(-1, 3, 3)


def unobserved_weight(structure: Float[Tensor, "K 3 3"], normals: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3 3"]:
    """Return the weight of a prior in every direction, `W = P (I + (G / OBSERVED_GRADIENT^2)^2)^-2 P`.

    W is 1 along the surface where photographs determine nothing, 0 where a pattern does, and 0 across the surface
    (`P = I - n n^T`). Across it, silhouettes of other cameras and of later frames determine the position, and a
    simulated fold is as wrong there as an extrapolated one.

    Args:
        structure: G of the control points.
        normals: n, unit normals of the surface in the T-pose; 0 where there is none.
    """
    # (I + S^2)^-1, which falls from 1 to a half where S = G / OBSERVED_GRADIENT^2 is 1, and applied twice to a
    # quarter.
    scaled = structure / OBSERVED_GRADIENT**2
    share = torch.linalg.inv(_unit(structure) + scaled @ scaled)
    in_plane = _unit(structure) - normals[:, :, None] * normals[:, None, :]
    return in_plane @ share @ share @ in_plane


def expected_errors(
    order: Sequence[int],
    seconds: float,
    structure: Mapping[int, Float[Tensor, "K 3 3"]],
    moved: Float[Tensor, " K"],
    *,
    known: bool,
) -> dict[int, Float[Tensor, " K"]]:
    """Return the expected distance of control points from the truth in every frame, metres, by a Kalman filter.

    The state is a point's displacement with covariance C (3 x 3). From the nearest solved frame, dt away:

        predict:  C- = k^2 C + (1 - k^2) a^2 I,   k = exp(-dt / CORRECTION_DECAY),
                  a = SIMULATION_SHARE moved + REFERENCE_SIGMA
        update:   C = (C-^-1 + G / SHADING_SIGMA^2)^-1

    The prediction decays as the corrections of `ClothPrediction` do, towards the steady-state error a of a simulation.
    The expected distance is the square root of the trace of C.

    Args:
        order: in which the frames were solved, each from its nearest solved one.
        seconds: between frames whose numbers differ by one.
        structure: G of each frame, see `structure_tensors`.
        moved: RMS displacement of the points from skinning over the frames, metres.
        known: whether the template is the surface in the first of them.
    """
    # a^2, the variance at the steady state, (K, 1, 1).
    covariance: dict[int, Tensor] = {}
    steady = (SIMULATION_SHARE * moved + REFERENCE_SIGMA)[:, None, None] ** 2
    for frame in order:
        information = structure[frame] / SHADING_SIGMA**2
        unit = _unit(information)
        if covariance:
            # Predict from the nearest solved frame; uncertainty grows towards the steady state.
            near = min(covariance, key=lambda other: abs(other - frame))
            kept = exp(-2.0 * abs(frame - near) * seconds / CORRECTION_DECAY)
            predicted = kept * covariance[near] + (1.0 - kept) * steady * unit
        else:
            predicted = (torch.full_like(steady, REFERENCE_SIGMA**2) if known else steady) * unit
        # Update in information form: inverse covariances of prediction and photographs add up.
        covariance[frame] = torch.linalg.inv(torch.linalg.inv(predicted) + information)
    return {frame: one.diagonal(dim1=1, dim2=2).sum(-1).clamp(min=0.0).sqrt() for frame, one in covariance.items()}


def _unit(matrices: Float[Tensor, "K 3 3"]) -> Float[Tensor, "3 3"]:
    return torch.eye(3, dtype=matrices.dtype, device=matrices.device)
