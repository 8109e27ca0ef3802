"""An avatar in a pose through a camera as a picture, whether it is a trained model or a player of a bundle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from avatar.runtime import AvatarPlayer
from smplxpp.core import BodyParams, Camera

if TYPE_CHECKING:
    from avatar.rig.rig import AvatarModel


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

    from avatar.rendering.avatar_view import render_view
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
