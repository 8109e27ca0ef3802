"""Pictures of splats in another light: by normals that are splatted as colours are (deferred shading)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from avatar.runtime.splatting import WorldSplats
from smplxpp.core.light import Relighting

_AWAY = 0.35
"""Cosine beyond which a surface that turns away shows its inner side: nearer to the outline it is the outer one."""
_FAINT = 1e-3


def facing_normals(
    normals: Float32[np.ndarray, "N 3"], splats: WorldSplats, eye: Float[np.ndarray, " 3"]
) -> Float32[np.ndarray, "N 3"]:
    """Return normals of the side that a point, metres, sees: those that clearly look away belong to the other side."""
    towards = splats.means - np.asarray(eye, dtype=np.float32)
    cosine = np.einsum("nx,nx->n", normals, towards) / np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    return normals * np.where(cosine > _AWAY, np.float32(-1.0), np.float32(1.0))[:, None]


def relit_picture(
    image: Float32[np.ndarray, "H W 3"],
    alpha: Float32[np.ndarray, "H W"],
    normals: Float32[np.ndarray, "H W 3"],
    relighting: Relighting,
    background: tuple[float, float, float],
) -> Float32[np.ndarray, "H W 3"]:
    """Return a picture in another light; the background stays as it is.

    Args:
        image: sRGB on the background. normals: splatted, so that they are shorter where the picture is transparent.
    """
    out = image.copy()
    seen = alpha > _FAINT
    share, behind = alpha[seen][:, None], np.asarray(background, dtype=np.float32)
    own = (image[seen] - (1.0 - share) * behind) / share
    out[seen] = share * relighting.colors(own, normals[seen]) + (1.0 - share) * behind
    return out
