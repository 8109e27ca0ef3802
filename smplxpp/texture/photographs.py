"""Colours of a scan's surface from photographs: seen by z-buffer, weighed by angle and border, blended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.ndimage import distance_transform_edt

from smplxpp.core import Camera, TriangleMesh
from smplxpp.core.errors import one_line
from smplxpp.raster import rasterize_mesh

# Pixels from a silhouette or a step in depth within which a photograph fades: there the background and the lens's blur
# run into the colours.
_FEATHER = 6.0
# Metres that a point may lie behind the depth of its pixel and be seen; more than a scan's noise and a pixel's slope.
_BEHIND = 0.006
# Metres between the depths of neighbouring pixels from which they belong to two surfaces.
_STEP = 0.02
_LEAST_COSINE = 0.15  # between the surface and the view: flatter views smear a pixel over centimetres
# Weights are raised to this power: at 1 four views blur each other, at 8 seams show; by eye on two captures.
_SHARPNESS = 3
# Weight of all views together below which the scan's own colour comes in.
_ENOUGH = 0.02
_BEST = 4  # views of a face that are blended
_ROUNDS = 30  # of alternating least squares between gains and colours
_MOST_VERTICES = 20_000  # whose colours decide the gains

Painter = Callable[[Int64[np.ndarray, " T"], Float64[np.ndarray, "T 3"]], UInt8[np.ndarray, "T 3"]]


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph with its camera.

    Attributes:
        camera: of the photograph, without distortion.
        color: sRGB.
    """

    camera: Camera
    color: UInt8[np.ndarray, "H W 3"]

    __repr__ = one_line


def finer_than_the_scan(mesh: TriangleMesh, photographs: Sequence[Photograph]) -> bool:
    """Tell whether a pixel of the middling photograph covers less of the surface than an edge of the scan is long."""
    center = mesh.vertices.mean(axis=0)
    pixels = [float(photo.camera.screen_from_world(center[None])[0, 2] / photo.camera.K[1, 1]) for photo in photographs]
    edges = mesh.vertices[mesh.edges]
    length = np.median(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1))
    return bool(np.median(pixels) < length) if pixels else False


class PhotographPainter:
    """Paints points of a scan from photographs.

    The weight of a view is the cosine between surface and view, squared, times a ramp over the pixels beside
    silhouettes and steps in depth, raised to a power so that the best views decide. Exposures are evened by gains a
    view and channel, which minimise the differences of the views where several see a vertex.

    Args:
        mesh: the scan, in the photographs' world.
        photographs: of one moment.
        otherwise: paints what no photograph sees, and comes in where they see badly.
    """

    def __init__(self, mesh: TriangleMesh, photographs: Sequence[Photograph], otherwise: Painter) -> None:
        self._mesh, self._photographs, self._otherwise = mesh, list(photographs), otherwise
        self._depths = [rasterize_mesh(mesh, photo.camera).depth for photo in photographs]
        self._ramps = [_ramp(depth) for depth in self._depths]
        self.gains = np.ones((len(self._photographs), 3))
        samples, weights = self._sampled(mesh.vertices, mesh.vertex_normals)
        # Views that see a corner of a face, the best four: others would be projected to for nothing.
        best = weights[mesh.faces].max(axis=1)
        least = np.sort(best, axis=1)[:, -min(_BEST, best.shape[1])]
        self._views = (best > 0) & (best >= least[:, None])
        rows = np.linspace(0, mesh.vertex_count - 1, min(mesh.vertex_count, _MOST_VERTICES)).astype(np.int64)
        samples, weights = samples[rows], weights[rows]
        # Without the power: where one view decides, the others tell nothing of its exposure.
        self.gains = _gains(samples, weights ** (1.0 / _SHARPNESS))

    def __call__(
        self, face: Int64[np.ndarray, " T"], barycentric: Float64[np.ndarray, "T 3"]
    ) -> UInt8[np.ndarray, "T 3"]:
        """Return the sRGB colours of points on faces."""
        points = np.einsum("tk,tkd->td", barycentric, self._mesh.triangles[face])
        normals = np.einsum("tk,tkd->td", barycentric, self._mesh.vertex_normals[self._mesh.faces[face]])
        samples, weights = self._sampled(points, normals, self._views[face])
        total = weights.sum(axis=1, keepdims=True)
        blended = np.einsum("tv,tvc->tc", weights, samples) / np.maximum(total, 1e-12)
        # Between photographs and the scan's own colour there is no step either.
        share = np.clip(total / _ENOUGH, 0.0, 1.0)
        own = self._otherwise(face, barycentric).astype(np.float32)
        return np.rint(np.clip(share * blended + (1.0 - share) * own, 0, 255)).astype(np.uint8)

    def _sampled(
        self,
        points: Float64[np.ndarray, "T 3"],
        normals: Float64[np.ndarray, "T 3"],
        views: Bool[np.ndarray, "T N"] | None = None,
    ) -> tuple[Float32[np.ndarray, "T N 3"], Float64[np.ndarray, "T N"]]:
        """Sample every view bilinearly, gains applied, and weigh it; a view that does not see a point weighs 0."""
        samples = np.zeros((len(points), len(self._photographs), 3), np.float32)
        weights = np.zeros((len(points), len(self._photographs)))
        for k, photo in enumerate(self._photographs):
            camera, depth = photo.camera, self._depths[k]
            tried = np.arange(len(points)) if views is None else np.flatnonzero(views[:, k])
            screen = camera.screen_from_world(points[tried])
            # The four pixels about the point must all exist and show its surface.
            with np.errstate(invalid="ignore"):
                inside = (screen[:, 2] > 0) & (np.abs(screen[:, 0] - camera.width / 2) < camera.width / 2 - 1)
                inside &= np.abs(screen[:, 1] - camera.height / 2) < camera.height / 2 - 1
            rows, screen = tried[inside], screen[inside]
            x, y, z = screen[:, 0] - 0.5, screen[:, 1] - 0.5, screen[:, 2]
            column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
            near = np.rint(y).astype(np.int64), np.rint(x).astype(np.int64)
            view = camera.position - points[rows]
            cosine = np.einsum("td,td->t", normals[rows], view) / np.maximum(np.linalg.norm(view, axis=1), 1e-9)
            seen = (cosine > _LEAST_COSINE) & (z < depth[near] + _BEHIND / np.maximum(cosine, _LEAST_COSINE))
            rows, column, row, near = rows[seen], column[seen], row[seen], (near[0][seen], near[1][seen])
            du, dv = (x[seen] - column)[:, None], (y[seen] - row)[:, None]
            above = photo.color[row, column] * (1 - du) + photo.color[row, column + 1] * du
            below = photo.color[row + 1, column] * (1 - du) + photo.color[row + 1, column + 1] * du
            samples[rows, k] = (above * (1 - dv) + below * dv) * self.gains[k]
            weights[rows, k] = (cosine[seen] ** 2 * self._ramps[k][near]) ** _SHARPNESS
        return samples, weights


def _ramp(depth: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Return 0 on the background, at silhouettes and steps in depth, rising to 1 over `_FEATHER` pixels."""
    finite = np.where(np.isfinite(depth), depth, 0.0)
    good = np.isfinite(depth)
    for axis in (0, 1):
        step = np.abs(np.diff(finite, axis=axis)) > _STEP
        low = [slice(None), slice(None)]
        high = [slice(None), slice(None)]
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        good[tuple(low)] &= ~step
        good[tuple(high)] &= ~step
    distance = distance_transform_edt(np.pad(good, 1))[1:-1, 1:-1]
    return np.clip((distance - 1.0) / _FEATHER, 0.0, 1.0).astype(np.float32)


def _gains(samples: Float32[np.ndarray, "T N 3"], weights: Float64[np.ndarray, "T N"]) -> Float64[np.ndarray, "N 3"]:
    """Return gains that minimise the views' differences where several see a point; their geometric mean is 1."""
    gains = np.ones((samples.shape[1], 3))
    shared = (weights > 0).sum(axis=1) >= 2
    samples, weights = samples[shared], weights[shared]
    if not len(samples):
        return gains
    # With colours m fixed, a gain is sum w s m / sum w s^2; with gains fixed, m is the weighted mean of g s.
    squares = np.einsum("tn,tnc->nc", weights, samples.astype(np.float64) ** 2)
    for _ in range(_ROUNDS):
        mean = np.einsum("tn,tnc,nc->tc", weights, samples, gains) / weights.sum(axis=1)[:, None]
        products = np.einsum("tn,tnc,tc->nc", weights, samples, mean)
        gains = np.clip(np.divide(products, squares, out=np.ones_like(products), where=squares > 0), 0.5, 2.0)
        gains /= np.exp(np.log(gains).mean(axis=0))
    return gains
