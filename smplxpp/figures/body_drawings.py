"""Draw keypoints and bodies on photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.core.colors import srgb8_from_linear
from smplxpp.figures.colors import heat_colors
from smplxpp.figures.sheets import color_bar
from smplxpp.raster.shading import ShadeStyle, render_shaded, shade_layer

LEFT, RIGHT, MIDDLE = (52, 130, 246), (232, 64, 52), (250, 205, 50)
"""Colours of the person's own left and right, and of what is on neither side."""
_FINE = 3  # supersampling of discs and lines, against jagged edges
_RADIUS, _SMALL = 1 / 160, 1 / 400  # of the picture's longer side; points of hands and face are small


def draw_keypoints(
    picture: UInt8[np.ndarray, "H W 3"],
    names: Sequence[str],
    points: Float[np.ndarray, "K 2"],
    confidence: Float[np.ndarray, " K"],
    *,
    least: float = 0.3,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw points with a confidence of at least `least` as discs, fainter for lower confidence."""
    height, width = picture.shape[:2]
    # Draw at a multiple of the size and reduce by the mean of the pixels, which smooths the edges (supersampling).
    size = (_FINE * width, _FINE * height)
    whole = Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR).convert("RGBA")
    layer = Image.new("RGBA", size)
    draw = ImageDraw.Draw(layer)
    for name, (x, y), certainty in zip(names, _FINE * np.asarray(points), confidence, strict=True):
        if certainty < least:
            continue
        # Left, right and middle have colours of their own, so that exchanged sides are seen at once. Fingers and toes
        # are drawn smaller than limbs.
        color = LEFT if "left_" in name else RIGHT if "right_" in name else MIDDLE
        share = _SMALL if name[-1].isdigit() or name.endswith("_tip") else _RADIUS
        radius = share * max(size)
        box = [x - radius, y - radius, x + radius, y + radius]
        draw.ellipse(box, fill=(*color, round(80 + 175 * min(float(certainty), 1.0))))
    drawn = Image.alpha_composite(whole, layer).convert("RGB")
    return np.asarray(drawn.resize((width, height), Image.Resampling.BOX))


BONE, JOINT = (255, 214, 64), (214, 40, 40)


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
    # The third value is the depth along the optical axis; points with a negative one are behind the camera.
    pixels = camera.screen_from_world(joints)
    shown = pixels[:, 2] > 0
    shown[list(without)] = False
    height, width = picture.shape[:2]
    # Line widths grow with the picture, from one pixel at a height of 500.
    unit = _FINE * max(1.0, height / 500.0)
    whole = Image.fromarray(picture).resize((_FINE * width, _FINE * height), Image.Resampling.BILINEAR)
    draw, places = ImageDraw.Draw(whole), _FINE * pixels[:, :2]
    for joint, parent in enumerate(parents):
        if parent >= 0 and shown[joint] and shown[parent]:
            draw.line([tuple(places[parent]), tuple(places[joint])], fill=BONE, width=max(1, round(1.6 * unit)))
    for x, y in places[shown]:
        draw.ellipse([x - 2.0 * unit, y - 2.0 * unit, x + 2.0 * unit, y + 2.0 * unit], fill=JOINT)
    return np.asarray(whole.resize((width, height), Image.Resampling.BOX))


def render_heat(
    mesh: TriangleMesh,
    camera: Camera,
    values: Float[np.ndarray, " K"],
    *,
    cmap: str = "error",
    limits: tuple[float, float],
    unit: str = "",
    bar: bool = True,
    style: ShadeStyle | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a mesh coloured by values, one a vertex or one a face, with a colour bar on the right.

    Values outside `limits` take the end colours, values that are not finite are grey. Vertex values are interpolated
    after colouring, so a picture is exact at vertices only.
    """
    # Light and shadow are held back: the colour is the message.
    style = style or ShadeStyle(relief=0.55)
    values = np.asarray(values, dtype=np.float64)
    if values.shape not in ((mesh.vertex_count,), (mesh.face_count,)):
        raise InputError(
            "values of a heat map",
            expected=f"shape ({mesh.vertex_count},) or ({mesh.face_count},)",
            received=f"shape {values.shape}",
        )
    colors = heat_colors(values, cmap=cmap, limits=limits)
    of_vertices = len(values) == mesh.vertex_count
    picture = render_shaded(
        mesh,
        camera,
        style=replace(style),
        vertex_colors=colors if of_vertices else None,
        face_colors=None if of_vertices else colors,
    )
    if not bar:
        return picture
    side = color_bar(cmap=cmap, limits=limits, unit=unit, height=len(picture), background=style.background)
    return np.concatenate([picture, side], axis=1)
