"""Gaussians bound to the triangles of a mesh: binding, sampling, colours, files."""

from avatar.gaussians.binding import (
    BoundGaussians,
    WorldGaussians,
    offset_penalty,
    scale_penalty,
    world_from_frames,
    world_from_local,
)
from avatar.gaussians.colors import view_colors
from avatar.gaussians.frames import TriangleFrames, triangle_frames
from avatar.gaussians.sampling import SamplingConfig, head_faces, sample_on_mesh
from avatar.gaussians.tensor_file import load_bound, save_bound

__all__ = [
    "BoundGaussians",
    "SamplingConfig",
    "TriangleFrames",
    "WorldGaussians",
    "head_faces",
    "load_bound",
    "offset_penalty",
    "sample_on_mesh",
    "save_bound",
    "scale_penalty",
    "triangle_frames",
    "view_colors",
    "world_from_frames",
    "world_from_local",
]
