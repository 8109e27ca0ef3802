"""Noise of a scan's vertices: how rough it makes the surface, and smoothing where it is too rough to build from."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from smplxpp.core.errors import GeometryWarning
from smplxpp.core.mesh import TriangleMesh, row_lengths

ROUGH = 0.3
"""Roughness from which a scan is smoothed: its noise turns faces over. Scans at hand have 0.04 to 0.09."""
_SMOOTH = 0.05
_MAX_STEPS = 40
# Taubin's pair (SIGGRAPH 1995): the second step gives back what the first one shrinks.
_SHRINK, _GROW = 0.5, -0.53
# Median of |x| over the standard deviation of normally distributed x.
_MEDIAN_OVER_SIGMA = 0.6745


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A scan without its noise.

    Attributes:
        mesh: the same faces; the scan itself where it was smooth enough.
        roughness: of the scan as it came. steps: of smoothing; 0: none was needed.
        moved: root mean square of the vertices' way, metres.
    """

    mesh: TriangleMesh
    roughness: float
    steps: int
    moved: float


def roughness(mesh: TriangleMesh) -> float:
    """How far vertices stand off their neighbours' smooth surface, as a share of the median edge.

    A vertex's height is its way along the normal to the mean of its neighbours; what counts is the height less the mean
    of the neighbours' heights, so that curvature, which neighbours share, does not. The median over the vertices,
    scaled to a standard deviation: hair and folds, the smaller part of a person, do not disturb it.
    """
    mean = _mean_of_neighbours(mesh)
    height = np.einsum("ij,ij->i", mean @ mesh.vertices - mesh.vertices, mesh.vertex_normals)
    i, j = mesh.edges.T
    edge = float(np.median(row_lengths(mesh.vertices[j] - mesh.vertices[i])))
    return float(np.median(np.abs(height - mean @ height))) / _MEDIAN_OVER_SIGMA / edge


def smooth_if_rough(mesh: TriangleMesh, *, rough: float = ROUGH) -> Smoothed:
    """Smooth a scan whose roughness is above `rough`; leave any other as it is.

    Taubin's filter with equal weights, which does not shrink, until the surface is as smooth as a good scan. Borders
    are smoothed along themselves. Warns when it smooths.

    Args:
        mesh: manifold, every vertex referenced (`sanitize`).
    """
    found = roughness(mesh)
    if found <= rough:
        return Smoothed(mesh, found, 0, 0.0)
    mean, smooth, steps = _mean_of_neighbours(mesh), mesh, 0
    while steps < _MAX_STEPS and roughness(smooth) > _SMOOTH:
        vertices = smooth.vertices
        for weight in (_SHRINK, _GROW):
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


def _mean_of_neighbours(mesh: TriangleMesh) -> csr_matrix:
    """(N, N) rows that average a vertex's neighbours; those of a border vertex are its neighbours along the border."""
    on_border = np.zeros(mesh.vertex_count, dtype=bool)
    on_border[mesh.border_edges] = True
    ends = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    inner = ends[~on_border[ends[:, 0]]]
    row, column = np.concatenate([inner, mesh.border_edges, mesh.border_edges[:, ::-1]]).T
    count = np.bincount(row, minlength=mesh.vertex_count)
    weights = 1.0 / count[row]
    return coo_matrix((weights, (row, column)), shape=(mesh.vertex_count, mesh.vertex_count)).tocsr()
