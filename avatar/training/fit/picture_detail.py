"""Where photographs change quickly: more Gaussians belong there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy.ndimage import minimum_filter, sobel
from scipy.spatial import cKDTree

from avatar.data.views import View
from smplxpp.template.template import Template

NEIGHBOURS = 16
"""Places whose changes are averaged."""


def changes(view: View) -> View:
    """Return a view whose colours are how fast the photograph's change, a pixel, off the silhouette's edge.

    `sqrt((dI/dx)^2 + (dI/dy)^2)` of each colour by Sobel's filter. Pixels that the filter would compare with the
    background are no longer the person's.
    """
    image = view.foreground.cpu().numpy().astype(np.float64)
    # Each colour alone: the filter smooths across all axes but its own. It gives 8 for a slope of 1.
    rate = np.stack([np.hypot(sobel(one, 0), sobel(one, 1)) / 8.0 for one in np.moveaxis(image, 2, 0)], axis=2)
    alpha = minimum_filter(view.alpha.cpu().numpy(), 3)
    return replace(
        view,
        foreground=torch.tensor(rate.round().clip(0, 255).astype(np.uint8)),
        alpha=torch.tensor(alpha),
        normals=None,
    )


def density_of_detail(
    template: Template,
    face_index: Int[np.ndarray, " N"],
    rates: Float[np.ndarray, "N 3"],
    seen: Bool[np.ndarray, " N"],
    detail: float,
) -> Float64[np.ndarray, " F"]:
    """Return how densely each face is to be covered: `1 + detail g / G`.

    g is the root mean square of the changes at the places nearest to the face that some view saw, of the same part, G
    that of all places that some view saw. A
    Gaussian draws a patch of about one colour: over a surface that changes by g a metre, `1 / rho` a Gaussian, its mean
    squared error goes with `g^2 / rho`, whose sum over a given number of Gaussians is least where rho goes with g. The
    1 keeps what looks plain in one frame and one light from going bare.

    Args:
        face_index: faces where the photographs were looked at. rates: how fast their colours change there.
        seen: whether any photograph shows the place.
        detail: 0 covers all faces alike.
    """
    weight = np.ones(len(template.faces))
    square = np.square(rates).sum(1)
    usual = np.sqrt(square[seen].mean()) if seen.any() else 0.0
    if not usual:
        return weight
    centers = template.mesh.triangles.mean(1)
    of_face = template.vertex_part[template.faces[:, 0]]
    for one in np.unique(of_face):
        known = seen & (of_face[face_index] == one)
        known = known if known.any() else seen
        places = cKDTree(centers[face_index[known]])
        _, nearest = places.query(centers[of_face == one], k=[*range(1, min(NEIGHBOURS, places.n) + 1)])
        weight[of_face == one] += detail * np.sqrt(square[known][nearest].mean(1)) / usual
    return weight
