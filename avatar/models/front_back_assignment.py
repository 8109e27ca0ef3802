"""On which of the front and back maps a point of the canonical body is looked up."""

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
    """The sides of P points.

    Attributes:
        front: whether the front is the side whose surface is the nearer one along z.
        behind: metres by which the point lies below the surface that this side shows; 0 where it shows none.
    """

    front: Bool[Tensor, " P"]
    behind: Float[Tensor, " P"]


def assign_front_back(
    rig: Rig, frame: MapFrame, size: int, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]
) -> FrontBackAssignment:
    """Choose the side of every point by depth, not by the direction that a point faces.

    A fold of the front of a skirt has a far side, which faces backwards: on the back map at its place is the back of
    the skirt, a hand's breadth away, which moves in another way. Where the maps show nothing, the normal decides.

    Args:
        frame, size: those of the maps. points: canonical, metres.
    """
    maps = front_back_maps(rig.vertices, rig.faces, frame, size=size)
    shown = maps.mask.to(points.dtype)
    # Heights without the background: blended with it, they would be nowhere.
    table = torch.stack([maps.interpolate(rig.vertices)[..., 2] * shown, shown], dim=-1)[None]
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
