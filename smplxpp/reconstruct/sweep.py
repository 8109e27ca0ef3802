"""Refine a surface by a plane sweep along its normals: move vertices to where photographs agree.

1. Every vertex gets a score at each offset along its normal: the agreement (normalised cross-correlation) of patches
   in the views that see it most frontally. Scores are averaged with the neighbours' twice.
2. The best offset, refined by a parabola, becomes the displacement if its score gains enough over the present place;
   else the vertex is anchored. Its confidence grows with the score and with the margin over the median score.
3. The displacements u minimise `sum_i c_i (u_i - d_i)^2 + smoothness u^T L u` with the graph Laplacian L, robustly: the
   weight c_i of a displacement d_i far from the solution falls (Cauchy), in four rounds.
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
from smplxpp.reconstruct.photographs import Pyramids, Sight

LEAST_COSINE = 0.3
"""Cosine between normal and ray below which a view is too oblique to be compared."""
LEAST_OPACITY = 0.99
"""Opacity from which a pixel shows the person alone."""


@dataclass(frozen=True)
class SweepLevel:
    """Options of one sweep along the normals.

    Attributes:
        inward: distance that is searched inside the surface, metres.
        outward: distance that is searched outside the surface, metres.
        step: distance of the offsets, metres.
        gain: least increase of agreement over the present position for an offset to be taken.
        coarseness: spacing of a patch's samples, in pixels, with photographs of that resolution. Each further value is
            used where the one before has no convincing agreement: small patches follow a surface, large ones find
            texture.
        half: a patch has 2 half + 1 samples a side.
    """

    inward: float
    outward: float
    step: float
    gain: float
    coarseness: tuple[float, ...] = (1.0,)
    half: int = 3


@dataclass(frozen=True)
class PatchConfig:
    """The patches in which views are compared.

    Attributes:
        coarseness: spacing of the samples, in pixels of the median view that sees the point.
        half: a patch has 2 half + 1 samples a side.
        most_views: number of views that are compared at a point.
    """

    coarseness: float = 1.0
    half: int = 3
    most_views: int = 6


@dataclass(frozen=True, eq=False)
class Swept:
    """Result of one sweep along the normals.

    Attributes:
        vertices: of the moved surface, metres.
        agreement: of the photographs at the chosen place, -1 where fewer than two views see it.
        moved: displacements along the normals, metres.
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
    """Sweep along the normals of all vertices and move the surface.

    Args:
        mesh: the surface.
        pyramids: of the photographs.
        level: range and gates of the sweep.
        inside: depth of points inside the silhouettes, metres; offsets over 4 mm outside are excluded.
        most_views: number of views that are compared at a point.
        smoothness: weight of the Laplacian.
    """
    averaged, convincing, outside_m = 2, 0.4, 0.004
    # Offsets outside the silhouettes are excluded; vertices that fewer than two views see are not watched.
    mean = mean_of_neighbours(mesh)
    normals = smooth_normals(mesh, mean)
    seen = pyramids.sight(mesh, normals)
    offsets = np.arange(-level.inward, level.outward + 1e-9, level.step)
    watched = (seen.cosine > LEAST_COSINE).sum(axis=1) >= 2
    outside = np.zeros((mesh.vertex_count, len(offsets)), dtype=bool)
    for k in np.flatnonzero(offsets > 0):
        outside[:, k] = inside((mesh.vertices + offsets[k] * normals).astype(np.float32)) < -outside_m
    displacement, confidence, agreement = (np.zeros(mesh.vertex_count) for _ in range(3))
    open_ = np.ones(mesh.vertex_count, dtype=bool)
    # From fine patches to coarse ones, each for the vertices that are still without a convincing agreement.
    for coarseness in level.coarseness:
        patches = PatchConfig(coarseness, level.half, most_views)
        if not open_.any():
            break
        asked = open_
        for _ in range(averaged):  # with neighbours, whose scores enter the average
            asked = asked | (mean @ asked.astype(np.float64) > 0)
        scores = np.zeros(outside.shape, np.float32)
        scores[asked] = sweep_scores(
            mesh.vertices[asked], normals[asked], seen.select(asked), pyramids, offsets, patches
        )
        scores[~watched] = 0.0
        scores[outside] = -1.0
        for _ in range(averaged):
            scores = 0.5 * scores + 0.5 * (mean @ scores)
        found = _best_places(scores, offsets, watched, level)
        for kept, new in zip((displacement, confidence, agreement), found, strict=True):
            kept[open_] = new[open_]
        open_ &= agreement < convincing
    moved = _smoothed(mesh, displacement, confidence, smoothness, level.step)
    shown = np.where(watched, agreement, -1.0).astype(np.float32)
    return Swept(mesh.vertices + moved[:, None] * normals, shown, moved)


def sweep_scores(
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    seen: Sight,
    pyramids: Pyramids,
    offsets: Float64[np.ndarray, " K"],
    patches: PatchConfig,
) -> Float32[np.ndarray, "N K"]:
    """Return the agreement of the photographs on a patch at each offset along the normal, at most 1.

    The score is -1 where fewer than two views see the patch.
    """
    # Each point is compared in the views of largest cosine, with patches as large as a pixel of the median view.
    chosen = np.ascontiguousarray(seen.chosen(patches.most_views, least_cosine=LEAST_COSINE))
    looked = chosen >= 0
    looked[~looked.any(axis=1)] = True
    taken = np.take_along_axis(seen.pixel, np.maximum(chosen, 0), axis=1)
    pixel = np.nanmedian(np.where(looked, taken, np.nan), axis=1)
    # A tangent for the patches' first axis, and the sweep itself in C++.
    across = np.where(np.abs(normals[:, [2]]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangents = np.ascontiguousarray(normalize_rows(np.cross(across, normals)))
    noise = 0.006  # standard deviation of a channel in [0, 1]; patches with less texture agree with nothing
    weight = 3 * noise**2 / patches.coarseness**2
    scores = np.empty((len(points), len(offsets)), np.float32)
    for rows, projections in pyramids.projections_of(points):
        found = np.empty((len(rows), len(offsets)), np.float32)
        native_library().smplxpp_patch_sweep(
            address(pyramids.values),
            ctypes.c_int64(len(pyramids.values)),
            address(pyramids.starts, "int64"),
            address(pyramids.sizes, "int32"),
            ctypes.c_int64(len(pyramids.starts)),
            ctypes.c_int64(pyramids.starts.shape[1]),
            address(np.ascontiguousarray(projections), "float64"),
            address(np.ascontiguousarray(points[rows]), "float64"),
            address(np.ascontiguousarray(normals[rows]), "float64"),
            address(np.ascontiguousarray(tangents[rows]), "float64"),
            address(np.ascontiguousarray(patches.coarseness * pixel[rows], dtype=np.float64), "float64"),
            address(np.ascontiguousarray(chosen[rows]), "int32"),
            ctypes.c_int64(len(rows)),
            ctypes.c_int64(chosen.shape[1]),
            address(np.ascontiguousarray(offsets), "float64"),
            ctypes.c_int64(len(offsets)),
            patches.half,
            ctypes.c_double(weight),
            ctypes.c_double(LEAST_OPACITY),
            address(found),
            thread_count(),
        )
        scores[rows] = found
    return scores


def _best_places(
    scores: np.ndarray, offsets: np.ndarray, watched: np.ndarray, level: SweepLevel
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the displacement of every vertex, its confidence, and the agreement there."""
    # Ties are broken by a cost of 0.02 for each centimetre.
    scores = scores - 0.02 * np.abs(offsets) / 0.01
    rows, last = np.arange(len(scores)), len(offsets) - 1
    k = scores.argmax(axis=1)
    best = scores[rows, k]
    # The maximum of the parabola through the best score and its two neighbours.
    inner = np.clip(k, 1, last - 1)
    before, at, after = (scores[rows, inner + step] for step in (-1, 0, 1))
    bend = before - 2 * at + after
    peak = (k == inner) & (bend < -1e-6)
    part = np.where(peak, 0.5 * (before - after) / np.where(peak, bend, 1.0), 0.0)
    displacement = offsets[k] + np.clip(part, -0.5, 0.5) * level.step
    # Confidence: 0 at an agreement of 0.5 and below, 1 from a margin of 0.2 over the median score; a maximum at the end
    # of the range is hardly one.
    worthless, clear, at_end, anchor = 0.5, 0.2, 0.05, 0.5
    confidence = np.clip((best - worthless) / (1 - worthless), 0, 1)
    confidence *= np.clip((best - np.median(scores, axis=1)) / clear, 0, 1)
    confidence[(k == 0) | (k == last)] *= at_end
    confidence[~watched] = 0.0
    # Vertices without a better place stay: watched ones are anchored, the others follow their neighbours.
    here = scores[:, int(np.abs(offsets).argmin())]
    # Confidence of a vertex that no view sees, which lets its neighbours move it.
    loose = 0.02
    stays = (best - here < level.gain) | (confidence < loose)
    displacement = np.where(stays, 0.0, displacement)
    confidence = np.where(stays, np.where(watched, anchor, loose), confidence)
    return displacement, confidence, np.where(stays, here, best)


def _smoothed(
    mesh: TriangleMesh, displacement: np.ndarray, confidence: np.ndarray, smoothness: float, step: float
) -> np.ndarray:
    """Return smooth displacements near those that were found, by conjugate gradients in four reweighted rounds."""
    laplacian = sparse_laplacian(mesh)
    weight, found = confidence, np.zeros(len(displacement))
    for _ in range(4):
        matrix = sparse.diags(weight + 1e-3) + smoothness * laplacian
        found, _ = cg(matrix, weight * displacement, x0=found, rtol=1e-5, maxiter=400)
        weight = confidence / (1 + ((displacement - found) / (2 * step)) ** 2)
    return found


def sparse_laplacian(mesh: TriangleMesh) -> sparse.csr_matrix:
    """Return the (N, N) graph Laplacian: the number of neighbours on the diagonal, -1 for each neighbour."""
    i, j = mesh.edges.T
    ones, size = np.ones(len(i)), (mesh.vertex_count,) * 2
    adjacency = sparse.coo_matrix((ones, (i, j)), shape=size)
    adjacency = (adjacency + adjacency.T).tocsr()
    return (sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency).tocsr()


def mean_of_neighbours(mesh: TriangleMesh) -> sparse.csr_matrix:
    """Return an (N, N) matrix that averages the neighbours of each vertex."""
    laplacian = sparse_laplacian(mesh)
    count = laplacian.diagonal()
    return sparse.eye(len(count)) - sparse.diags(1.0 / np.maximum(count, 1)) @ laplacian


def smooth_normals(mesh: TriangleMesh, mean: sparse.csr_matrix) -> Float64[np.ndarray, "N 3"]:
    """Return the vertex normals, averaged twice with their neighbours'."""
    normals = mesh.vertex_normals
    for _ in range(2):
        normals = normals + mean @ normals
    return normalize_rows(np.ascontiguousarray(normals))


def taubin(
    mesh: TriangleMesh, mean: sparse.csr_matrix, *, steps: int, fixed: Bool[np.ndarray, " N"] | None = None
) -> TriangleMesh:
    """Smooth a surface without shrinking it, by Taubin's alternating steps of weights 0.5 and -0.53 (1995)."""
    vertices: Float[np.ndarray, "N 3"] = mesh.vertices
    for _ in range(steps):
        for weight in (0.5, -0.53):
            move = weight * (mean @ vertices - vertices)
            vertices = vertices + (move if fixed is None else np.where(fixed[:, None], 0.0, move))
    return mesh.with_vertices(vertices)
