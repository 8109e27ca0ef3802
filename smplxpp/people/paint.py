"""Paint procedural people: skin tones, dyed and patterned cloth, hair, and the light and grain of a coloured scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from smplxpp.core.mesh import TriangleMesh
from smplxpp.people import textures
from smplxpp.people.fixture_person import face_landmarks, face_marks
from smplxpp.people.textures import Color, band, mix, smooth_noise
from smplxpp.raster.soft_light import LightConfig, bounced, vertex_light

SKIN_TONES: dict[str, Color] = {
    "pale": (240, 208, 192),
    "light": (222, 176, 150),
    "olive": (198, 152, 116),
    "tan": (172, 122, 88),
    "brown": (128, 84, 58),
    "dark": (82, 54, 42),
}
HAIR_COLORS: dict[str, Color] = {
    "black": (34, 28, 26),
    "brown": (74, 46, 28),
    "blond": (196, 158, 96),
    "red": (142, 66, 30),
    "grey": (150, 148, 146),
    "white": (222, 218, 212),
}
DYES: dict[str, Color] = {
    "white": (236, 234, 228),
    "black": (36, 36, 40),
    "grey": (128, 130, 134),
    "navy": (36, 46, 84),
    "blue": (58, 98, 170),
    "denim": (74, 98, 134),
    "red": (176, 42, 46),
    "wine": (104, 30, 46),
    "green": (58, 116, 70),
    "olive": (104, 104, 66),
    "yellow": (226, 188, 66),
    "pink": (224, 150, 168),
    "purple": (104, 66, 130),
    "beige": (214, 180, 150),
    "camel": (178, 134, 92),
    "brown": (104, 72, 50),
    "teal": (40, 122, 128),
    "orange": (218, 116, 44),
}
PATTERNS = ("plain", "stripes", "pinstripes", "check", "dots", "blotches", "print")


@dataclass(frozen=True)
class Dye:
    """Colours and pattern of a layer.

    Attributes:
        color: name in `DYES`, or in `HAIR_COLORS` for hair.
        pattern: one of `PATTERNS`.
        second: name in `DYES` of the pattern's second colour.
    """

    color: str
    pattern: str = "plain"
    second: str = "white"


def skin_paint(
    points: Float[np.ndarray, "P 3"],
    eyes: Float[np.ndarray, "2 3"],
    eyeball: Bool[np.ndarray, " P"],
    *,
    tone: str,
    betas: Float[np.ndarray, " B"],
    seed: int,
) -> Float[np.ndarray, "P 3"]:
    """Return colours of skin and face at points on the T-pose.

    Args:
        points: metres.
        eyes: centres of the eyeballs.
        eyeball: which points lie on an eyeball.
        tone: name in `SKIN_TONES`.
        betas: shape coefficients, which place the face's landmarks.
        seed: seed of the skin's mottling.
    """
    colors = textures.skin_colors(points, face_marks(face_landmarks(betas)), seed=seed)
    # Scale the fixture's skin to the tone, then paint the eyeballs over it.
    colors *= np.asarray(SKIN_TONES[tone]) / np.asarray(textures.SKIN, dtype=float)
    nearer = np.argmin(np.linalg.norm(points[eyeball][:, None] - eyes, axis=2), axis=1)
    colors[eyeball] = textures.eye_colors(points[eyeball] - eyes[nearer])
    return colors


def hair_paint(points: Float[np.ndarray, "P 3"], color: str, *, seed: int) -> Float[np.ndarray, "P 3"]:
    """Return colours of hair: strands along its fall, lighter and darker."""
    # Locks of 8 mm and strands of 2 mm, long in the direction of the fall.
    locks = smooth_noise(points, scale=(0.008, 0.3, 0.008), seed=seed)
    strands = smooth_noise(points, scale=(0.002, 0.12, 0.002), seed=seed + 1)
    return np.asarray(HAIR_COLORS[color]) * (1.0 + 0.16 * locks + 0.12 * strands)[:, None]


def cloth_paint(points: Float[np.ndarray, "P 3"], dye: Dye, *, seed: int) -> Float[np.ndarray, "P 3"]:
    """Return colours of dyed cloth at points on the T-pose, 0 to 255."""
    # Lengths along the garment (along the arms on sleeves) and around the trunk, metres.
    x, y, z = points.T
    rng = np.random.default_rng(seed)
    along = np.where((np.abs(x) > 0.24) & (y > 0.4), np.abs(x), y)
    around = np.arctan2(x, z - 0.03) * 0.18
    if dye.pattern == "stripes":
        share = band(along, period=rng.uniform(0.035, 0.07), width=0.018)
    elif dye.pattern == "pinstripes":
        share = band(around, period=0.024, width=0.005)
    elif dye.pattern == "check":
        share = 0.5 * (band(along, period=0.07, width=0.03) + band(around, period=0.07, width=0.03))
    elif dye.pattern == "dots":
        share = band(along, period=0.05, width=0.018) * band(around, period=0.05, width=0.018)
    elif dye.pattern == "blotches":
        share = 1.0 * (smooth_noise(points, scale=(0.035, 0.035, 0.035), seed=seed) > 0.2)
    elif dye.pattern == "print":
        share = 1.0 * ((np.hypot(x, y - 0.44) < 0.085) & (z > 0.03))
    else:
        share = np.zeros(len(points))
    # Worn patches and the grain of the weave; denim is worn most.
    patches = smooth_noise(points, scale=(0.06, 0.06, 0.06), seed=seed + 1)
    weave = smooth_noise(points, scale=(0.004, 0.008, 0.004), seed=seed + 2)
    wear = 0.10 if dye.color == "denim" else 0.035
    return mix(DYES[dye.color], DYES[dye.second], share) * (1 + wear * patches + 0.03 * weave)[:, None]


def photographed(
    mesh: TriangleMesh, albedo: Float[np.ndarray, "N 3"], *, rng: np.random.Generator
) -> UInt8[np.ndarray, "N 3"]:
    """Return sRGB vertex colours as a scanner bakes them: soft light from above and one side, and grain."""
    # Gamma 2.2; ambient light with the shadows that the person casts on herself, and one side brighter.
    linear = (np.clip(albedo, 0, 255) / 255.0) ** 2.2
    light = np.clip(vertex_light(mesh, LightConfig(directions=40, resolution=256))[0], 0.04, None)
    side = rng.normal(size=3) * [1.0, 0.3, 1.0]
    light = light * (1.0 + 0.22 * mesh.vertex_normals @ (side / np.linalg.norm(side)))
    colors = 255.0 * np.clip(bounced(light, linear), 0, 1) ** (1 / 2.2)
    # Sensor noise of 2.5 levels in each channel, and as much that all three share.
    colors += 2.5 * (rng.normal(size=colors.shape) + rng.normal(size=(len(colors), 1)))
    return np.clip(colors, 0, 255).round().astype(np.uint8)
