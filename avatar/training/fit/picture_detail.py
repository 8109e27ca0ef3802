"""Density of Gaussians from the gradient magnitude of the photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy.ndimage import minimum_filter, sobel
from scipy.spatial import cKDTree

from avatar.data.views import View
from smplxpp.template.template import Template


def changes(view: View) -> View:
    """Return a view whose colours are the photograph's gradient magnitudes, a pixel, inside the eroded mask.

    `sqrt((dI/dx)^2 + (dI/dy)^2)` of each colour by the Sobel filter. The mask is eroded by the pixels that the filter
    would compare with the background.
    """
    image = view.foreground.cpu().numpy().astype(np.float64)
    # Each colour on its own, because the filter smooths along all other axes. Its response to a slope of 1 is 8.
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
    """Return the relative density of Gaussians on each face, `1 + detail g / G`.

    g is the RMS gradient at the 16 visible places of the same part that are nearest to the face, G the RMS over all
    visible places. A Gaussian draws a patch of about one colour. On a surface with gradient g a metre, and 1 / rho
    square metres a Gaussian, its mean squared error is proportional to `g^2 / rho`; the sum over a fixed number of
    Gaussians is least for rho proportional to g. The constant 1 keeps surfaces covered that are plain in this frame.

    Args:
        template: the clothed body.
        face_index: faces of the N places where the gradients were measured.
        rates: gradient magnitude of each colour there.
        seen: whether any photograph shows the place.
        detail: 0 covers all faces with equal density.
    """
    neighbours = 16
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
        _, nearest = places.query(centers[of_face == one], k=[*range(1, min(neighbours, places.n) + 1)])
        weight[of_face == one] += detail * np.sqrt(square[known][nearest].mean(1)) / usual
    return weight
