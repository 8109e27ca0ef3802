"""Look values up as weighted sums of few rows of a table, and of the front and back maps of a body."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from avatar.rendering.mesh_maps import MapFrame
from smplxpp.core.errors import InputError


class _Bags(torch.autograd.Function):
    """Sparse matrix times (rows, C) table, by weighted sums of rows; the adjoint is the transposed sparse matrix."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, *matrices: Tensor) -> Tensor:
        # The first three tensors are the matrix, the last three its transpose; each sum of weighted rows is one bag.
        ctx.save_for_backward(*matrices)
        rows, offsets, weights = matrices[:3]
        return F.embedding_bag(rows, table.to(weights.dtype), offsets, mode="sum", per_sample_weights=weights)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, offsets, weights = ctx.saved_tensors[3:]
        # d/dtable = W^T d/dout: the same kind of sum, with a fixed order of additions.
        gradient = gradient.to(weights.dtype)
        summed = F.embedding_bag(rows, gradient, offsets, mode="sum", per_sample_weights=weights)
        return summed, *(None for _ in ctx.saved_tensors)


class SparseRows(nn.Module):
    """`out_i = sum_j w_ij table[r_ij]`, several times faster on a CPU than a gather, its gradient most of all.

    The transposed matrix is prepared too, so that the sums of the gradient have one order on any device. The buffers
    are not saved, because they follow from the arguments.

    Args:
        rows: r, indices of the table's rows.
        weights: w, of those rows.
        count: number of the table's rows.
    """

    def __init__(self, rows: Int[Tensor, "P k"], weights: Float[Tensor, "P k"], count: int) -> None:
        super().__init__()
        # Both matrices in the form of embedding bags: flat indices, offsets, weights.
        points, per_point = rows.shape
        flat, weights = rows.flatten(), weights.flatten()
        # The transposed matrix: entries sorted by the table's row.
        order = torch.argsort(flat, stable=True)
        counts = torch.bincount(flat, minlength=count)
        offsets = torch.arange(0, per_point * points, per_point, device=rows.device)
        matrices = {
            "rows": flat,
            "offsets": offsets,
            "weights": weights,
            # Entry e of the flat matrix belongs to point e // k.
            "transposed_rows": order // per_point,
            "transposed_offsets": counts.cumsum(0) - counts,
            "transposed_weights": weights[order],
        }
        self._names, self.per_point = tuple(matrices), per_point
        for name, value in matrices.items():
            self.register_buffer(name, value, persistent=False)

    def of(self, points: Int[Tensor, " N"]) -> tuple[Int[Tensor, "N k"], Float[Tensor, "N k"]]:
        """Return the table rows and weights of chosen sums."""
        rows, weights = (getattr(self, name).reshape(-1, self.per_point) for name in ("rows", "weights"))
        return rows[points], weights[points]

    def forward(self, table: Float[Tensor, "R C"]) -> Float[Tensor, "P C"]:
        """Return the weighted sums of the table's rows."""
        return _Bags.apply(table, *(getattr(self, name) for name in self._names))


class MapSampler(nn.Module):
    """Looks N Gaussians up in front and back maps, bilinearly, each on its own side.

    Values hold at pixel centres (`grid_sample`'s `align_corners=False`); outside the outermost centres the border's
    value holds. The lookup is linear in the maps and the same for every frame, so it is prepared as a sparse matrix:
    several times faster than `grid_sample` on a CPU.

    Args:
        frame: of the maps.
        size: side of the maps in pixels.
        points: canonical positions, metres.
        front: whether each point is on the front map.

    Raises:
        InputError: points that are not finite or outside the frame, or sides of another number.
    """

    def __init__(self, frame: MapFrame, size: int, points: Float[Tensor, "N 3"], front: Bool[Tensor, " N"]) -> None:
        super().__init__()
        # Check the shapes, and that all points lie on the maps.
        if points.ndim != 2 or points.shape[1] != 3 or front.shape != points.shape[:1]:
            raise InputError(
                "canonical Gaussians",
                expected="positions of shape (N, 3) and sides of shape (N,)",
                received=f"shapes {tuple(points.shape)} and {tuple(front.shape)}",
            )
        pixels = frame.pixels_from_canonical(points.detach(), size)
        excess = float((pixels - 0.5 * size).abs().max()) * 2.0 / size if len(pixels) else 0.0
        if not excess <= 1.0:
            raise InputError(
                "canonical Gaussians",
                expected=f"within {frame.half_extent:g} m of the middle of the maps along x and y",
                received=f"one {excess * frame.half_extent:.3g} m away",
                remedy="check the units, or choose a larger half extent",
            )
        # Bilinear weights of the four pixel centres around each point, as rows of a sparse matrix.
        self.size = size
        # Upper left of the four pixels; the clamps make points outside the outermost centres take the border's value.
        corner = (pixels - 0.5).floor().clamp(0, size - 2)
        right, down = (pixels - 0.5 - corner).clamp(0.0, 1.0).unbind(-1)
        column, row = corner.long().unbind(-1)
        # Flat index in (2, S, S): side 0 is the front map, side 1 the back map.
        first = (~front * size + row) * size + column
        rows = torch.stack([first, first + 1, first + size, first + size + 1], dim=1)
        weights = [(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down]
        self.lookup = SparseRows(rows, torch.stack(weights, dim=1), 2 * size * size)

    def forward(self, maps: Float[Tensor, "B 2 S S C"]) -> Float[Tensor, "B N C"]:
        """Look the Gaussians up in front and back maps.

        Raises:
            InputError: maps of another size.
        """
        if maps.ndim != 5 or maps.shape[1:4] != (2, self.size, self.size):
            raise InputError(
                "maps",
                expected=f"shape (B, 2, {self.size}, {self.size}, C)",
                received=f"shape {tuple(maps.shape)}",
            )
        return torch.stack([self.lookup(table) for table in maps.flatten(1, 3)])
