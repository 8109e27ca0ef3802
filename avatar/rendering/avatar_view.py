"""Render a posed avatar from one camera of a capture, with gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.rendering.api import rasterize
from smplxpp.core import Camera, InputError
from smplxpp.core.errors import one_line

if TYPE_CHECKING:
    from avatar.data.views import View
    from avatar.rig.rig import PosedAvatar


@dataclass(frozen=True, eq=False)
class Rendering:
    """The image of one camera, and its further channels.

    Attributes:
        image: sRGB on the background, not clamped.
        alpha: opacity of the image.
        normals: blended world normals, 0 on the background; None if not requested.
        extra: blended further values of the Gaussians; None without them.
    """

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    normals: Float[Tensor, "H W 3"] | None = None
    extra: Float[Tensor, "H W D"] | None = None

    __repr__ = one_line


def render_view(
    posed: PosedAvatar,
    index: int,
    view: View | Camera,
    background: Float[Tensor, " 3"],
    *,
    eps2d: float = 0.1,
    normals: bool = False,
    extra: Float[Tensor, "N D"] | None = None,
) -> Rendering:
    """Rasterise camera `index` of the posed avatar's C, through the pixels of `view`, with gradients.

    Args:
        posed: the avatar, with the colours of C cameras.
        index: of the camera among them.
        view: a photograph's camera, or a camera alone.
        background: colour behind the person; normals and extra values are 0 there.
        eps2d: see `rasterize`.
        normals: also draw the Gaussians' normals.
        extra: D further values a Gaussian to draw.
    """
    # Colours, normals and extra values are channels of one rasterisation.
    world = posed.gaussians
    camera, viewmat, intrinsics = _camera_of(view, world.means)
    features = [posed.colors[index]]
    if normals:
        features.append(world.normals)
    if extra is not None:
        features.append(extra)
    # The background's colour fills the first three channels; further channels are 0 there.
    channels = torch.cat(features, dim=-1) if len(features) > 1 else features[0]
    behind = torch.nn.functional.pad(background, (0, channels.shape[-1] - 3))
    # Values are not checked here: the model and the capture have been, and a training draws many views a second.
    image, alpha, _ = rasterize(
        world.means,
        world.quats,
        world.scales,
        world.opacities,
        channels[None],
        viewmat[None],
        intrinsics[None],
        camera.width,
        camera.height,
        background=behind,
        eps2d=eps2d,
        check=False,
    )
    # Split the channels again, in the order in which they were joined.
    image = image[0]
    return Rendering(
        image[..., :3],
        alpha[0, ..., 0],
        image[..., 3:6] if normals else None,
        None if extra is None else image[..., 3 + 3 * normals :],
    )


def _camera_of(view: View | Camera, like: Tensor) -> tuple[Camera, Float[Tensor, "4 4"], Float[Tensor, "3 3"]]:
    """Return the camera of a view, its `cam_from_world` and its intrinsics in pixels, on the device of `like`.

    Raises:
        InputError: an orthographic camera.
    """
    if not isinstance(view, Camera):
        return view.camera, view.viewmat, view.K
    if view.orthographic:
        raise InputError(f"camera {view.name!r}", expected="a pinhole camera", received="an orthographic one")
    cam_from_world, intrinsics = (
        torch.tensor(matrix, dtype=torch.float32, device=like.device) for matrix in (view.cam_from_world, view.K)
    )
    return view, cam_from_world, intrinsics
