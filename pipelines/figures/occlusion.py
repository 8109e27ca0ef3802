"""Ambient occlusion from a depth map: folds, armpits and hems read as depth instead of as flat colour."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from pipelines.figures.style import ShadeStyle
from smplxpp.core.camera import Camera
from smplxpp.raster.zbuffer import MeshMaps

_SAMPLES = 16
_BIAS = np.float32(0.002)  # metres: below it lie the depth map's own steps
_GAIN = 3.0
_FAR = np.float32(1e6)
_GOLDEN_ANGLE = np.pi * (3.0 - 5.0**0.5)


def unoccluded(
    maps: MeshMaps, camera: Camera, normals_at: Callable[[np.ndarray], np.ndarray], *, style: ShadeStyle
) -> Float32[np.ndarray, "H W"]:
    """Return the share of the surroundings that each output pixel sees, 1 on the background.

    `maps` and `camera` are supersampled; the first sample of each output pixel stands for all of them.

    With v the vector to a neighbour at distance |v| < r and n the normal,
    `A = 1 - strength * gain * mean(max(0, v.n - bias) / |v| * (1 - |v|^2 / r^2))` over one fixed spiral of
    neighbours: the obscurance of McGuire et al., "The Alchemy Screen-Space Ambient Obscurance Algorithm" (2011),
    with a smooth falloff.
    """
    s = style.supersampling
    face = maps.face_id[::s, ::s]
    seen = np.ones(face.shape, np.float32)
    pixels = np.flatnonzero(face.ravel() >= 0)
    if style.occlusion <= 0.0 or not len(pixels):
        return seen
    row, col = np.divmod(pixels, face.shape[1])
    normal = normals_at(row * s * camera.width + col * s)
    depth = np.where(face >= 0, maps.depth[::s, ::s], _FAR)
    z = depth.ravel()[pixels]
    focal = camera.K[0, 0] / s
    reach = style.occlusion_radius * focal / (1.0 if camera.orthographic else float(np.median(z)))
    pad = int(np.ceil(reach))
    padded = np.pad(depth, pad, constant_values=_FAR)
    center = (row + pad) * padded.shape[1] + col + pad
    flat = padded.ravel()
    x = ((col + 0.5 - camera.K[0, 2] / s) / focal).astype(np.float32)
    y = ((row + 0.5 - camera.K[1, 2] / s) / focal).astype(np.float32)
    nx, ny, nz = np.ascontiguousarray(normal.T)
    inverse_r2 = np.float32(1.0 / style.occlusion_radius**2)
    total = np.zeros(len(pixels), np.float32)
    for k in range(_SAMPLES):
        radius, angle = reach * np.sqrt((k + 0.5) / _SAMPLES), _GOLDEN_ANGLE * k
        dx, dy = round(radius * np.cos(angle)), round(radius * np.sin(angle))
        step_x, step_y = np.float32(dx / focal), np.float32(dy / focal)
        zk = flat.take(center + (dy * padded.shape[1] + dx))
        vz = zk - z
        if camera.orthographic:
            vx, vy = step_x, step_y
        else:
            vx, vy = x * vz + step_x * zk, y * vz + step_y * zk
        v2 = vx * vx + vy * vy + vz * vz
        along = np.maximum(vx * nx + vy * ny + vz * nz - _BIAS, 0.0)
        total += along * np.maximum(1.0 - v2 * inverse_r2, 0.0) / np.sqrt(v2 + np.float32(1e-6))
    seen.ravel()[pixels] = np.clip(1.0 - style.occlusion * _GAIN / _SAMPLES * total, 0.0, 1.0)
    return seen
