"""Mesh files of other programs, read in their own order, and ours written; `mesh_io` is the way in."""
