"""How pictures are drawn, as data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ShadeStyle:
    """How surfaces are drawn.

    Attributes:
        base_color: sRGB of surfaces without colours of their own.
        background: sRGB.
        supersampling: samples a pixel along each axis.
        relief: 1 = full light and shadow, 0 = flat colours; lower where colours must be read exactly.
        occlusion: strength of the ambient occlusion, 0 to 1.
        occlusion_radius: metres.
        smooth: interpolate vertex normals (else one normal a face).
        wireframe: draw the faces' edges.
    """

    base_color: tuple[int, int, int] = (206, 200, 192)
    background: tuple[int, int, int] = (255, 255, 255)
    supersampling: int = 2
    relief: float = 1.0
    occlusion: float = 0.85
    occlusion_radius: float = 0.07
    smooth: bool = True
    wireframe: bool = False
