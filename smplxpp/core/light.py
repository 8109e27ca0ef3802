"""Compute diffuse irradiance from an environment by nine spherical harmonics, relight colours, and make panoramas.

Ramamoorthi and Hanrahan, An efficient representation for irradiance environment maps (SIGGRAPH 2001). TaoAvatar shades
its pictures in the same manner: "we use the raw rendered image as the base color and apply shading with new
environment light based on the rendered normal map". The irradiance of the capture is divided out where it is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.core.colors import linear_from_srgb, srgb_from_linear
from smplxpp.core.errors import InputError, require_positive

# Harmonics of the clamped cosine over pi, repeated for the orders of degrees 0, 1 and 2; higher degrees are dropped.
_LOBE = np.repeat([1.0, 2.0 / 3.0, 0.25], [1, 3, 5])


@dataclass(frozen=True, eq=False)
class Irradiance:
    """Irradiance of a diffuse surface over pi, which is the radiance of a white surface in this light.

    Attributes:
        coefficients: real harmonics up to degree 2 of the light's radiance, a column for each of R, G and B.
    """

    coefficients: Float64[np.ndarray, "9 3"]

    def __post_init__(self) -> None:
        values = np.asarray(self.coefficients, dtype=np.float64)
        if values.shape != (9, 3) or not np.isfinite(values).all():
            raise InputError("light", expected="9 x 3 finite coefficients", received=f"shape {values.shape}, or NaN")
        object.__setattr__(self, "coefficients", values)

    @staticmethod
    def uniform(radiance: float = 1.0) -> Irradiance:
        """Return white light of equal radiance in all directions, the assumption for captures of unknown light."""
        coefficients = np.zeros((9, 3))
        coefficients[0] = radiance * np.sqrt(4.0 * np.pi)
        return Irradiance(coefficients)

    @staticmethod
    def of_environment(picture: Float[np.ndarray, "H W 3"], *, turn: float = 0.0) -> Irradiance:
        """Project a panorama, an equirectangular picture in linear light whose first row is the zenith, onto harmonics.

        The middle column is +X and columns go on to +Z, as in glTF's viewers.

        Args:
            turn: rotation of the light about +Y, degrees.

        Raises:
            InputError: negative light, NaN or infinity, or no light at all.
        """
        if not np.isfinite(picture).all() or picture.min(initial=0.0) < 0.0 or not picture.any():
            raise InputError("panorama", expected="finite light, not negative, not all zero", received="others")
        height, width = picture.shape[:2]
        # Solid angle of a pixel: the difference of cos(polar angle) at the row's edges times its width in radians.
        # The solid angles of all pixels sum to 4 pi exactly.
        edges = np.cos(np.linspace(0.0, np.pi, height + 1))
        solid = (edges[:-1] - edges[1:]) * (2.0 * np.pi / width)
        total = np.zeros((9, 3))
        for row in range(height):  # row by row, because panoramas are large
            # (W, 9) harmonics of the row's directions; the coefficients are integrals of light times harmonic.
            of_row = harmonics(panorama_directions(height, width, turn=turn, rows=slice(row, row + 1))[0])
            total += solid[row] * of_row.T @ picture[row].astype(np.float64)
        return Irradiance(total)

    @property
    def mean(self) -> float:
        """Mean luminance of the light over all directions (Rec. 709 weights)."""
        return float(np.array([0.2126, 0.7152, 0.0722]) @ self.coefficients[0] / np.sqrt(4.0 * np.pi))

    def exposed(self, factor: float | None = None) -> Irradiance:
        """Return the light times a factor; None scales it to the mean luminance of white light of radiance 1."""
        if factor is None:
            factor = 1.0 / max(self.mean, 1e-12)
        require_positive("exposure", factor)
        return Irradiance(factor * self.coefficients)

    def at(self, normals: Float[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 3"]:
        """Return the irradiance over pi of surfaces with these unit normals, never negative."""
        return np.maximum(harmonics(normals) @ (_LOBE[:, None] * self.coefficients), 0.0)


def harmonics(directions: Float[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 9"]:
    """Return the real spherical harmonics of degree 0 to 2, orthonormal over the sphere."""
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    one = np.full_like(x, 0.5 / np.sqrt(np.pi))
    a, b, c = np.sqrt(3.0 / (4.0 * np.pi)), np.sqrt(15.0 / (4.0 * np.pi)), np.sqrt(5.0 / (16.0 * np.pi))
    second = [b * x * y, b * y * z, c * (3.0 * z * z - 1.0), b * x * z, 0.5 * b * (x * x - y * y)]
    return np.stack([one, a * y, a * z, a * x, *second], axis=-1)


def panorama_directions(
    height: int, width: int, *, turn: float = 0.0, rows: slice = slice(None)
) -> Float64[np.ndarray, "H W 3"]:
    """Return the unit direction of each pixel centre of an equirectangular picture, +Y up."""
    polar = ((np.arange(height) + 0.5) * np.pi / height)[rows]
    around = ((np.arange(width) + 0.5) / width - 0.5) * 2.0 * np.pi - np.radians(turn)
    level = np.sin(polar)[:, None]
    up = np.broadcast_to(np.cos(polar)[:, None], (len(polar), width))
    return np.stack([level * np.cos(around), up, level * np.sin(around)], axis=-1)


@dataclass(frozen=True, eq=False)
class Relighting:
    """Replacement of the light of a capture by another light.

    Attributes:
        light: new light.
        captured: light of the photographs.
    """

    light: Irradiance
    captured: Irradiance

    def factor(self, normals: Float[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 3"]:
        """Return the factor of linear colours of surfaces with these normals; 1 where a normal is zero."""
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        unit = normals / np.maximum(length, 1e-9)
        # Floor of the captured irradiance: darker surfaces hold more noise than colour.
        darkest = 0.02
        change = self.light.at(unit) / np.maximum(self.captured.at(unit), darkest)
        return np.where(length > 1e-6, change, 1.0)

    def colors(
        self, srgb: Float[np.ndarray, "*N 3"], normals: Float[np.ndarray, "*N 3"]
    ) -> Float64[np.ndarray, "*N 3"]:
        """Return sRGB colours in [0, 1] under the new light, clipped at white."""
        linear = linear_from_srgb(np.clip(srgb, 0.0, 1.0)) * self.factor(normals)
        return srgb_from_linear(np.minimum(linear, 1.0))


STUDIO = "two lamps"
"""Name of the panorama with two studio lamps in `panoramas()`."""


def panoramas(height: int = 64) -> dict[str, Float64[np.ndarray, "H W 3"]]:
    """Return synthetic panoramas in linear light by name, twice as wide as high: low sun, wood, two studio lamps.

    They serve as lights where none is given, and as known truth in measurements of relighting.
    """
    towards = panorama_directions(height, 2 * height)

    def lamp(place: tuple[float, float, float], color: tuple[float, float, float], sharp: float) -> np.ndarray:
        middle = np.array(place) / np.linalg.norm(place)
        return np.exp(sharp * (towards @ middle - 1.0))[..., None] * np.array(color)

    above = np.maximum(towards[..., 1:2], 0.0)
    return {
        "low sun": 0.12 * np.array([0.5, 0.6, 1.0]) + lamp((1.0, 0.25, 0.35), (9.0, 4.2, 1.4), 8.0),
        "wood": np.array([0.12, 0.1, 0.05]) + np.array([0.5, 0.9, 0.45]) * (above > 0) * (0.3 + 1.5 * above**2),
        STUDIO: 0.05 + lamp((0.7, 0.5, 0.8), (6.0, 6.0, 6.0), 12.0) + lamp((-0.8, 0.3, -0.4), (1.0, 2.0, 5.0), 12.0),
    }
