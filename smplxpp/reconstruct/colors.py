"""Blend a colour for every vertex from the views that see it most frontally, after their exposures are equalised."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy import sparse
from scipy.sparse.linalg import cg

from smplxpp.core.mesh import TriangleMesh
from smplxpp.reconstruct.photographs import Pyramids, Sight
from smplxpp.reconstruct.sweep import LEAST_COSINE, LEAST_OPACITY, sparse_laplacian

# Colour of vertices about which no view says anything, in [0, 1].
_GREY = 0.7


def blend_colors(
    mesh: TriangleMesh, seen: Sight, pyramids: Pyramids
) -> tuple[UInt8[np.ndarray, "N 3"], Float64[np.ndarray, "V 3"]]:
    """Return the sRGB colour of every vertex, and the gain of each view's channels that equalises their exposures.

    The four best views of a vertex are averaged, weighted by the square of the cosine and by resolution, and robustly:
    a view whose colour differs by 0.08 from the mean has half the weight, because it shows a highlight or another
    surface. Vertices that no view sees well get colours from their neighbours.
    """
    best, outlier = 4, 0.08
    samples, opaque = _sampled(mesh, seen, pyramids)
    # Frontal views count most; a pixel that covers more of the surface counts less. Then keep the best four a vertex.
    weight = np.where(opaque & (seen.cosine > LEAST_COSINE), seen.cosine**2, 0.0)
    weight = weight / np.maximum(seen.pixel, 1e-6)
    order = np.sort(weight, axis=1)
    least = order[:, -min(best, order.shape[1])]
    weight = np.where(weight >= least[:, None], weight, 0.0)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    # Exposures are equalised before the robust mean, or a darker camera would look like an outlier everywhere.
    gains = _gains(samples, weight)
    samples = samples * gains[None].astype(np.float32)
    # Two rounds of iteratively reweighted means with Cauchy weights.
    mean = _mean(samples, weight)
    for _ in range(2):
        off = np.linalg.norm(samples - mean[:, None], axis=2)
        mean = _mean(samples, weight / (1.0 + (off / outlier) ** 2))
    known = weight.sum(axis=1) > 0
    colors = _spread(mesh, mean, known) if known.any() else np.full_like(mean, _GREY)
    return np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8), gains


def _sampled(mesh: TriangleMesh, seen: Sight, pyramids: Pyramids) -> tuple[Float32[np.ndarray, "N V 3"], np.ndarray]:
    """Sample the views at the vertices bilinearly; return colours, and whether all four pixels are the person's."""
    shape = (mesh.vertex_count, len(pyramids.cameras))
    samples, opaque = np.zeros((*shape, 3), np.float32), np.zeros(shape, dtype=bool)
    for k in range(len(pyramids.cameras)):
        rows = np.flatnonzero(seen.cosine[:, k] > LEAST_COSINE)
        screen = pyramids.screen(k, mesh.vertices)[rows]
        start, (height, width) = pyramids.starts[k, 0], pyramids.sizes[k, 0]
        image = pyramids.values[start : start + 4 * int(height) * int(width)].reshape(height, width, 4)
        # Pixel centres lie at half-integers. The clamp keeps the right and lower neighbour inside the image.
        x = np.clip(screen[:, 0] - 0.5, 0, width - 1.001)
        y = np.clip(screen[:, 1] - 0.5, 0, height - 1.001)
        column, row = x.astype(np.int64), y.astype(np.int64)
        du, dv = (x - column)[:, None], (y - row)[:, None]
        corners = [image[row + j, column + i] for j in (0, 1) for i in (0, 1)]
        # Bilinear interpolation: along the row above and below, then between them.
        top = corners[0] + du * (corners[1] - corners[0])
        value = top + dv * (corners[2] + du * (corners[3] - corners[2]) - top)
        samples[rows, k] = value[:, :3]
        opaque[rows, k] = np.min([corner[:, 3] for corner in corners], axis=0) >= LEAST_OPACITY
    return samples, opaque


def _mean(samples: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted mean over views."""
    total = np.maximum(weight.sum(axis=1), 1e-12)
    return np.einsum("nv,nvc->nc", weight, samples, dtype=np.float64) / total[:, None]


def _gains(samples: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return (V, 3) gains that minimise the differences of the views' channels where several see a vertex.

    Five rounds of alternating least squares between the gains and the vertices' mean colours; the geometric mean of the
    gains is 1, and each lies between 0.5 and 2.
    """
    shared = (weight > 0).sum(axis=1) >= 2
    samples, weight = samples[shared], weight[shared]
    gains = np.ones((samples.shape[1], 3))
    if not len(samples):
        return gains
    squares = np.einsum("nv,nvc->vc", weight, samples**2, dtype=np.float64)
    # With means m fixed, each gain is g = sum w s m / sum w s^2; with gains fixed, m is the weighted mean of g s.
    for _ in range(5):
        mean = _mean(samples * gains[None], weight)
        products = np.einsum("nv,nvc,nc->vc", weight, samples, mean, dtype=np.float64, optimize=True)
        gains = np.divide(products, squares, out=np.ones_like(products), where=squares > 0)
        gains = np.clip(gains, 0.5, 2.0)
        # A common factor would change nothing but the brightness; the geometric mean fixes it at 1.
        gains /= np.exp(np.log(gains).mean(axis=0))
    return gains


def _spread(mesh: TriangleMesh, colors: np.ndarray, known: Bool[np.ndarray, " N"]) -> np.ndarray:
    """Interpolate the colours of unknown vertices harmonically between known ones; isolated components are grey.

    Solves `(D + L) c = D c0` with the graph Laplacian L, and D large at known vertices and tiny elsewhere.
    """
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
