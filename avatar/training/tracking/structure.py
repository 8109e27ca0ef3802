"""What pictures can tell of where control points are: along stripes little, across them much."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.views import View
from avatar.gaussians.binding import on_triangles
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.gather import gather_rows
from avatar.models.tracked_surface import TrackedAvatar
from avatar.rig.rig import Pose
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.evidence import Photometer

PLAIN_SUMS = RefineConfig(robust=1e3, pixel_sigma=1.0, pixels_per_error=1.0)
"""Every full-size pixel counts once, however wrong it is."""
FEW = 16.0
"""Full-size pixels, of all views together, that a point needs to be told by."""


def picture_structure(
    avatar: TrackedAvatar,
    controls: Float[Tensor, "K 3"],
    pose: Pose,
    views: Sequence[View],
    background: Float[Tensor, " 3"],
    *,
    halvings: int,
) -> Float[Tensor, "K 3 3"]:
    """Return how much pictures change with displacements: the mean of `J^T J` over the pixels that show a point.

    J is the derivative of the rendered colours and opacity, 1/m, along the axes of the T-pose: the structure tensors of
    the rendering at every Gaussian (`Photometer`), turned back to the T-pose and shared out to control points as their
    displacements are interpolated. It is a mean, not a sum: what folds are lit by errs alike in all pixels and cameras.
    0 where nothing is seen.

    Args:
        controls: displacements in the frame, about those that are sought.
        views: at `halvings` of the photographs' size.
    """
    rig = avatar.rig
    with torch.no_grad():
        vertices = rig.skin(pose, avatar.cage(avatar.moves * controls))
        bound = avatar.gaussians.snapshot().to(device=rig.device)
    with torch.enable_grad():
        seen = Photometer(rig.faces, background, PLAIN_SUMS).evidence(bound, vertices, views, halvings=halvings)
        table = torch.zeros(avatar.cage.count, 10, device=controls.device, requires_grad=True)
        spread = on_triangles(gather_rows(avatar.cage(table), rig.faces[bound.face_index]), bound.barycentric)
    here, rest = (triangle_frames(x, rig.faces).rotations[bound.face_index] for x in (vertices, rig.vertices))
    turned = here @ rest.transpose(1, 2)
    tensors = turned.transpose(1, 2) @ seen.curvature @ turned
    (sums,) = torch.autograd.grad(spread, table, torch.cat([tensors.flatten(1), seen.color_mass[:, None]], dim=1))
    return (sums[:, :9] / (sums[:, 9:] + FEW)).view(-1, 3, 3)
