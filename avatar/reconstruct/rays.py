"""Rays through pixels that the hull covers, and unbiased volume rendering of a signed distance along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from smplxpp.core import InputError, TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct import PhotoView


@dataclass(frozen=True, eq=False)
class Rays:
    """N rays with the colour and opacity of their pixels.

    Attributes:
        origin: centre of projection in the world, metres.
        direction: unit vector in the world.
        enter: metres to the hull.
        color: of the pixel, sRGB in [0, 1].
        opacity: of the person.
    """

    origin: Float[Tensor, "N 3"]
    direction: Float[Tensor, "N 3"]
    enter: Float[Tensor, " N"]
    color: Float[Tensor, "N 3"]
    opacity: Float[Tensor, " N"]

    def __len__(self) -> int:
        return len(self.origin)

    def select(self, rows: Tensor) -> Rays:
        """Return the rays of chosen rows."""
        return Rays(self.origin[rows], self.direction[rows], self.enter[rows], self.color[rows], self.opacity[rows])


def rays_of(views: Sequence[PhotoView], hull: TriangleMesh, device: torch.device | str) -> Rays:
    """Return the rays of all pixels that the hull covers; the masks exclude all others.

    Raises:
        InputError: the hull is in no photograph.
    """
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("origin", "direction", "enter", "color", "opacity")}
    for view in views:
        # Pixels of the hull, their directions in the world, and the distance along the ray to the hull.
        depth = rasterize_mesh(hull, view.camera).depth
        row, column = np.nonzero(np.isfinite(depth))
        # Homogeneous pixel centres (R, 3); K^-1 turns them into directions with z = 1 in camera axes (OpenCV's).
        pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)
        in_camera = pixels @ np.linalg.inv(view.camera.K).T
        length = np.linalg.norm(in_camera, axis=1)
        # Rows times R is R^T times columns: the inverse of the camera's rotation. Depths are along z, so metres along
        # the
        # ray are depth times the length of its direction with z = 1.
        parts["direction"].append(in_camera / length[:, None] @ view.camera.cam_from_world[:3, :3])
        parts["origin"].append(np.broadcast_to(view.camera.position, (len(row), 3)))
        parts["enter"].append(depth[row, column] * length)
        parts["color"].append(view.color[row, column] / 255.0)
        parts["opacity"].append(view.opacity[row, column] / 255.0)
    if not sum(map(len, parts["enter"])):
        raise InputError("photographs", expected="some that show the hull", received="none")
    tensors = {
        name: torch.from_numpy(np.concatenate(values).astype(np.float32)).to(device) for name, values in parts.items()
    }
    return Rays(**tensors)


def opacities(distance: Float[Tensor, "R S"], sharpness: Float[Tensor, ""]) -> Float[Tensor, "R T"]:
    """Return the opacity of each interval between samples, `max((s_i - s_{i+1}) / s_i, 0)`, s the logistic of f.

    Wang et al. (2021), "NeuS": unbiased at the zero of the distance f.
    """
    # s falls from 1 outside to 0 inside; the drop between samples, relative to s, is the opacity. Rising s (a ray
    # that
    # leaves the body) is clamped to 0, and the lower bound keeps the quotient finite deep inside.
    at = torch.sigmoid(distance * sharpness)
    return ((at[:, :-1] - at[:, 1:]) / at[:, :-1].clamp(min=1e-6)).clamp(0, 1)


def weights_of(opacity: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """Return the weight of each interval in the pixel: its opacity times the transmittance before it."""
    # Transmittance behind each interval; the small term keeps the product's gradient finite at an opacity of 1.
    through = torch.cumprod(1 - opacity + 1e-7, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    return opacity * before
