"""Normals of a point cloud: planes through neighbours, turned outward by who sees them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from smplxpp.core.mesh import normalize_rows

NEIGHBOURS = 16
# Directions from which the cloud is looked at.
_VIEWS = 96
# A cell of a view's grid, in spacings: with these the points of a surface that faces the view leave few cells empty.
_CELL = 2.0
# A point this many cells behind the foremost one of its cell and those about it counts as hidden.
_DEPTH = 1.5
# Rounds in which a point takes the side of its neighbours.
_ROUNDS = 8
_ROWS = 1 << 17


def point_spacing(points: Float[np.ndarray, "N 3"]) -> float:
    """The median distance of a point from its nearest other one, metres."""
    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))


def estimate_normals(points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Unit normals of a cloud of points of a body's surface, pointing outward.

    A normal is that of the plane through the nearest neighbours. Which side is out, no plane tells, and passing the
    side on from neighbour to neighbour (a minimum spanning tree) goes wrong where sleeve and trunk touch. So the cloud
    is looked at from all around: a point that a view sees faces it. What no view sees takes its neighbours' side.

    Args:
        points: without repetitions, of a surface that is sampled about evenly.
    """
    tree = cKDTree(points)
    near, neighbours = tree.query(points, k=min(NEIGHBOURS, len(points)))
    normals = np.concatenate(
        [_plane_normals(points[rows]) for rows in np.array_split(neighbours, len(neighbours) // _ROWS + 1)]
    )
    votes = _votes_of_views(points, normals, spacing=float(np.median(near[:, 1])))
    for _ in range(_ROUNDS):
        # A neighbour that runs alike counts in full, one across an edge little.
        alike = np.einsum("ij,ikj->ik", normals, normals[neighbours])
        votes = np.einsum("ik,ik->i", alike * np.abs(alike), votes[neighbours]) / neighbours.shape[1]
    return np.where(votes[:, None] < 0, -normals, normals)


def _plane_normals(neighbourhoods: Float[np.ndarray, "n k 3"]) -> Float64[np.ndarray, "n 3"]:
    """The directions in which neighbourhoods extend least."""
    centred = neighbourhoods - neighbourhoods.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0]


def _votes_of_views(
    points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"], *, spacing: float
) -> Float64[np.ndarray, " N"]:
    """For each point how clearly the views that see it find it facing them: positive for, negative against."""
    cell = _CELL * spacing
    votes = np.zeros(len(points))
    for direction in _directions(_VIEWS):
        across = np.linalg.svd(direction[None])[2][1:]  # two axes of the picture
        column = np.floor((points @ across.T) / cell).astype(np.int64)
        column -= column.min(axis=0)
        seen = _foremost(column, points @ direction, depth=_DEPTH * cell)
        votes += np.where(seen, normals @ direction, 0.0)
    return votes / _VIEWS


def _foremost(cells: Int64[np.ndarray, "N 2"], height: Float[np.ndarray, " N"], *, depth: float) -> np.ndarray:
    """(N,) the points that lie within `depth` of the highest of their cell and the eight about it."""
    shape = cells.max(axis=0) + 1
    top = np.full(int(shape.prod()), -np.inf)
    index = cells[:, 0] * shape[1] + cells[:, 1]
    np.maximum.at(top, index, height)
    top = maximum_filter(top.reshape(shape), size=3, mode="constant", cval=-np.inf).ravel()
    return height >= top[index] - depth


def _directions(count: int) -> Float64[np.ndarray, "count 3"]:
    """Unit vectors spread evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z * z)
    return normalize_rows(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1))
