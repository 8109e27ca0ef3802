"""Colours a vertex: blended from the views that look most squarely at it, after their exposures were made alike."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy import sparse
from scipy.sparse.linalg import cg

from smplxpp.core.mesh import TriangleMesh
from smplxpp.reconstruct.photographs import Pyramids, Sight
from smplxpp.reconstruct.sweep import LEAST_COSINE, LEAST_OPACITY, sparse_laplacian

_BEST = 4
_ROUNDS = 5
# A view's colour this far from the others' counts half, of 1: a highlight, or another surface.
_STRANGE = 0.08
_GAINS = (0.5, 2.0)
_GREY = 0.7


def blend_colors(
    mesh: TriangleMesh, seen: Sight, pyramids: Pyramids
) -> tuple[UInt8[np.ndarray, "N 3"], Float64[np.ndarray, "V 3"]]:
    """sRGB of every vertex, and the gain that each view's channels were multiplied by to look alike.

    A view counts by the square of its cosine and by its resolution, the best four of a vertex; one that differs from
    the others counts less. Vertices that no view sees squarely take their neighbours' colours.
    """
    samples, opaque = _sampled(mesh, seen, pyramids)
    weight = np.where(opaque & (seen.cosine > LEAST_COSINE), seen.cosine**2, 0.0)
    weight = weight / np.maximum(seen.pixel, 1e-6)
    order = np.sort(weight, axis=1)
    least = order[:, -min(_BEST, order.shape[1])]
    weight = np.where(weight >= least[:, None], weight, 0.0)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    gains = _gains(samples, weight)
    samples = samples * gains[None].astype(np.float32)
    mean = _mean(samples, weight)
    for _ in range(2):
        off = np.linalg.norm(samples - mean[:, None], axis=2)
        mean = _mean(samples, weight / (1.0 + (off / _STRANGE) ** 2))
    known = weight.sum(axis=1) > 0
    colors = _spread(mesh, mean, known) if known.any() else np.full_like(mean, _GREY)
    return np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8), gains


def _sampled(mesh: TriangleMesh, seen: Sight, pyramids: Pyramids) -> tuple[Float32[np.ndarray, "N V 3"], np.ndarray]:
    """The colours that the views show at the vertices, and whether all of it is the person's."""
    shape = (mesh.vertex_count, len(pyramids.cameras))
    samples, opaque = np.zeros((*shape, 3), np.float32), np.zeros(shape, dtype=bool)
    for k, camera in enumerate(pyramids.cameras):
        rows = np.flatnonzero(seen.cosine[:, k] > LEAST_COSINE)
        screen = camera.screen_from_world(mesh.vertices[rows])
        start, (height, width) = pyramids.starts[k, 0], pyramids.sizes[k, 0]
        image = pyramids.values[start : start + 4 * int(height) * int(width)].reshape(height, width, 4)
        x = np.clip(screen[:, 0] - 0.5, 0, width - 1.001)
        y = np.clip(screen[:, 1] - 0.5, 0, height - 1.001)
        column, row = x.astype(np.int64), y.astype(np.int64)
        du, dv = (x - column)[:, None], (y - row)[:, None]
        corners = [image[row + j, column + i] for j in (0, 1) for i in (0, 1)]
        top = corners[0] + du * (corners[1] - corners[0])
        value = top + dv * (corners[2] + du * (corners[3] - corners[2]) - top)
        samples[rows, k] = value[:, :3]
        opaque[rows, k] = np.min([corner[:, 3] for corner in corners], axis=0) >= LEAST_OPACITY
    return samples, opaque


def _mean(samples: np.ndarray, weight: np.ndarray) -> np.ndarray:
    total = np.maximum(weight.sum(axis=1), 1e-12)
    return np.einsum("nv,nvc->nc", weight, samples, dtype=np.float64) / total[:, None]


def _gains(samples: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(V, 3) factors that bring the views' channels to the mean of what they see together; 1 on the average."""
    shared = (weight > 0).sum(axis=1) >= 2
    samples, weight = samples[shared], weight[shared]
    gains = np.ones((samples.shape[1], 3))
    if not len(samples):
        return gains
    squares = np.einsum("nv,nvc->vc", weight, samples**2, dtype=np.float64)
    for _ in range(_ROUNDS):
        mean = _mean(samples * gains[None], weight)
        products = np.einsum("nv,nvc,nc->vc", weight, samples, mean, dtype=np.float64, optimize=True)
        gains = np.divide(products, squares, out=np.ones_like(products), where=squares > 0)
        gains = np.clip(gains, *_GAINS)
        gains /= np.exp(np.log(gains).mean(axis=0))
    return gains


def _spread(mesh: TriangleMesh, colors: np.ndarray, known: Bool[np.ndarray, " N"]) -> np.ndarray:
    """Colours of the other vertices between those of the known ones, as heat would spread; lone pieces are grey."""
    if known.all():
        return colors
    laplacian = sparse_laplacian(mesh)
    matrix = sparse.diags(known * 1e3 + 1e-6) + laplacian
    out = np.empty_like(colors)
    for channel in range(3):
        right = np.where(known, 1e3 * colors[:, channel], 1e-6 * _GREY)
        start = np.where(known, colors[:, channel], _GREY)
        preconditioner = sparse.diags(1.0 / matrix.diagonal())
        out[:, channel] = cg(matrix, right, x0=start, rtol=1e-6, maxiter=500, M=preconditioner)[0]
    return np.where(known[:, None], colors, out)
