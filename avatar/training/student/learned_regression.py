"""The regression of new poses while photographs correct it: smooth over the surface, so that few pixels move much."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn

from avatar.models.networks.pose_regression import PoseRegression
from avatar.models.networks.sparse_rows import SparseRows

NEIGHBOURS = 32


class LearnedRegression(nn.Module):
    """`dv(theta) = dv_0(theta) + S (u_0 + U z(theta))`: a regression and what is learned beside it, u = 0 at first.

    z are the coefficients of the regression's directions, S means over neighbours. As Nicolet et al., "Large Steps in
    Inverse Rendering of Geometry" (2021), have it: Adam moves u, whose every number it moves alike, and what the
    surface does is smooth.

    Args:
        start: dv_0. points: its control points in the T-pose, metres. groups: within which there are neighbours.
        reach: metres, standard deviation of the weights of neighbours.
    """

    def __init__(
        self,
        start: PoseRegression,
        points: Float[np.ndarray, "K 3"],
        groups: Int[np.ndarray, " K"],
        *,
        reach: float,
    ) -> None:
        super().__init__()
        self.start = start
        self.smooth = _means(points, groups, reach).to(start.level.device)
        size = (len(points), 3 * (1 + len(start.rows)))
        self.moved = nn.Parameter(start.level.new_zeros(size))

    def forward(self, pose: Float[Tensor, "B 63"]) -> Float[Tensor, "B K 3"]:
        """Return displacements of the points, metres."""
        return self.regression()(pose)

    def regression(self) -> PoseRegression:
        """Return what has been learned so far as a regression."""
        moved = self.smooth(self.moved).view(len(self.moved), 3, -1)
        start = self.start
        return start.with_values(level=start.level + moved[..., 0], basis=start.basis + moved[..., 1:])


def _means(points: Float[np.ndarray, "K 3"], groups: Int[np.ndarray, " K"], reach: float) -> SparseRows:
    count = len(points)
    rows, weights = np.repeat(np.arange(count)[:, None], NEIGHBOURS, axis=1), np.zeros((count, NEIGHBOURS))
    weights[:, 0] = 1.0
    for group in np.unique(groups):
        own = np.flatnonzero(groups == group)
        used = min(NEIGHBOURS, len(own))
        away, near = cKDTree(points[own]).query(points[own], k=used)
        rows[own, :used] = own[near.reshape(len(own), used)]
        weights[own, :used] = np.exp(-0.5 * (away.reshape(len(own), used) / reach) ** 2)
    weights /= weights.sum(axis=1, keepdims=True)
    return SparseRows(torch.as_tensor(rows), torch.as_tensor(weights, dtype=torch.float32), count)
