"""Gaussians that lie side by side learn to move side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.rig.rig import Rig

NEIGHBOURS = 8
"""Of each Gaussian, the nearest in the T-pose on the same part."""
SHARE = 1 / 16
"""Of the Gaussians that are compared with one neighbour in a step."""


class Coherence:
    """`mean |R_i dU_i - R_j dU_j|^2` over neighbouring Gaussians i, j: how far apart blend shapes learn to move them.

    dU is what shapes U (3, n) have learned since the start, R takes a triangle's axes to those of the T-pose, and the
    squares are summed over the columns: for coefficients of unit deviation, the expected squared distance by which two
    neighbours leave each other, square metres. Penalties on neighbours are usual for Gaussians that move freely
    (Luiten et al. 2024). Here, cameras that disagree about a fold would each draw other Gaussians of a patch to where
    they see the pattern; between the cameras it falls apart.

    Args:
        rig: that of the template. gaussians: those on it that have blend shapes. start: U, metres, to begin with.
    """

    def __init__(self, rig: Rig, gaussians: BoundGaussians, start: Float[Tensor, "N 3 n"]) -> None:
        faces = gaussians.face_index
        with torch.no_grad():
            frames = triangle_frames(rig.vertices, rig.faces)
            axes, self._start = frames.rotations[faces], start.detach().clone()
            places = world_from_frames(gaussians, frames).means.double().cpu().numpy()
        part = rig.template.vertex_part[rig.template.faces[faces.cpu().numpy(), 0]]
        self._near = _neighbours(places, part)
        near = torch.as_tensor(self._near, device=axes.device)
        # (N, k, 3, 3): R_i^T R_j
        self._own_from_other = torch.stack([axes.mT @ axes[others] for others in near.unbind(1)], dim=1)

    def __call__(self, shapes: Float[Tensor, "N 3 n"], random: np.random.Generator) -> Float[Tensor, ""]:
        """Return the penalty of shapes as they are now, estimated on Gaussians and neighbours drawn at random."""
        count, near = self._near.shape
        rows = random.choice(count, size=max(1, round(SHARE * count)), replace=False)
        which = random.integers(near, size=len(rows))
        drawn = np.stack([rows, self._near[rows, which], which])
        own, other, turned = torch.as_tensor(drawn, device=shapes.device)
        turn = self._own_from_other[own, turned]
        apart: Tensor = _Apart.apply(shapes, self._start, torch.stack([own, other]), turn)
        return apart


class _Apart(torch.autograd.Function):
    """Mean over P pairs i, j of `|a_i - Q a_j|^2`, `a = shapes - start`, with one dense gradient for all of them."""

    @staticmethod
    def forward(ctx: Any, shapes: Tensor, start: Tensor, pairs: Tensor, turn: Tensor) -> Tensor:
        learned = shapes.index_select(0, pairs.flatten()) - start.index_select(0, pairs.flatten())
        own, other = learned.unflatten(0, (2, -1))
        apart = own - _turned(turn, other)
        ctx.save_for_backward(pairs, turn, apart)
        ctx.shape = shapes.shape
        return apart.square().sum((1, 2)).mean()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None, None, None]:
        pairs, turn, apart = ctx.saved_tensors
        own = (2.0 / len(apart) * slope) * apart
        both = torch.cat([own, -_turned(turn.mT, own)])
        index = pairs.flatten()[:, None, None].expand_as(both)
        return apart.new_zeros(ctx.shape).scatter_add_(0, index, both), None, None, None


def _turned(turn: Float[Tensor, "P 3 3"], values: Float[Tensor, "P 3 n"]) -> Tensor:
    """Return the products; many small matrices are slow in `bmm`."""
    return sum((turn[:, :, k, None] * values[:, None, k] for k in (1, 2)), turn[:, :, 0, None] * values[:, None, 0])


def _neighbours(places: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The nearest others of the same part (N, k); a Gaussian stands for itself where its part has too few."""
    near = np.repeat(np.arange(len(places))[:, None], NEIGHBOURS, axis=1)
    for one in np.unique(part):
        own = np.flatnonzero(part == one)
        count = min(NEIGHBOURS + 1, len(own))
        found = cKDTree(places[own]).query(places[own], k=count)[1].reshape(len(own), count)[:, 1:]
        near[own, : count - 1] = own[found]
    return near
