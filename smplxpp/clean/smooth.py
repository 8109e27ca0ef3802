"""Measure the noise of a scan's vertices, smooth scans that are too rough to build from, and the borders of cuts."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from smplxpp.core import GeometryWarning, MeshLike, TriangleMesh, as_mesh, row_lengths
from smplxpp.core.errors import one_line
from smplxpp.core.topology import mean_of_neighbours

ROUGH = 0.3
"""Roughness (`roughness`) from which a scan is smoothed: more noise flips faces. Available scans have 0.04 to 0.09."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A scan after smoothing, if it needed any.

    Attributes:
        mesh: the smoothed scan with the same faces, or the scan itself if it was smooth enough.
        roughness: roughness before smoothing.
        steps: number of smoothing steps; 0 if none was needed.
        moved: root mean square of the vertices' displacements, metres.
    """

    mesh: TriangleMesh
    roughness: float
    steps: int
    moved: float

    __repr__ = one_line


def roughness(mesh: MeshLike) -> float:
    """Return the noise of vertices along their normals, as a fraction of the median edge length.

    A vertex's height h is its normal distance to the mean of its neighbours. With the mean W over neighbours the noise
    is h - W h, in which curvature, which neighbours share, cancels. Its standard deviation is estimated from the median
    of |h - W h|, which hair and folds, the smaller part of a person, do not disturb.
    """
    mesh = as_mesh(mesh, subject="mesh")
    mean = mean_of_neighbours(mesh.edges, mesh.border_edges, mesh.vertex_count)
    height = np.einsum("ij,ij->i", mean @ mesh.vertices - mesh.vertices, mesh.vertex_normals)
    i, j = mesh.edges.T
    edge = float(np.median(row_lengths(mesh.vertices[j] - mesh.vertices[i])))
    # The median of |x| is 0.6745 standard deviations of a normally distributed x.
    return float(np.median(np.abs(height - mean @ height))) / 0.6745 / edge


def smooth_if_rough(mesh: MeshLike, *, rough: float = ROUGH) -> Smoothed:
    """Smooth a scan whose roughness is above `rough`; return any other unchanged.

    Taubin's filter (SIGGRAPH 1995) with equal weights, which does not shrink the surface, is applied until the surface
    is as smooth as a good scan. Borders are smoothed along themselves. A warning states the smoothing.

    Args:
        mesh: manifold, every vertex referenced (`sanitize`).
        rough: roughness above which it is smoothed.
    """
    mesh = as_mesh(mesh, subject="mesh")
    found = roughness(mesh)
    if found <= rough:
        return Smoothed(mesh, found, 0, 0.0)
    mean, smooth, steps = mean_of_neighbours(mesh.edges, mesh.border_edges, mesh.vertex_count), mesh, 0
    # Each step shrinks by 0.5 and inflates by 0.53 of the Laplacian; at most 40 steps, until the roughness is 0.05.
    while steps < 40 and roughness(smooth) > 0.05:
        vertices = smooth.vertices
        for weight in (0.5, -0.53):
            vertices = vertices + weight * (mean @ vertices - vertices)
        smooth, steps = mesh.with_vertices(vertices), steps + 1
    moved = float(np.sqrt(np.mean(np.sum((smooth.vertices - mesh.vertices) ** 2, axis=1))))
    warnings.warn(
        f"noisy scan smoothed: vertices stand {found:.2f} edges off their neighbours (up to {rough:g} stays as it is); "
        f"{steps} steps moved them by {1e3 * moved:.1f} mm",
        GeometryWarning,
        stacklevel=2,
    )
    return Smoothed(smooth, found, steps, moved)


def smooth_cuts(
    part: TriangleMesh, cut: Bool[np.ndarray, " N"], carried: Float[np.ndarray, "N K"]
) -> tuple[TriangleMesh, Float64[np.ndarray, "N K"]]:
    """Smooth the borders of cuts: a border along faces is a saw, whose teeth stand off the patch that closes it.

    The vertices of the cut, and those that share a face with it, move halfway to the mean of their neighbours, on the
    border to that of its own, `_BORDER_STEPS` times. A move that would turn a face over is left out.

    Args:
        part: manifold.
        cut: its vertices on such borders; other borders stay.
        carried: values of the vertices that move with them, such as skin weights: where these stayed, a pose would bend
            the border back.

    Returns:
        The part with smooth borders, and the carried values.
    """
    beside = np.zeros(part.vertex_count, dtype=bool)
    beside[part.faces[cut[part.faces].any(axis=1)]] = True
    beside[part.border_edges] = False
    moving, x = np.flatnonzero(cut | beside), np.hstack([part.vertices, carried])
    mean = mean_of_neighbours(part.edges, part.border_edges, part.vertex_count)
    for _ in range(_BORDER_STEPS):
        moved = x.copy()
        moved[moving] = 0.5 * (x[moving] + mean[moving] @ x)
        # Put the corners of turned faces back, which may turn others.
        for _ in range(3):
            turned = np.einsum("ij,ij->i", part.face_cross, part.with_vertices(moved[:, :3]).face_cross) <= 0
            back = np.unique(part.faces[turned])
            moved[back] = x[back]
        x = moved
    return part.with_vertices(x[:, :3]), x[:, 3:]


_BORDER_STEPS = 8
"""Steps that smooth the border of a cut: teeth of one edge vanish, a curve of ten edges keeps its shape."""
