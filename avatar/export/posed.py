"""Convert Gaussians on a mesh to world-space splats of one pose, which `avatar.formats` writes for other programs."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from avatar.formats.splats import Splats
from avatar.gaussians.binding import THICKNESS, BoundGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from smplxpp.core.spherical_harmonics import C0, rotate_sh


def posed_splats(bound: BoundGaussians, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> Splats:
    """Return bound Gaussians as world-space splats of one pose, with harmonics rotated to the world.

    Viewers evaluate colours in the world's axes, but our coefficients refer to the triangles' frames: `rotate_sh`
    rotates them. `f_dc = (dc - 0.5) / C0`. Computed in float64, stored in float32.

    Args:
        bound: the local attributes.
        vertices: of the posed mesh, metres.
        faces: of the mesh that they are bound to.
    """
    with torch.no_grad():
        # Viewers know neither triangles nor their scale: take each Gaussian to the world, with thickness and tangential
        # scales in mean edge lengths, whose logarithm is added.
        bound = bound.to(dtype=torch.float64)
        frames = triangle_frames(vertices.double(), faces)
        world = world_from_frames(bound, frames)
        log_local = torch.cat([torch.full_like(bound.log_scales[:, :1], math.log(THICKNESS)), bound.log_scales], 1)
        arrays = {
            "means": world.means,
            "normals": world.normals,
            "f_dc": (bound.dc - 0.5) / C0,
            "f_rest": rotate_sh(bound.sh, frames.rotations[bound.face_index]),
            "opacity_logits": bound.opacity_logits,
            "log_scales": log_local + torch.log(frames.lengths[bound.face_index, None]),
            "quats": torch.nn.functional.normalize(world.quats, dim=-1),
        }
        return Splats(**{name: value.cpu().numpy() for name, value in arrays.items()})
