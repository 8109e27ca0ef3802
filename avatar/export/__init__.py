"""What training made, for others: a pose as splats, a student as a bundle."""

from avatar.export.posed import posed_splats
from avatar.formats import Splats, read_splat_ply, write_splat_ply

__all__ = ["Splats", "posed_splats", "read_splat_ply", "write_splat_ply"]
