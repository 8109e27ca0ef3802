"""Gaussians that lie side by side learn to move side by side."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.gather import gather_rows
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
            self._axes, self._start = frames.rotations[faces], start.detach().clone()
            places = world_from_frames(gaussians, frames).means.double().cpu().numpy()
        part = rig.template.vertex_part[rig.template.faces[faces.cpu().numpy(), 0]]
        self._near = _neighbours(places, part)

    def __call__(self, shapes: Float[Tensor, "N 3 n"], random: np.random.Generator) -> Float[Tensor, ""]:
        """Return the penalty of shapes as they are now, estimated on Gaussians and neighbours drawn at random."""
        count, near = self._near.shape
        rows = random.choice(count, size=max(1, round(SHARE * count)), replace=False)
        others = self._near[rows, random.integers(near, size=len(rows))]
        learned, beside = (
            self._learned(shapes, torch.as_tensor(each, device=shapes.device)) for each in (rows, others)
        )
        return (learned - beside).square().sum((1, 2)).mean()

    def _learned(self, shapes: Tensor, rows: Tensor) -> Tensor:
        return torch.einsum("nij,njk->nik", self._axes[rows], gather_rows(shapes, rows) - self._start[rows])


def _neighbours(places: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The nearest others of the same part (N, k); a Gaussian stands for itself where its part has too few."""
    near = np.repeat(np.arange(len(places))[:, None], NEIGHBOURS, axis=1)
    for one in np.unique(part):
        own = np.flatnonzero(part == one)
        count = min(NEIGHBOURS + 1, len(own))
        found = cKDTree(places[own]).query(places[own], k=count)[1].reshape(len(own), count)[:, 1:]
        near[own, : count - 1] = own[found]
    return near
