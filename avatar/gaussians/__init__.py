"""Gaussians bound to the triangles of a mesh."""
