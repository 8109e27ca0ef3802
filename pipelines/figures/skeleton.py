"""A body on a photograph: its surface as glass with its outline, and its bones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from smplxpp.core.camera import Camera
from smplxpp.core.colors import srgb8_from_linear
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster.shading import ShadeStyle, shade_layer

BONE, JOINT = (255, 214, 64), (214, 40, 40)
_FINE = 3  # bones are drawn this many times larger and shrunk: smooth lines


def body_on_photograph(
    photograph: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    body: TriangleMesh,
    *,
    color: tuple[int, int, int] = (70, 150, 235),
    opacity: float = 0.45,
) -> UInt8[np.ndarray, "H W 3"]:
    """Lay a shaded body over a photograph, with its outline one pixel wide."""
    style = ShadeStyle(base_color=color, supersampling=1, occlusion=0.0)
    layer = shade_layer(body, camera, style=style)
    shaded = srgb8_from_linear(layer.color).astype(np.float64)
    alpha = (opacity * layer.mask)[..., None]
    out = (1.0 - alpha) * photograph + alpha * shaded
    out[layer.mask & ~binary_erosion(layer.mask, border_value=1)] = color
    return out.round().astype(np.uint8)


def draw_bones(
    picture: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    joints: Float[np.ndarray, "J 3"],
    parents: Int[np.ndarray, " J"],
    *,
    without: Sequence[int] = (),
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw joints and the bones between them; joints behind the camera, and those of `without`, are left out."""
    pixels = camera.screen_from_world(joints)
    shown = pixels[:, 2] > 0
    shown[list(without)] = False
    height, width = picture.shape[:2]
    unit = _FINE * max(1.0, height / 500.0)
    whole = Image.fromarray(picture).resize((_FINE * width, _FINE * height), Image.Resampling.BILINEAR)
    draw, places = ImageDraw.Draw(whole), _FINE * pixels[:, :2]
    for joint, parent in enumerate(parents):
        if parent >= 0 and shown[joint] and shown[parent]:
            draw.line([tuple(places[parent]), tuple(places[joint])], fill=BONE, width=max(1, round(1.6 * unit)))
    for x, y in places[shown]:
        draw.ellipse([x - 2.0 * unit, y - 2.0 * unit, x + 2.0 * unit, y + 2.0 * unit], fill=JOINT)
    return np.asarray(whole.resize((width, height), Image.Resampling.BOX))
