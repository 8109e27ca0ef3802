"""Front and back maps of a body in its canonical pose: their cameras, and Gaussians looked up in them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError


@dataclass(frozen=True)
class MapFrame:
    """The square that both maps cover: `center` +- `half_extent` along x and y of the canonical pose.

    Row 0 is at the top (+y) and column 0 at the left (-x) of *both* maps: the back map is mirrored, so that one pixel
    shows the front and the back of the same place.

    Attributes:
        center: (3,) metres, the middle of the canonical box.
        half_extent: metres from the middle of a map to its border.
    """

    center: tuple[float, float, float]
    half_extent: float = 1.0

    @staticmethod
    def of(vertices: np.ndarray, *, half_extent: float = 1.0) -> MapFrame:
        """Frame about the middle of the box of the canonical vertices (V, 3)."""
        low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
        return MapFrame(tuple(float(c) for c in 0.5 * (low + high)), half_extent)

    def cameras(self, size: int) -> tuple[Camera, Camera]:
        """Orthographic cameras of the front and the mirrored back map, `size` pixels a side."""
        front, back = (
            Camera.orthographic_view(
                center=np.array(self.center), direction=np.array([0.0, 0.0, z]), half_extent=self.half_extent, size=size
            )
            for z in (1.0, -1.0)
        )
        # The back view's x axis is -x of the world: a negative focal length turns its columns round.
        mirrored = back.K * np.array([[-1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
        return replace(front, name="front"), replace(back, K=mirrored, name="back")

    def pixels_from_canonical(self, points: Tensor, size: int) -> Tensor:
        """(..., 3) canonical points, metres -> (..., 2) column and row in pixels, pixel centres at +0.5."""
        x, y = points[..., 0] - self.center[0], points[..., 1] - self.center[1]
        return torch.stack([x, -y], dim=-1) * (0.5 * size / self.half_extent) + 0.5 * size


class _Bags(torch.autograd.Function):
    """Sparse matrix times (rows, C) table, by weighted sums of rows; the adjoint is the transposed sparse matrix."""

    @staticmethod
    def forward(ctx, table: Tensor, *matrices: Tensor) -> Tensor:
        ctx.save_for_backward(*matrices)
        rows, offsets, weights = matrices[:3]
        return F.embedding_bag(rows, table.to(weights.dtype), offsets, mode="sum", per_sample_weights=weights)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, offsets, weights = ctx.saved_tensors[3:]
        gradient = gradient.to(weights.dtype)
        summed = F.embedding_bag(rows, gradient, offsets, mode="sum", per_sample_weights=weights)
        return summed, *(None for _ in ctx.saved_tensors)


class MapSampler(nn.Module):
    """Looks N Gaussians up in front and back maps, bilinearly, each on the side that it faces.

    A Gaussian faces the front where its canonical normal has `z >= 0`. Values hold at pixel centres (`grid_sample`'s
    `align_corners=False`); beyond the outermost centres the border's value holds. The lookup is linear in the maps and
    the same for every frame, so it is prepared as a sparse matrix and its transpose: several times faster than
    `grid_sample` on a CPU, and the sums of its gradient have one order on any device.

    Args:
        frame: of the maps.
        size: side of the maps in pixels.
        points: (N, 3) canonical positions, metres.
        normals: (N, 3) canonical normals, any length.

    Raises:
        InputError: points that are not finite or outside the frame, or normals of another shape.
    """

    def __init__(self, frame: MapFrame, size: int, points: Tensor, normals: Tensor) -> None:
        super().__init__()
        if points.ndim != 2 or points.shape[1] != 3 or normals.shape != points.shape:
            raise InputError(
                "canonical Gaussians",
                expected="positions and normals of shape (N, 3)",
                received=f"shapes {tuple(points.shape)} and {tuple(normals.shape)}",
            )
        pixels = frame.pixels_from_canonical(points.detach(), size)
        beyond = float((pixels - 0.5 * size).abs().max()) * 2.0 / size if len(pixels) else 0.0
        if not beyond <= 1.0:
            raise InputError(
                "canonical Gaussians",
                expected=f"within {frame.half_extent:g} m of the middle of the maps along x and y",
                received=f"one {beyond * frame.half_extent:.3g} m away",
                remedy="check the units, or choose a larger half extent",
            )
        self.size = size
        faces_back = normals[:, 2] < 0
        corner = (pixels - 0.5).floor().clamp(0, size - 2)
        right, down = (pixels - 0.5 - corner).clamp(0.0, 1.0).unbind(-1)
        column, row = corner.long().unbind(-1)
        first = (faces_back * size + row) * size + column
        rows = torch.stack([first, first + 1, first + size, first + size + 1], dim=1).flatten()
        weights = [(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down]
        weights = torch.stack(weights, dim=1).flatten()

        order = torch.argsort(rows, stable=True)
        counts = torch.bincount(rows, minlength=2 * size * size)
        self.register_buffer("faces_front", ~faces_back, persistent=False)
        matrices = {
            "rows": rows, "offsets": torch.arange(0, 4 * len(points), 4, device=rows.device), "weights": weights,
            "transposed_rows": order // 4, "transposed_offsets": counts.cumsum(0) - counts,
            "transposed_weights": weights[order],
        }  # fmt: skip
        self._names = tuple(matrices)
        for name, value in matrices.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, maps: Tensor) -> Tensor:
        """(B, 2, size, size, C) front and back maps -> (B, N, C).

        Raises:
            InputError: maps of another size.
        """
        if maps.ndim != 5 or maps.shape[1:4] != (2, self.size, self.size):
            raise InputError(
                "maps",
                expected=f"shape (B, 2, {self.size}, {self.size}, C)",
                received=f"shape {tuple(maps.shape)}",
            )
        matrices = [getattr(self, name) for name in self._names]
        return torch.stack([_Bags.apply(table, *matrices) for table in maps.flatten(1, 3)])
