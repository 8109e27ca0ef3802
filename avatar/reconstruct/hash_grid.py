"""Features of points from hash tables at several resolutions (Mueller et al. 2022), in plain torch."""

from __future__ import annotations

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
