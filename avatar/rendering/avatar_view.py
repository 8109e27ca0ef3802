"""Render a posed avatar from one camera: with gradients in a view of a capture, and as a finished picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.rendering.api import rasterize
from avatar.runtime import AvatarPlayer
from smplxpp.core import BodyParams, Camera, InputError
from smplxpp.core.errors import one_line

if TYPE_CHECKING:
    from avatar.data.views import View
    from avatar.rig.rig import AvatarModel, PosedAvatar


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


def render(
    avatar: AvatarModel | AvatarPlayer,
    params: BodyParams,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    frame: int | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw an avatar in a pose as a camera sees it.

    Loose clothes are where the student's field has them: a simulation needs a motion (`AvatarPlayer.step`).

    Args:
        avatar: a student, another trained model, or a player of a bundle.
        params: one frame; its shape is not used, since the avatar has one.
        camera: a pinhole camera; no photograph is needed.
        background: sRGB in [0, 1] behind the person.
        frame: number of the training frame whose code a student takes; None: a new pose.

    Returns:
        sRGB.

    Raises:
        InputError: several frames, parameters of another body, or an orthographic camera.

    Example:
        >>> image = avatar.render(student, capture.params(0), capture.cameras["Cam005"], background=(1, 1, 1))
    """
    # A player poses and draws without torch; a trained model needs torch and its rasteriser.
    if isinstance(avatar, AvatarPlayer):
        avatar.pose(params, frame=frame)
        drawn, _ = avatar.draw(camera, background=background)
        return _eight_bit(drawn)
    import torch  # players are drawn without it

    from avatar.rig.rig import at_rest

    # Colours depend on the view, so that the model is posed for the camera's centre of projection.
    device = avatar.rig.device
    center = torch.tensor(camera.position, dtype=torch.float32, device=device)
    behind = torch.tensor(background, dtype=torch.float32, device=device)
    with at_rest(avatar):
        posed = avatar(avatar.rig.pose(params, frame=frame), center[None])
        return _eight_bit(render_view(posed, 0, camera, behind).image.cpu().numpy())


def _eight_bit(image: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
