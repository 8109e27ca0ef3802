"""Gaussians bound to the triangles of a mesh."""

from avatar.gaussians.binding import BoundGaussians, WorldGaussians, world_from_frames, world_from_local
from avatar.gaussians.bound_file import load_bound, save_bound
from avatar.gaussians.frames import TriangleFrames, triangle_frames
from avatar.gaussians.regularizers import offset_penalty, scale_penalty
from avatar.gaussians.sampling import SamplingConfig, head_faces, sample_on_mesh
from avatar.gaussians.spherical_harmonics import view_colors

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
