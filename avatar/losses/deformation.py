"""The bake's losses on the mesh: its displacements against the teacher's maps, and its labels against the teacher's."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians, on_triangles
from avatar.rendering.map_frame import MapFrame
from avatar.rendering.mesh_maps import front_back_maps
from avatar.rig.rig import Rig

TAU = 8.0 * math.pi
"""Radians a metre of the semantic labels' waves: one every 25 cm."""


class DisplacementLoss:
    """`L_non = mean |dV - dU|` over the mesh's pixels of the front and back maps of the T-pose.

    dV are the mesh's displacements rasterised, dU the teacher's maps. Both are divided by `unit`, the metres of an
    output of 1 of the teacher, so that the loss is one between maps and does not depend on the unit of length.

    Args:
        rig: that of the template. frame, size: those of the teacher's maps. unit: metres.
    """

    def __init__(self, rig: Rig, frame: MapFrame, size: int, unit: float) -> None:
        self.maps = front_back_maps(rig.vertices, rig.faces, frame, size=size)
        self.mask = self.maps.mask
        self.unit = unit

    def __call__(self, displacements: Float[Tensor, "V 3"], teacher: Float[Tensor, "2 S S 3"]) -> Float[Tensor, ""]:
        """Return the loss, with gradients to the displacements.

        Args:
            displacements: metres. teacher: its maps, metres.
        """
        difference = (self.maps.interpolate(displacements) - teacher).abs().sum(-1)
        return difference[self.mask].mean() / self.unit


def vertex_labels(rig: Rig, *, tau: float = TAU) -> Float[Tensor, "V 3"]:
    """Return the labels of the template's vertices, `e = c + sin(tau v)`; arguments as of `semantic_labels`."""
    return rig.semantic_colors + torch.sin(tau * rig.vertices)


def semantic_labels(rig: Rig, gaussians: BoundGaussians, *, tau: float = TAU) -> Float[Tensor, "N 3"]:
    """Return the labels of the Gaussians, `e = c + sin(tau v)` interpolated from their triangles' corners.

    Args:
        tau: radians a metre; v are the corners in the T-pose, c their semantic colours in [0, 1].
    """
    corners = vertex_labels(rig, tau=tau)[rig.faces[gaussians.face_index]]
    return on_triangles(corners, gaussians.barycentric)
