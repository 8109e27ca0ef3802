"""Files that other viewers read."""

from avatar.export.splats import Splats, posed_splats, read_splat_ply, write_splat_ply

__all__ = ["Splats", "posed_splats", "read_splat_ply", "write_splat_ply"]
