"""A posed avatar in files of other programs; torch is not needed."""

from avatar.formats.packed_splats import write_splat_sog, write_splat_spz
from avatar.formats.ply import read_splat_ply, write_splat_ply
from avatar.formats.splat_scenes import write_splat_glb
from avatar.formats.splats import Splats, world_splats

__all__ = [
    "Splats",
    "read_splat_ply",
    "world_splats",
    "write_splat_glb",
    "write_splat_ply",
    "write_splat_sog",
    "write_splat_spz",
]
