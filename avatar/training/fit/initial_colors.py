"""Gaussians to start from, coloured as the photographs: what the photographs show where each Gaussian lies."""

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
"""Metres that a point may lie behind the surface and still count as seen."""
MOUTH_TOLERANCE = 0.002
"""The same for the inside of the mouth: teeth lie a centimetre behind lips, and are none."""
MIN_COSINE = 0.2
"""Surfaces seen at a flatter angle than this give no colour: their pixels belong to the silhouette."""
MIN_OPACITY = 0.99


def initial_gaussians(
    rig: Rig,
    vertices: Float[np.ndarray, "V 3"],
    views: Sequence[View],
    sampling: SamplingConfig,
    *,
    detail: float = 0.0,
) -> BoundGaussians:
    """Sample Gaussians on a template and colour them from whole views of it at `vertices`, metres.

    Args:
        detail: how much denser they lie where the views change quickly, see `density_of_detail`.
    """
    start = sample_on_mesh(rig.template, sampling)
    if detail:
        rates, seen = _shown(rig, vertices, start, [changes(view) for view in views])
        density = density_of_detail(rig.template, start.face_index.numpy(), rates.cpu().numpy(), seen, detail)
        start = sample_on_mesh(rig.template, sampling, density=density)
    return replace(start.to(device=rig.device), dc=_shown(rig, vertices, start, views)[0])


def _shown(
    rig: Rig, vertices: Float[np.ndarray, "V 3"], gaussians: BoundGaussians, views: Sequence[View]
) -> tuple[Float32[Tensor, "N 3"], Bool[np.ndarray, " N"]]:
    """Colours of Gaussians on a template at `vertices` as views show them, and which of them any view shows."""
    gaussians = gaussians.to(device=rig.device)
    placed = world_from_frames(gaussians, triangle_frames(rig.pose_from_vertices(vertices).rest, rig.faces))
    return colors_from_views(
        placed.means.double().cpu().numpy(),
        placed.normals.double().cpu().numpy(),
        gaussians.dc,
        mesh=rig.template.mesh.with_vertices(vertices),
        views=views,
        tolerance=np.where(_in_mouth(rig, gaussians), MOUTH_TOLERANCE, DEPTH_TOLERANCE),
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
    """Return the mean colour of points over the views that see them, weighted by the pixels a square metre has there.

    `c = sum_v w_v I_v(p) / sum_v w_v`, `w_v = cos^2 (f / distance)^2` where the z-buffer of the mesh shows the point,
    no silhouette edge is within a pixel, and the mask is opaque; 0 elsewhere.

    Args:
        points, normals: in the world, metres; unit normals.
        fallback: colours of the points that no view sees.
        mesh: what hides points from cameras.
        tolerance: metres that each may lie behind the surface and still count as seen; None: `DEPTH_TOLERANCE`.

    Returns:
        Colours, and which points some view saw.
    """
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views:
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
        opacity = view.opacity().cpu().numpy()
        seen = (
            inside & (cosine > MIN_COSINE) & np.isfinite(farthest[row, column]) & (opacity[row, column] > MIN_OPACITY)
        )
        seen &= depth <= nearest[row, column] + (DEPTH_TOLERANCE if tolerance is None else tolerance)
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
