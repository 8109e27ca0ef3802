"""Initial Gaussians: sampled on the template, denser where photographs change, coloured by the views that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter, sobel
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.data.one_frame import PosedViews
from avatar.data.views import View
from avatar.gaussians import BoundGaussians, SamplingConfig, sample_on_mesh, triangle_frames, world_from_frames
from avatar.rig.rig import Rig
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.template.mouth import inside_of_mouth
from smplxpp.template.template import Template

DEPTH_TOLERANCE = 0.015
"""Metres that a visible point may lie behind the z-buffer."""


def initial_gaussians(
    rig: Rig,
    vertices: Float[np.ndarray, "V 3"],
    views: Sequence[View],
    sampling: SamplingConfig,
    *,
    others: Sequence[PosedViews] = (),
    detail: float = 0.0,
) -> BoundGaussians:
    """Sample Gaussians on a template and colour them from whole views of it.

    Args:
        rig: of the template.
        vertices: of the template in the views' frame, metres.
        views: whole photographs of the frame.
        sampling: number and distribution of the Gaussians, and the seed.
        others: further frames, which show other sides.
        detail: additional density where the photographs change quickly, see `density_of_detail`; 0: none.
    """
    frames = (PosedViews(vertices, views), *others)
    start = sample_on_mesh(rig.template, sampling)
    # A first sample measures the gradient magnitude of the photographs; the second one follows it.
    if detail:
        of_changes = [PosedViews(one.vertices, [changes(view) for view in one.views]) for one in frames]
        rates, seen = _measure_colors(rig, start, of_changes)
        density = density_of_detail(rig.template, start.face_index.numpy(), rates.cpu().numpy(), seen, detail)
        start = sample_on_mesh(rig.template, sampling, density=density)
    colors, seen = _measure_colors(rig, start, frames)
    if others:
        colors = _unseen_from_neighbours(rig, start, colors, seen)
    return replace(start.to(device=rig.device), dc=colors)


def _unseen_from_neighbours(
    rig: Rig, gaussians: BoundGaussians, colors: Float32[Tensor, "N 3"], seen: Bool[np.ndarray, " N"]
) -> Float32[Tensor, "N 3"]:
    """Give Gaussians that no view shows the colour of the nearest seen one, on clothes and hair of the same part.

    One camera sees neither armpits nor the skin under clothes, which shows through between the Gaussians of the cloth.
    The inside of the mouth keeps the template's colours.
    """
    faces = rig.template.faces[gaussians.face_index.cpu().numpy()]
    places = rig.template.vertices[faces].mean(axis=1)
    part = rig.template.vertex_part[faces[:, 0]]
    lacking = ~seen & ~_in_mouth(rig, gaussians)
    out = colors.cpu().numpy().copy()
    for one in np.unique(part[lacking]):
        # Skin borrows from what covers it; a part of which nothing is seen borrows from any other.
        known = np.flatnonzero(seen & ((part == one) | (one == 0)))
        known = known if len(known) else np.flatnonzero(seen)
        rows = np.flatnonzero(lacking & (part == one))
        if len(known):
            out[rows] = out[known[cKDTree(places[known]).query(places[rows])[1]]]
    return torch.tensor(out, dtype=colors.dtype, device=colors.device)


def _measure_colors(
    rig: Rig, gaussians: BoundGaussians, frames: Sequence[PosedViews]
) -> tuple[Float32[Tensor, "N 3"], Bool[np.ndarray, " N"]]:
    """Return the mean colours of Gaussians on a template over all views, and whether any view shows each."""
    mouth_tolerance = 0.002  # metres behind the z-buffer: teeth are a centimetre behind the lips
    gaussians = gaussians.to(device=rig.device)
    tolerance = np.where(_in_mouth(rig, gaussians), mouth_tolerance, DEPTH_TOLERANCE)
    total, weight = np.zeros((len(gaussians), 3)), np.zeros(len(gaussians))
    for frame in frames:
        # Centres and normals of the Gaussians in the world, on the mesh in the frame's pose.
        placed = world_from_frames(gaussians, triangle_frames(rig.pose_from_vertices(frame.vertices).rest, rig.faces))
        summed, weights = _weighted_colors(
            placed.means.double().cpu().numpy(),
            placed.normals.double().cpu().numpy(),
            mesh=rig.template.mesh.with_vertices(frame.vertices),
            views=frame.views,
            tolerance=tolerance,
        )
        total, weight = total + summed, weight + weights
    return _mean_colors(total, weight, gaussians.dc)


def _in_mouth(rig: Rig, gaussians: BoundGaussians) -> Bool[np.ndarray, " N"]:
    faces = rig.template.faces[gaussians.face_index.cpu().numpy()]
    return np.asarray(inside_of_mouth(rig.template)[faces].all(axis=1))


def colors_from_views(
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    fallback: Float[Tensor, "N 3"],
    *,
    mesh: TriangleMesh,
    views: Sequence[View],
    tolerance: Float[np.ndarray, " N"] | None = None,
) -> tuple[Float32[Tensor, "N 3"], Bool[np.ndarray, " N"]]:
    """Return the mean colour of points over the views that show them, weighted by pixels a square metre of surface.

    `c = sum_v w_v I_v(p) / sum_v w_v`, `w_v = cos^2 (f / distance)^2` where the z-buffer of the mesh shows the point,
    no silhouette edge is within a pixel, and the mask is opaque; 0 elsewhere.

    Args:
        points: in the world, metres.
        normals: unit normals at the points.
        fallback: colours of the points that no view shows.
        mesh: occluder.
        views: whole photographs.
        tolerance: metres that each visible point may lie behind the z-buffer; None: `DEPTH_TOLERANCE`.

    Returns:
        Colours, and whether any view shows each point.
    """
    depths = np.full(len(points), DEPTH_TOLERANCE) if tolerance is None else tolerance
    return _mean_colors(*_weighted_colors(points, normals, mesh=mesh, views=views, tolerance=depths), fallback)


def _mean_colors(
    total: Float64[np.ndarray, "N 3"], weight: Float64[np.ndarray, " N"], fallback: Float[Tensor, "N 3"]
) -> tuple[Float32[Tensor, "N 3"], Bool[np.ndarray, " N"]]:
    """Return weighted means, the fallback where no view has any weight, and where some view has."""
    seen = weight > 0
    colors = fallback.detach().cpu().numpy().copy()
    colors[seen] = total[seen] / weight[seen, None]
    return torch.tensor(colors, dtype=torch.float32, device=fallback.device), seen


def _weighted_colors(
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    *,
    mesh: TriangleMesh,
    views: Sequence[View],
    tolerance: Float[np.ndarray, " N"],
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, " N"]]:
    """Return the weighted sums of colours of `colors_from_views` over the views, and the sums of weights."""
    min_cosine = 0.2  # surfaces at flatter angles project into pixels of the silhouette
    min_opacity = 0.99
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views:
        # Project the points, and rasterise the occluder.
        camera = view.camera
        x, y, depth = camera.screen_from_world(points).T[:3]
        front = rasterize_mesh(mesh, camera).depth
        # Nearest surface around the pixel, and whether background is among its neighbours.
        nearest, farthest = minimum_filter(front, 3), maximum_filter(front, 3)
        inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        column = np.where(inside, x, 0).astype(int)
        row = np.where(inside, y, 0).astype(int)
        away = camera.position - points
        distance = np.linalg.norm(away, axis=1)
        cosine = (away * normals).sum(1) / distance
        # A point is visible if it is near the z-buffer, not seen at a flat angle, and inside the mask.
        opacity = view.opacity().cpu().numpy()
        seen = (
            inside & (cosine > min_cosine) & np.isfinite(farthest[row, column]) & (opacity[row, column] > min_opacity)
        )
        seen &= depth <= nearest[row, column] + tolerance
        # Sample the image bilinearly at the visible points, and add with weight cos^2 (f / distance)^2.
        index = np.flatnonzero(seen)
        image = view.foreground.cpu().numpy() / 255.0
        at = np.stack([y[index] - 0.5, x[index] - 0.5])
        w = (cosine[index] * camera.K[0, 0] / distance[index]) ** 2
        total[index] += w[:, None] * np.stack(
            [map_coordinates(image[..., k], at, order=1, mode="nearest") for k in range(3)], axis=1
        )
        weight[index] += w
    return total, weight


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
    # RMS over the visible places, the unit of the gradients.
    weight = np.ones(len(template.faces))
    square = np.square(rates).sum(1)
    usual = np.sqrt(square[seen].mean()) if seen.any() else 0.0
    if not usual:
        return weight
    # Part by part, the RMS gradient at the nearest visible places of the part.
    centers = template.mesh.triangles.mean(1)
    of_face = template.vertex_part[template.faces[:, 0]]
    for one in np.unique(of_face):
        known = seen & (of_face[face_index] == one)
        known = known if known.any() else seen
        places = cKDTree(centers[face_index[known]])
        _, nearest = places.query(centers[of_face == one], k=[*range(1, min(neighbours, places.n) + 1)])
        # sqrt of the mean square is the RMS g; G makes the factor free of units.
        weight[of_face == one] += detail * np.sqrt(square[known][nearest].mean(1)) / usual
    return weight
