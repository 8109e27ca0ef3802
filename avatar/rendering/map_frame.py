"""The square that front and back maps of a body in its canonical pose cover, and their cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from smplxpp.core.camera import Camera


@dataclass(frozen=True)
class MapFrame:
    """The square that both maps cover: `center` +- `half_extent` along x and y of the canonical pose.

    Row 0 is at the top (+y) and column 0 at the left (-x) of *both* maps: the back map is mirrored, so that one pixel
    shows the front and the back of the same place.

    Attributes:
        center: metres, the middle of the canonical box.
        half_extent: metres from the middle of a map to its border.
    """

    center: tuple[float, float, float]
    half_extent: float = 1.0

    @staticmethod
    def of(vertices: Float[np.ndarray, "V 3"], *, half_extent: float = 1.0) -> MapFrame:
        """Make the frame about the middle of the box of canonical vertices, metres."""
        x, y, z = 0.5 * (np.min(vertices, axis=0) + np.max(vertices, axis=0))
        return MapFrame((float(x), float(y), float(z)), half_extent)

    def cameras(self, size: int) -> tuple[Camera, Camera]:
        """Make the orthographic cameras of the front and the mirrored back map, `size` pixels a side."""
        front, back = (
            Camera.orthographic_view(
                center=np.array(self.center), direction=np.array([0.0, 0.0, z]), half_extent=self.half_extent, size=size
            )
            for z in (1.0, -1.0)
        )
        # The back view's x axis is -x of the world: a negative focal length turns its columns round.
        mirrored = back.K * np.array([[-1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
        return replace(front, name="front"), replace(back, K=mirrored, name="back")

    def pixels_from_canonical(self, points: Float[Tensor, "*P 3"], size: int) -> Float[Tensor, "*P 2"]:
        """Return column and row in pixels, pixel centres at +0.5, of canonical points in metres."""
        x, y = points[..., 0] - self.center[0], points[..., 1] - self.center[1]
        return torch.stack([x, -y], dim=-1) * (0.5 * size / self.half_extent) + 0.5 * size
