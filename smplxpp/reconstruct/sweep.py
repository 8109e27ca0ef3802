"""The surface moved along its normals to where photographs agree: gated, weighed by confidence, smoothed.

Where the views agree no better than where the surface is, it stays: the hull is right there, or nothing says otherwise.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy import sparse
from scipy.sparse.linalg import cg

from smplxpp.core.mesh import TriangleMesh, normalize_rows
from smplxpp.native import address, native_library, thread_count
from smplxpp.reconstruct.config import SweepLevel
from smplxpp.reconstruct.photographs import Pyramids, Sight, sight

LEAST_COSINE = 0.3
LEAST_OPACITY = 0.99
# Noise of a channel of a photograph, of 1: patches with less texture agree with nothing.
_NOISE = 0.006
# Agreement at which a place counts for nothing.
_WORTHLESS = 0.5
_CLEAR = 0.2
# How often scores are averaged with their neighbours'.
_AVERAGED = 2
# Below it the next coarser patches are asked.
_CONVINCING = 0.4
# What a centimetre of displacement costs in agreement.
_COST = 0.02
# What a view without a better place holds the surface with; what nobody sees holds it by.
_ANCHOR, _LOOSE = 0.5, 0.02
_AT_END = 0.05
_OUTSIDE = 0.004


@dataclass(frozen=True)
class PatchConfig:
    """The patches that views are compared by.

    Attributes:
        coarseness: pixels between samples, of the median of the views that see the point.
        half: 2 half + 1 samples a side. most_views: that are asked for a point.
    """

    coarseness: float = 1.0
    half: int = 3
    most_views: int = 6


@dataclass(frozen=True, eq=False)
class Swept:
    """One search.

    Attributes:
        vertices: where the surface went.
        agreement: of the photographs at the best place, -1 where fewer than two see it.
        moved: metres along the normals.
    """

    vertices: Float64[np.ndarray, "N 3"]
    agreement: Float32[np.ndarray, " N"]
    moved: Float64[np.ndarray, " N"]


def refine_surface(
    mesh: TriangleMesh,
    pyramids: Pyramids,
    level: SweepLevel,
    inside: Callable[[Float32[np.ndarray, "N 3"]], Float32[np.ndarray, " N"]],
    *,
    most_views: int,
    smoothness: float,
) -> Swept:
    """Search along the normals of every vertex, and move the surface.

    Args:
        inside: metres inside the silhouettes; the surface does not leave them.
    """
    mean = mean_of_neighbours(mesh)
    normals = smooth_normals(mesh, mean)
    seen = sight(mesh, normals, pyramids.cameras)
    offsets = np.arange(-level.inward, level.outward + 1e-9, level.step)
    watched = (seen.cosine > LEAST_COSINE).sum(axis=1) >= 2
    outside = np.zeros((mesh.vertex_count, len(offsets)), dtype=bool)
    for k in np.flatnonzero(offsets > 0):
        outside[:, k] = inside((mesh.vertices + offsets[k] * normals).astype(np.float32)) < -_OUTSIDE
    displacement, confidence, agreement = (np.zeros(mesh.vertex_count) for _ in range(3))
    open_ = np.ones(mesh.vertex_count, dtype=bool)
    for coarseness in level.coarseness:
        patches = PatchConfig(coarseness, level.half, most_views)
        if not open_.any():
            break
        asked = open_
        for _ in range(_AVERAGED):  # with the neighbours that their scores are averaged with
            asked = asked | (mean @ asked.astype(np.float64) > 0)
        scores = np.zeros(outside.shape, np.float32)
        scores[asked] = sweep_scores(
            mesh.vertices[asked], normals[asked], seen.select(asked), pyramids, offsets, patches
        )
        scores[~watched] = 0.0
        scores[outside] = -1.0
        for _ in range(_AVERAGED):
            scores = 0.5 * scores + 0.5 * (mean @ scores)
        found = _best_places(scores, offsets, watched, level)
        for kept, new in zip((displacement, confidence, agreement), found, strict=True):
            kept[open_] = new[open_]
        open_ &= agreement < _CONVINCING
    moved = _smoothed(mesh, displacement, confidence, smoothness, level.step)
    said = np.where(watched, agreement, -1.0).astype(np.float32)
    return Swept(mesh.vertices + moved[:, None] * normals, said, moved)


def sweep_scores(
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    seen: Sight,
    pyramids: Pyramids,
    offsets: Float64[np.ndarray, " K"],
    patches: PatchConfig,
) -> Float32[np.ndarray, "N K"]:
    """How well the photographs agree on a patch at each offset along the normal, at most 1.

    It is -1 where fewer than two see it.
    """
    chosen = np.ascontiguousarray(seen.chosen(patches.most_views, least_cosine=LEAST_COSINE))
    looked = chosen >= 0
    looked[~looked.any(axis=1)] = True
    taken = np.take_along_axis(seen.pixel, np.maximum(chosen, 0), axis=1)
    pixel = np.nanmedian(np.where(looked, taken, np.nan), axis=1)
    across = np.where(np.abs(normals[:, [2]]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangents = np.ascontiguousarray(normalize_rows(np.cross(across, normals)))
    scores = np.empty((len(points), len(offsets)), np.float32)
    native_library().smplxpp_patch_sweep(
        address(pyramids.values),
        ctypes.c_int64(len(pyramids.values)),
        address(pyramids.starts, "int64"),
        address(pyramids.sizes, "int32"),
        ctypes.c_int64(len(pyramids.starts)),
        ctypes.c_int64(pyramids.starts.shape[1]),
        address(np.ascontiguousarray(pyramids.projections), "float64"),
        address(np.ascontiguousarray(points), "float64"),
        address(np.ascontiguousarray(normals), "float64"),
        address(tangents, "float64"),
        address(np.ascontiguousarray(patches.coarseness * pixel, dtype=np.float64), "float64"),
        address(chosen, "int32"),
        ctypes.c_int64(len(points)),
        ctypes.c_int64(chosen.shape[1]),
        address(np.ascontiguousarray(offsets), "float64"),
        ctypes.c_int64(len(offsets)),
        patches.half,
        ctypes.c_double(3 * _NOISE**2 / patches.coarseness**2),
        ctypes.c_double(LEAST_OPACITY),
        address(scores),
        thread_count(),
    )
    return scores


def _best_places(
    scores: np.ndarray, offsets: np.ndarray, watched: np.ndarray, level: SweepLevel
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The displacement of every vertex, its weight, and the agreement there."""
    scores = scores - _COST * np.abs(offsets) / 0.01
    rows, last = np.arange(len(scores)), len(offsets) - 1
    k = scores.argmax(axis=1)
    best = scores[rows, k]
    inner = np.clip(k, 1, last - 1)
    before, at, after = (scores[rows, inner + step] for step in (-1, 0, 1))
    bend = before - 2 * at + after
    peak = (k == inner) & (bend < -1e-6)
    part = np.where(peak, 0.5 * (before - after) / np.where(peak, bend, 1.0), 0.0)
    displacement = offsets[k] + np.clip(part, -0.5, 0.5) * level.step
    confidence = np.clip((best - _WORTHLESS) / (1 - _WORTHLESS), 0, 1)
    confidence *= np.clip((best - np.median(scores, axis=1)) / _CLEAR, 0, 1)
    confidence[(k == 0) | (k == last)] *= _AT_END
    confidence[~watched] = 0.0
    here = scores[:, int(np.abs(offsets).argmin())]
    stays = (best - here < level.gain) | (confidence < _LOOSE)
    displacement = np.where(stays, 0.0, displacement)
    confidence = np.where(stays, np.where(watched, _ANCHOR, _LOOSE), confidence)
    return displacement, confidence, np.where(stays, here, best)


def _smoothed(
    mesh: TriangleMesh, displacement: np.ndarray, confidence: np.ndarray, smoothness: float, step: float
) -> np.ndarray:
    """The displacements that lie near those found, where they are believed, and change little from vertex to vertex.

    Those that stay far from the result are believed less each time.
    """
    laplacian = sparse_laplacian(mesh)
    weight, found = confidence, np.zeros(len(displacement))
    for _ in range(4):
        matrix = sparse.diags(weight + 1e-3) + smoothness * laplacian
        found, _ = cg(matrix, weight * displacement, x0=found, rtol=1e-5, maxiter=400)
        weight = confidence / (1 + ((displacement - found) / (2 * step)) ** 2)
    return found


def sparse_laplacian(mesh: TriangleMesh) -> sparse.csr_matrix:
    """(N, N) the graph's Laplacian: neighbours' number on the diagonal, -1 for each neighbour."""
    i, j = mesh.edges.T
    ones, size = np.ones(len(i)), (mesh.vertex_count,) * 2
    adjacency = sparse.coo_matrix((ones, (i, j)), shape=size)
    adjacency = (adjacency + adjacency.T).tocsr()
    return (sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency).tocsr()


def mean_of_neighbours(mesh: TriangleMesh) -> sparse.csr_matrix:
    """(N, N) rows that average a vertex's neighbours."""
    laplacian = sparse_laplacian(mesh)
    count = laplacian.diagonal()
    return sparse.eye(len(count)) - sparse.diags(1.0 / np.maximum(count, 1)) @ laplacian


def smooth_normals(mesh: TriangleMesh, mean: sparse.csr_matrix) -> Float64[np.ndarray, "N 3"]:
    """The vertices' normals, averaged twice with their neighbours'."""
    normals = mesh.vertex_normals
    for _ in range(2):
        normals = normals + mean @ normals
    return normalize_rows(np.ascontiguousarray(normals))


def taubin(
    mesh: TriangleMesh, mean: sparse.csr_matrix, *, steps: int, fixed: Bool[np.ndarray, " N"] | None = None
) -> TriangleMesh:
    """Smooth without shrinking (Taubin 1995)."""
    vertices: Float[np.ndarray, "N 3"] = mesh.vertices
    for _ in range(steps):
        for weight in (0.5, -0.53):
            move = weight * (mean @ vertices - vertices)
            vertices = vertices + (move if fixed is None else np.where(fixed[:, None], 0.0, move))
    return mesh.with_vertices(vertices)
