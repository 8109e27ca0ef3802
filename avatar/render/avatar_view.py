"""A posed avatar drawn as one camera of a capture sees it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from avatar.render.api import rasterize

if TYPE_CHECKING:
    from avatar.data.views import View
    from avatar.rig.posed import PosedAvatar


@dataclass(frozen=True, eq=False)
class Rendering:
    """What one camera sees.

    Attributes:
        image: (H, W, 3) sRGB on the background, not clamped. alpha: (H, W).
        normals: (H, W, 3) blended world normals, 0 where nothing is; None if not asked for.
        extra: (H, W, D) blended values of the Gaussians; None if there were none.
    """

    image: Tensor
    alpha: Tensor
    normals: Tensor | None = None
    extra: Tensor | None = None


def render_view(
    posed: PosedAvatar,
    index: int,
    view: View,
    background: Tensor,
    *,
    eps2d: float = 0.1,
    normals: bool = False,
    extra: Tensor | None = None,
) -> Rendering:
    """Rasterise camera `index` of the posed avatar's C, through the pixels of `view`, with gradients.

    Args:
        background: (3,) behind the person; normals and extra values have 0 there.
        eps2d: see `rasterize`.
        normals: draw the Gaussians' normals too. extra: (N, D) more values a Gaussian.
    """
    world = posed.gaussians
    features = [posed.colors[index]]
    if normals:
        features.append(world.normals)
    if extra is not None:
        features.append(extra)
    channels = torch.cat(features, dim=-1) if len(features) > 1 else features[0]
    behind = torch.nn.functional.pad(background, (0, channels.shape[-1] - 3))
    image, alpha, _ = rasterize(
        world.means,
        world.quats,
        world.scales,
        world.opacities,
        channels[None],
        view.viewmat[None],
        view.K[None],
        view.camera.width,
        view.camera.height,
        background=behind,
        eps2d=eps2d,
        check=False,
    )
    image = image[0]
    return Rendering(
        image[..., :3],
        alpha[0, ..., 0],
        image[..., 3:6] if normals else None,
        None if extra is None else image[..., 3 + 3 * normals :],
    )
