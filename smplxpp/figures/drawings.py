"""Draw keypoints and bodies on photographs, heat maps of meshes, and renderings with their error beside photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.core.colors import srgb8_from_linear
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.image_file import open_image
from smplxpp.figures.colors import colormap, heat_colors
from smplxpp.figures.sheets import caption, color_bar, encode_png, row
from smplxpp.metrics import point_to_surface
from smplxpp.raster import body_cameras
from smplxpp.raster.shading import ShadeStyle, render_shaded, shade_layer

LEFT, RIGHT, MIDDLE = (52, 130, 246), (232, 64, 52), (250, 205, 50)
"""Colours of the person's own left and right, and of what is on neither side."""
_FINE = 3  # supersampling of discs and lines, against jagged edges
_RADIUS, _SMALL = 1 / 160, 1 / 400  # of the picture's longer side; points of hands and face are small
ERROR_LIMIT = 64
"""Difference of the worst channel, of 255, that the error's colours end at."""


Picture = UInt8[np.ndarray, "H W 3"]


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


def error_colors(real: Picture, rendered: Picture) -> Picture:
    """Colour the largest difference of a channel at every pixel: pale where it is 0, dark from `ERROR_LIMIT` on."""
    worst = np.abs(real.astype(np.int16) - rendered.astype(np.int16)).max(axis=-1)
    return heat_colors(worst.ravel().astype(np.float64), cmap="error", limits=(0.0, ERROR_LIMIT)).reshape(real.shape)


def error_legend(width: int = 384, height: int = 18) -> Picture:
    """Draw the error's colours from 0 on the left to `ERROR_LIMIT`."""
    ramp = colormap("error")[np.linspace(0, 255, width).round().astype(int)]
    return np.repeat(ramp[None], height, axis=0)


def write_strip(path: Path, real: Picture, rendered: Picture) -> None:
    """Write photograph, rendering and error as one PNG of three times the width."""
    strip = np.concatenate([real, rendered, error_colors(real, rendered)], axis=1)
    atomic_write_bytes(path, encode_png(strip))


def read_strip(path: Path) -> tuple[Picture, Picture, Picture]:
    """Read photograph, rendering and error of a strip."""
    strip = np.asarray(open_image(path, subject="picture").convert("RGB"))
    width = strip.shape[1] // 3
    return strip[:, :width], strip[:, width : 2 * width], strip[:, 2 * width :]


def enlarge(image: UInt8[np.ndarray, "_ _ 3"], factor: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Draw every pixel as a square of `factor` pixels: nothing is smoothed away."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


SURFACE_HEIGHT = 480
SURFACE_LIMIT_MM = 40.0
"""Distance that the colours of posed meshes end at."""


def write_tiles(path: Path, truth: UInt8[np.ndarray, "H W 3"], rendered: Sequence[UInt8[np.ndarray, "H W 3"]]) -> None:
    """Write photograph, renderings and the last one's error side by side as one PNG."""
    tiles = [truth, *rendered, error_colors(truth, rendered[-1])]
    atomic_write_bytes(path, encode_png(np.concatenate(tiles, axis=1)))


def read_tiles(path: Path, count: int) -> tuple[UInt8[np.ndarray, "H W 3"], list[UInt8[np.ndarray, "H W 3"]]]:
    """Read photograph and `count` renderings of a picture that `write_tiles` wrote."""
    strip = np.asarray(open_image(path, subject="picture").convert("RGB"))
    truth, *rendered, _ = np.split(strip, count + 2, axis=1)
    return truth, rendered


def surface_picture(truth: TriangleMesh, posed: Mapping[str, TriangleMesh]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw each posed mesh from the front and the back, coloured by its distance to the truth."""
    cameras = body_cameras(truth, views=("front", "back"), height=SURFACE_HEIGHT)
    panels = []
    for name, mesh in posed.items():
        distance = 1e3 * point_to_surface(mesh.vertices, truth)[0]
        last = name == list(posed)[-1]
        pictures = [
            render_heat(
                mesh, camera, distance, limits=(0.0, SURFACE_LIMIT_MM), unit="mm", bar=last and camera is cameras[-1]
            )
            for camera in cameras
        ]
        panels.append(caption(row(pictures, gap=0), name))
    return row(panels)
