"""Assignment of canonical points to the front or the back map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from avatar.models.networks.map_sampling import MapSampler
from avatar.rendering.map_frame import MapFrame
from avatar.rendering.mesh_maps import front_back_maps
from avatar.rig.rig import Rig


@dataclass(frozen=True, eq=False)
class FrontBackAssignment:
    """Sides of P points.

    Attributes:
        front: whether the front map's surface is the nearer one along z.
        behind: depth of the point below the surface on its side's map, metres; 0 where the map shows none.
    """

    front: Bool[Tensor, " P"]
    behind: Float[Tensor, " P"]


def assign_front_back(
    rig: Rig, frame: MapFrame, size: int, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]
) -> FrontBackAssignment:
    """Choose the side of every point by its depth, not by its normal.

    The far side of a fold in front of a skirt faces backwards, but the back map at its place shows the back of the
    skirt, ten centimetres away, which moves differently. Where the maps show nothing, the normal decides.

    Args:
        rig: of the template.
        frame: of the maps.
        size: side of the maps, pixels.
        points: canonical, metres.
        normals: of the points.
    """
    maps = front_back_maps(rig.vertices, rig.faces, frame, size=size)
    shown = maps.mask.to(points.dtype)
    # Heights weighted by the mask, so that bilinear samples at its border can be divided by the mask's weight.
    table = torch.stack([maps.interpolate(rig.vertices)[..., 2] * shown, shown], dim=-1)[None]
    # Distance along z from every point to the surface on each map.
    distances, belows = [], []
    for is_front in (True, False):
        side = torch.full((len(points),), is_front, device=points.device)
        height, weight = MapSampler(frame, size, points, side)(table)[0].unbind(-1)
        below = (height / weight.clamp(min=1e-6) - points[:, 2]) * (1.0 if is_front else -1.0)
        seen = weight > 1e-3
        distances.append(below.abs().masked_fill(~seen, torch.inf))
        belows.append(below.masked_fill(~seen, 0.0))
    nothing = torch.isinf(distances[0]) & torch.isinf(distances[1])
    front = torch.where(nothing, normals[:, 2] >= 0, distances[0] <= distances[1])
    return FrontBackAssignment(front, torch.where(front, belows[0], belows[1]))
