"""Read mesh files of other programs in their own order, and write PLY; start at `mesh_io`."""
