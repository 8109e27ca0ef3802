"""Define the settings of every rasteriser backend, and its results besides the image."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from smplxpp.core.errors import one_line

# Rules of 3D Gaussian Splatting, the same in all backends and kernels.
ALPHA_MAX = 0.999
"""Opacity of one Gaussian at a pixel is clamped to this."""
ALPHA_MIN = 1.0 / 255.0
"""A Gaussian fainter than this at a pixel is skipped there."""
TRANSMITTANCE_MIN = 1e-4
"""Blending stops before the Gaussian that would bring the transmittance to this or below."""


@dataclass(frozen=True)
class RasterSettings:
    """Image size and constants of a rasterisation, the same for every camera of the batch.

    Attributes:
        width: pixels.
        height: pixels.
        near: metres along the camera's z; Gaussians with a nearer centre are dropped.
        far: metres along the camera's z; Gaussians with a farther centre are dropped.
        eps2d: pixels squared, added to the diagonal of the projected covariance (the low-pass filter of 3DGS).
        camera_gradients: whether `viewmats` get gradients.
    """

    width: int
    height: int
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    camera_gradients: bool = False


@dataclass(frozen=True)
class RasterMeta:
    """Intermediate results of a backend, without gradients except for `depth`.

    Attributes:
        means2d: projected centres in pixels; 0 where culled.
        radii: half width and height in pixels of the box that can reach `ALPHA_MIN` (gsplat rounds them up);
            0 where culled.
        depths: metres along the camera's z, of culled Gaussians too.
        depth: accumulated or expected depth in metres, if requested.
    """

    means2d: Float[Tensor, "C N 2"]
    radii: Float[Tensor, "C N 2"]
    depths: Float[Tensor, "C N"]
    depth: Float[Tensor, "C H W 1"] | None = None

    __repr__ = one_line

    @property
    def visible(self) -> Bool[Tensor, "C N"]:
        """Mask of the Gaussians that can reach a pixel of the image."""
        return (self.radii > 0).all(-1)
