"""Barycentrics and interpolation at known faces in plain torch: the oracle of the kernels, and what runs elsewhere."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Int32
from torch import Tensor

from smplxpp.core.camera import Camera


def ray_from_pixel(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Return what takes (px, py, 1) to the camera's frame: a pinhole's ray at depth 1, or x and y of a parallel ray."""
    K = np.eye(3)
    K[:2] = camera.K[:2]
    return np.linalg.inv(K)


def barycentrics_reference(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], face_id: Int32[Tensor, "H W"], camera: Camera
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Return barycentrics and depth of the point of face `face_id` that a pixel's ray meets.

    With r the ray and a, b, c the corners in the camera's frame, `w_a = r . (b x c)` and so on, and the barycentrics
    are `w / sum(w)`: the point `sum(w p) / sum(w)` lies on the ray. For parallel rays r and the corners have 1 for z.
    Computed in float64 and returned in the vertices' type; differentiable in the vertices.
    """
    hit = face_id >= 0
    pose = torch.from_numpy(camera.cam_from_world).to(vertices.device)
    cam = vertices.double() @ pose[:3, :3].T + pose[:3, 3]
    corners = cam[faces[face_id[hit].long()]]
    rows, cols = hit.nonzero(as_tuple=True)
    pixels = torch.stack([cols + 0.5, rows + 0.5, torch.ones_like(cols)], dim=-1).double()
    ray = pixels @ torch.from_numpy(ray_from_pixel(camera)).to(pixels.device).T
    points = torch.cat([corners[..., :2], torch.ones_like(corners[..., 2:])], -1) if camera.orthographic else corners
    a, b, c = points.unbind(1)
    weights = torch.stack([(ray * torch.cross(p, q, dim=-1)).sum(-1) for p, q in ((b, c), (c, a), (a, b))], dim=-1)
    weights = weights / weights.sum(-1, keepdim=True)
    z = (weights * corners[..., 2]).sum(-1)
    barycentric = vertices.new_zeros((*face_id.shape, 3)).index_put((rows, cols), weights.to(vertices.dtype))
    return barycentric, vertices.new_full(face_id.shape, torch.inf).index_put((rows, cols), z.to(vertices.dtype))


def interpolate_reference(
    values: Float[Tensor, "V D"],
    barycentric: Float[Tensor, "*P 3"],
    faces: Int[Tensor, "F 3"],
    face_id: Int32[Tensor, "*P"],
) -> Float[Tensor, "*P D"]:
    """Interpolate vertex values at the barycentrics of faces; 0 on the background."""
    hit = face_id >= 0
    seen = (barycentric[hit][..., None] * values[faces[face_id[hit].long()]]).sum(1)
    return seen.new_zeros((*face_id.shape, values.shape[1])).index_put(hit.nonzero(as_tuple=True), seen)
