"""Losses on deformation: displacement and labels against the teacher, and coherence of neighbouring Gaussians."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians, on_triangles, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.rendering.mesh_maps import MapFrame, front_back_maps
from avatar.rig.rig import Rig

TAU = 8.0 * math.pi
"""Spatial frequency of the semantic labels, radians a metre: a wavelength of 25 cm."""


class DisplacementLoss:
    """`L_non = mean |dV - dU|` over the mesh's pixels of the front and back maps of the T-pose.

    dV are the mesh's rasterised displacements, dU the teacher's maps. Both are divided by `unit`, so that the loss
    compares maps and does not depend on the unit of length.

    Args:
        rig: of the template.
        frame: square of the teacher's maps.
        size: side of the teacher's maps, pixels.
        unit: metres of a teacher's output of 1.
    """

    def __init__(self, rig: Rig, frame: MapFrame, size: int, unit: float) -> None:
        self.maps = front_back_maps(rig.vertices, rig.faces, frame, size=size)
        self.mask = self.maps.mask
        # The mask's pixels as indices: finding them in every step would wait for a GPU each time.
        self._pixels = self.mask.flatten().nonzero().squeeze(1)
        self.unit = unit

    def __call__(self, displacements: Float[Tensor, "V 3"], teacher: Float[Tensor, "2 S S 3"]) -> Float[Tensor, ""]:
        """Return the loss, with gradients to the displacements.

        Args:
            displacements: of the vertices, metres.
            teacher: its maps, metres.
        """
        # Rasterise the displacements of the vertices to the maps' pixels, (2, S, S, 3); |.| is the L1 norm over x, y,
        # z.
        difference = (self.maps.interpolate(displacements) - teacher).abs().sum(-1)
        return difference.flatten()[self._pixels].mean() / self.unit


def vertex_labels(rig: Rig, *, tau: float = TAU) -> Float[Tensor, "V 3"]:
    """Return the labels of the template's vertices, `e = c + sin(tau v)`; arguments as of `semantic_labels`."""
    return rig.semantic_colors + torch.sin(tau * rig.vertices)


def semantic_labels(rig: Rig, gaussians: BoundGaussians, *, tau: float = TAU) -> Float[Tensor, "N 3"]:
    """Return the labels of the Gaussians, `e = c + sin(tau v)` interpolated from their triangles' corners.

    Args:
        tau: radians a metre; v are the corners in the T-pose, c their semantic colours in [0, 1].
    """
    # (N, 3, 3): the labels of the three corners of each Gaussian's triangle.
    corners = vertex_labels(rig, tau=tau)[rig.faces[gaussians.face_index]]
    return on_triangles(corners, gaussians.barycentric)


NEIGHBOURS = 8
"""Number of nearest Gaussians in the T-pose, on the same part, that each Gaussian is compared with."""
SHARE = 1 / 16
"""Share of the Gaussians that a step compares, each with one neighbour; more cost more time a step."""


class Coherence:
    """`mean |R_i dU_i - R_j dU_j|^2` over neighbouring Gaussians i, j: coherence of learned blend shapes.

    dU is the change of the shapes U (3, n) since the start, R rotates a triangle's axes to those of the T-pose, and the
    squares are summed over the columns: for coefficients of unit deviation, the expected squared distance between two
    neighbours, square metres. Penalties on neighbours are usual for Gaussians that move freely (Luiten et al. 2024).
    Without one, cameras that disagree about a fold each pull other Gaussians of a patch to where they see the pattern,
    and the patch tears between the cameras.

    Args:
        rig: of the template.
        gaussians: those with blend shapes.
        start: initial U, metres.
    """

    def __init__(self, rig: Rig, gaussians: BoundGaussians, start: Float[Tensor, "N 3 n"]) -> None:
        # Distances are taken in the T-pose, where folds of cloth that only touch in a pose are far apart.
        faces = gaussians.face_index
        with torch.no_grad():
            frames = triangle_frames(rig.vertices, rig.faces)
            axes, self._start = frames.rotations[faces], start.detach().clone()
            places = world_from_frames(gaussians, frames).means.double().cpu().numpy()
        part = rig.template.vertex_part[rig.template.faces[faces.cpu().numpy(), 0]]
        # Indices of the neighbours, (N, k). dU is given in a triangle's axes, so comparing two needs the turn between
        # them.
        self._near = _neighbours(places, part)
        near = torch.as_tensor(self._near, device=axes.device)
        # (N, k, 3, 3): R_i^T R_j
        self._own_from_other = torch.stack([axes.mT @ axes[others] for others in near.unbind(1)], dim=1)

    def __call__(self, shapes: Float[Tensor, "N 3 n"], random: np.random.Generator) -> Float[Tensor, ""]:
        """Return the penalty of shapes, estimated on a random sixteenth of the Gaussians with one neighbour each."""
        # Draw Gaussians without repetition, and one of its k neighbours for each: an unbiased estimate of the full
        # mean.
        count, near = self._near.shape
        rows = random.choice(count, size=max(1, round(SHARE * count)), replace=False)
        which = random.integers(near, size=len(rows))
        drawn = np.stack([rows, self._near[rows, which], which])
        own, other, turned = torch.as_tensor(drawn, device=shapes.device)
        turn = self._own_from_other[own, turned]
        apart: Tensor = _PairDistance.apply(shapes, self._start, torch.stack([own, other]), turn)
        return apart


class _PairDistance(torch.autograd.Function):
    """Mean over P pairs i, j of `|a_i - Q a_j|^2`, `a = shapes - start`, with one dense gradient for all of them."""

    @staticmethod
    def forward(ctx: Any, shapes: Tensor, start: Tensor, pairs: Tensor, turn: Tensor) -> Tensor:
        # a = U - U_start at both ends of all pairs, (2 P, 3, n); then the other's, turned to the own axes.
        learned = shapes.index_select(0, pairs.flatten()) - start.index_select(0, pairs.flatten())
        own, other = learned.unflatten(0, (2, -1))
        apart = own - _rotated(turn, other)
        ctx.save_for_backward(pairs, turn, apart)
        ctx.shape = shapes.shape
        return apart.square().sum((1, 2)).mean()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None, None, None]:
        pairs, turn, apart = ctx.saved_tensors
        # d/da_i = 2 (a_i - Q a_j) / P and d/da_j = -Q^T d/da_i. A Gaussian may be in several pairs, so the rows are
        # added.
        own = (2.0 / len(apart) * slope) * apart
        both = torch.cat([own, -_rotated(turn.mT, own)])
        index = pairs.flatten()[:, None, None].expand_as(both)
        return apart.new_zeros(ctx.shape).scatter_add_(0, index, both), None, None, None


def _rotated(turn: Float[Tensor, "P 3 3"], values: Float[Tensor, "P 3 n"]) -> Tensor:
    """Return the matrix products, column by column because `bmm` is slow for many small matrices."""
    return sum((turn[:, :, k, None] * values[:, None, k] for k in (1, 2)), turn[:, :, 0, None] * values[:, None, 0])


def _neighbours(places: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the nearest others of the same part (N, k), filled with the Gaussian itself if the part has too few."""
    # The nearest point of a query is the Gaussian itself, so one more is asked for, and the first column is dropped.
    near = np.repeat(np.arange(len(places))[:, None], NEIGHBOURS, axis=1)
    for one in np.unique(part):
        own = np.flatnonzero(part == one)
        count = min(NEIGHBOURS + 1, len(own))
        found = cKDTree(places[own]).query(places[own], k=count)[1].reshape(len(own), count)[:, 1:]
        near[own, : count - 1] = own[found]
    return near
