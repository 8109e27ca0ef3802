"""Neural surface: a signed distance, the visual hull's plus a learned residual, and the colour of its points."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from smplxpp.core.errors import InputError

_PRIMES = (1, 2_654_435_761, 805_459_861)


class HashGrid(nn.Module):
    """Trilinear interpolation of learned features at the corners of a point's cell, level by level.

    A level with fewer corners than table entries has one entry for each; other levels share entries by a hash.

    Args:
        levels: how many.
        coarsest: cells along a side of the unit cube at the first level.
        finest: the same at the last level.
        log2_entries: of each table.
        features: of an entry.

    Raises:
        InputError: no level, or sizes that do not grow.
    """

    corners: Tensor

    def __init__(
        self, *, levels: int = 14, coarsest: int = 16, finest: int = 1024, log2_entries: int = 19, features: int = 2
    ) -> None:
        super().__init__()
        if levels < 1 or coarsest < 1 or finest < coarsest or not 4 <= log2_entries <= 24 or features < 1:
            raise InputError(
                "hash grid",
                expected="a level or more, cells that do not become fewer, tables of 2^4 to 2^24",
                received=f"{levels} levels of {coarsest} to {finest} cells, 2^{log2_entries}, {features} features",
            )
        # Sides of the levels grow geometrically; coarse levels have smaller tables.
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        self.sizes = [round(coarsest * growth**k) for k in range(levels)]
        self.entries = 1 << log2_entries
        self.tables = nn.ParameterList(
            nn.Parameter(torch.empty(min(self.entries, (size + 1) ** 3), features).uniform_(-1e-4, 1e-4))
            for size in self.sizes
        )
        corners = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        self.register_buffer("corners", corners, persistent=False)

    @property
    def width(self) -> int:
        """The number of features of a point, over all levels."""
        return len(self.sizes) * int(self.tables[0].shape[1])

    def forward(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N width"]:
        """Return the features of points in the unit cube; points outside are clamped to its nearest side."""
        found = []
        for size, table in zip(self.sizes, self.tables, strict=True):
            # Trilinear weights of the eight corners of the cell.
            place = points.clamp(0, 1) * size
            # The index has no gradient; points on the far side belong to the last cell.
            cell = place.detach().floor().clamp(max=size - 1)
            part = (place - cell)[:, None]
            weights = torch.where(self.corners.bool(), part, 1 - part).prod(dim=-1)
            rows = self._table_rows(cell.long()[:, None] + self.corners, size, len(table))
            found.append((weights[..., None] * table[rows]).sum(dim=1))
        return torch.cat(found, dim=1)

    def _table_rows(self, corner: Int[Tensor, "N 8 3"], size: int, entries: int) -> Int[Tensor, "N 8"]:
        # A dense level has one row a corner. Otherwise XOR of the coordinates times large primes, modulo the table's
        # size: where corners collide, the gradients of points at the surface dominate the shared row (Mueller et al.).
        x, y, z = corner.unbind(dim=-1)
        if (size + 1) ** 3 <= self.entries:
            return (x * (size + 1) + y) * (size + 1) + z
        return ((x * _PRIMES[0]) ^ (y * _PRIMES[1]) ^ (z * _PRIMES[2])) % entries


# Sizes of the networks: width of hidden layers, and features that the distance's network passes to the colour's.
_HIDDEN, _SHARED = 64, 15


class NeuralSurface(nn.Module):
    """f(x) = hull(x) + residual(x) in metres, negative inside; colours depend on place, normal and viewing direction.

    The residual starts at zero, so that the initial surface is the hull.

    Args:
        hull: (X, Y, Z) signed distance on a grid, negative inside.
        low: least corner of the grid in the world, metres.
        high: largest corner.
        grid: features of both networks.
    """

    hull: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, hull: Float[Tensor, "X Y Z"], low: Float[Tensor, " 3"], high: Float[Tensor, " 3"], grid: HashGrid
    ) -> None:
        super().__init__()
        self.register_buffer("hull", hull)
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.grid = grid
        # Residual distance with features for the colour; its last layer starts at zero.
        self.residual = nn.Sequential(
            nn.Linear(grid.width + 3, _HIDDEN), nn.Softplus(beta=100), nn.Linear(_HIDDEN, 1 + _SHARED)
        )
        for parameter in self.residual[2].parameters():
            nn.init.zeros_(parameter)
        # Colour from grid features, the distance's features, normal and viewing direction.
        self.color = nn.Sequential(
            nn.Linear(grid.width + 15 + 6, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, 3),
        )
        initial_sharpness = 200.0  # 1/metre: the density is a few centimetres thick at first
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(initial_sharpness)))

    @property
    def sharpness(self) -> Float[Tensor, ""]:
        """Slope of the density at the surface, 1/metre."""
        return torch.exp(self.log_sharpness)

    def hull_distance(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Return the hull's signed distance, metres; outside the grid that of its nearest side."""
        # `grid_sample` wants coordinates in [-1, 1] in the order z, y, x: the last axis of the grid comes first.
        place = 2 * (points - self.low) / (self.high - self.low) - 1
        sampled = nn.functional.grid_sample(
            self.hull[None, None],
            place.flip(-1)[None, :, None, None],
            align_corners=True,
            padding_mode="border",
        )
        return sampled.reshape(-1)

    def distance(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Return the signed distance of points in the world, metres."""
        return self.hull_distance(points) + self._learned(points)[0][:, 0]

    def _learned(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 16"], Float[Tensor, "N W"]]:
        """Return the residual with its features, and the features of the grid."""
        # One scale for all axes, so that cells of the hash grid are cubes; the box's longest side has length 1.
        unit = (points - self.low) / (self.high - self.low).max()
        features = self.grid(unit)
        return self.residual(torch.cat([features, 2 * unit - 1], dim=1)), features

    def gradient(self, points: Float[Tensor, "N 3"], *, step: float) -> Float[Tensor, "N 3"]:
        """Return the gradient of the distance by central differences over neighbouring cells (Li et al. 2023)."""
        # A step as long as a cell spreads the gradient over neighbouring cells, so that the eikonal term smooths them
        # all;
        # the analytic gradient of trilinear features reaches the corners of a single cell alone.
        offsets = step * torch.eye(3, dtype=points.dtype, device=points.device)
        ends = [self.distance(points + offset) - self.distance(points - offset) for offset in offsets]
        return torch.stack(ends, dim=1) / (2 * step)

    def look(
        self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Return the colours of points in viewing directions, sRGB in [0, 1]."""
        # The network of the colour sees the features that the distance's network shares, without the distance itself.
        learned, features = self._learned(points)
        return torch.sigmoid(self.color(torch.cat([features, learned[:, 1:], normals, directions], dim=1)))
