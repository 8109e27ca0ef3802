"""Initial Gaussians: sampled on the template and coloured from the photographs that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter
from torch import Tensor

from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.rig.rig import Rig
from avatar.training.fit.picture_detail import changes, density_of_detail
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.template.mouth import inside_of_mouth

DEPTH_TOLERANCE = 0.015
"""Metres that a visible point may lie behind the z-buffer."""


def initial_gaussians(
    rig: Rig,
    vertices: Float[np.ndarray, "V 3"],
    views: Sequence[View],
    sampling: SamplingConfig,
    *,
    detail: float = 0.0,
) -> BoundGaussians:
    """Sample Gaussians on a template and colour them from whole views of it.

    Args:
        rig: of the template.
        vertices: of the template in the views' frame, metres.
        views: whole photographs of the frame.
        sampling: number and distribution of the Gaussians, and the seed.
        detail: additional density where the photographs change quickly, see `density_of_detail`; 0: none.
    """
    start = sample_on_mesh(rig.template, sampling)
    # A first sample measures the gradient magnitude of the photographs; the second one follows it.
    if detail:
        rates, seen = _shown(rig, vertices, start, [changes(view) for view in views])
        density = density_of_detail(rig.template, start.face_index.numpy(), rates.cpu().numpy(), seen, detail)
        start = sample_on_mesh(rig.template, sampling, density=density)
    return replace(start.to(device=rig.device), dc=_shown(rig, vertices, start, views)[0])


def _shown(
    rig: Rig, vertices: Float[np.ndarray, "V 3"], gaussians: BoundGaussians, views: Sequence[View]
) -> tuple[Float32[Tensor, "N 3"], Bool[np.ndarray, " N"]]:
    """Return the colours of Gaussians on a template at `vertices` in the views, and whether any view shows each."""
    mouth_tolerance = 0.002  # metres behind the z-buffer: teeth are a centimetre behind the lips
    gaussians = gaussians.to(device=rig.device)
    placed = world_from_frames(gaussians, triangle_frames(rig.pose_from_vertices(vertices).rest, rig.faces))
    return colors_from_views(
        placed.means.double().cpu().numpy(),
        placed.normals.double().cpu().numpy(),
        gaussians.dc,
        mesh=rig.template.mesh.with_vertices(vertices),
        views=views,
        tolerance=np.where(_in_mouth(rig, gaussians), mouth_tolerance, DEPTH_TOLERANCE),
    )


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
        seen &= depth <= nearest[row, column] + (DEPTH_TOLERANCE if tolerance is None else tolerance)
        # Sample the image bilinearly at the visible points, and add with weight cos^2 (f / distance)^2.
        index = np.flatnonzero(seen)
        image = view.foreground.cpu().numpy() / 255.0
        at = np.stack([y[index] - 0.5, x[index] - 0.5])
        w = (cosine[index] * camera.K[0, 0] / distance[index]) ** 2
        total[index] += w[:, None] * np.stack(
            [map_coordinates(image[..., k], at, order=1, mode="nearest") for k in range(3)], axis=1
        )
        weight[index] += w
    seen = weight > 0
    colors = fallback.detach().cpu().numpy().copy()
    colors[seen] = total[seen] / weight[seen, None]
    return torch.tensor(colors, dtype=torch.float32, device=fallback.device), seen
