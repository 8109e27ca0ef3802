"""Whether a scan is the mirror image of the person: by its shape, or by its colours in photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import igl
import numpy as np
from jaxtyping import Float, Float64
from scipy.ndimage import binary_erosion, uniform_filter

from smplxpp.core import Camera, MeshLike, PointsLike, TriangleMesh, as_mesh, as_points, spread
from smplxpp.core.rotations import rotation_between
from smplxpp.raster import rasterize_mesh

_STEPS = 15
# Farther points are capped: a coat's hem must not outvote the hands.
_CAP = 0.03
# Pixels of a view that colours are averaged over, and that a silhouette is drawn in by: sampling, mixed edges.
_BLUR = 3
_INSIDE = 2
_LEAST_PIXELS = 200
# Largest shift of a view as a share of an image's longer side, the step of the search, and the pixels it looks at.
_REACH = 0.03
_STEP = 3
_SEARCHED = 3_000
_ALIGNED = 3_000
# Largest local shift of colours in pixels, and the window in which the smallest difference is searched.
_LOCAL = 2
_WINDOW = 25
# Share of that variance below which the two look the same.
_SAME = 1e-3


def mirrored_by_views(
    scan: MeshLike,
    colors: Float[np.ndarray, "N 3"],
    views: Sequence[tuple[Camera, Float[np.ndarray, "_ _ 3"]]],
    *,
    body: MeshLike,
    center: Float64[np.ndarray, " 3"],
    across: Float64[np.ndarray, " 3"],
) -> float | None:
    """Return the place of photographs between the colours of a scan (0) and those of its mirror image (1).

    Both are drawn into every view, given the gain and offset of each channel with which they come closest to the
    photograph, and moved by a few pixels, first as a whole and then locally: what a stripe is off by must not count.
    The photograph is then projected on their difference where both cover it. A person whose shape and colours are
    symmetric gives 0.5. As a fit is never exact, the image is tried where it lies best on the scan and where it lies
    best on the body; the scan as it is and on the body.

    Args:
        colors: of the scan's vertices.
        views: cameras, and what they saw, of their size; a few hundred pixels do.
        body: in the scan's pose.
        center: as `mirror_ratio` takes it.
        across: as `mirror_ratio` takes it.

    Returns:
        None where the photographs look like neither, or no view shows enough.
    """
    # Least share of the photographs' variance that the scan or its image explains: below it they show something
    # else.
    least_explained = 0.4
    scan = as_mesh(scan, subject="scan")
    body = as_mesh(body, subject="body")
    # A reflection turns faces inside out, so that their order of corners is reversed.
    image = TriangleMesh(reflected(scan.vertices, center, across), np.ascontiguousarray(scan.faces[:, ::-1]))
    given, other = (
        min((_seen(mesh, colors, views) for mesh in meshes), key=lambda seen: seen.unexplained)
        for meshes in ((scan, _moved_to(scan, body)), (_moved_to(image, scan), _moved_to(image, body)))
    )
    # Photographs of something else, or a wrong calibration, decide nothing.
    if min(given.unexplained, other.unexplained) > 1.0 - least_explained:
        return None
    # Project the photograph on the line from the scan's rendering h to the mirror image's m, over all views at once:
    #   place = sum (p - h) . (m - h) / sum |m - h|^2, which minimises |p - h - place (m - h)|^2.
    along, length, variance = 0.0, 0.0, 0.0
    for one, two in zip(given.views, other.views, strict=True):
        if one is None or two is None:
            continue
        here, there = _locally_moved(one), _locally_moved(two)
        both = np.isfinite(here[..., 0]) & np.isfinite(there[..., 0])
        direction = there[both] - here[both]
        along += float(((one.photograph[both] - here[both]) * direction).sum())
        length += float((direction**2).sum())
        variance += one.variance
    return 0.5 if length <= _SAME * variance else along / length


@dataclass(frozen=True, eq=False)
class _View:
    """A mesh drawn over a photograph.

    Attributes:
        photograph, drawn: (H, W, 3); the second is NaN where the mesh is not, and near its edge.
        variance, residual: sums over the drawn pixels of the photograph's squares about its mean, and about `drawn`.
    """

    photograph: Float64[np.ndarray, "H W 3"]
    drawn: Float64[np.ndarray, "H W 3"]
    variance: float
    residual: float


@dataclass(frozen=True, eq=False)
class _Seen:
    """A mesh in all views; None where too little of it shows."""

    views: list[_View | None]

    @property
    def unexplained(self) -> float:
        """Share of the photographs' variance that the mesh leaves; 1 without views."""
        seen = [view for view in self.views if view is not None]
        variance = sum(view.variance for view in seen)
        return sum(view.residual for view in seen) / variance if variance else 1.0


def _seen(mesh: TriangleMesh, colors: np.ndarray, views: Sequence[tuple[Camera, np.ndarray]]) -> _Seen:
    return _Seen([_view(mesh, colors, camera, photograph) for camera, photograph in views])


def _view(mesh: TriangleMesh, colors: np.ndarray, camera: Camera, photograph: np.ndarray) -> _View | None:
    maps = rasterize_mesh(mesh, camera)
    # Pixels well inside the silhouette, because its border mixes person and background.
    row, col = np.nonzero(binary_erosion(maps.mask, iterations=_INSIDE))
    if len(row) < _LEAST_PIXELS:
        return None
    drawn = _blurred(maps.interpolate(mesh.faces, colors))
    # Normalised convolution: blur the colours and the mask, and divide, so that the background does not darken borders.
    share = uniform_filter(maps.mask.astype(np.float64), _BLUR)
    drawn = drawn[row, col] / share[row, col, None]
    photograph = _blurred(np.asarray(photograph, dtype=np.float64))
    down, right = _offset(drawn, photograph, row, col)
    row, col = row + down, col + right
    inside = (row >= 0) & (row < camera.height) & (col >= 0) & (col < camera.width)
    row, col, drawn = row[inside], col[inside], drawn[inside]
    there = photograph[row, col]
    # Gain and offset of each channel absorb exposure and white balance, of which a scan's colours know nothing.
    gain, rest = _gain(drawn, there)
    out = np.full_like(photograph, np.nan)
    out[row, col] = there.mean(axis=0) + gain * (drawn - drawn.mean(axis=0))
    variance = float(((there - there.mean(axis=0)) ** 2).sum())
    return _View(photograph, out, variance, rest * variance)


def _offset(drawn: np.ndarray, photograph: np.ndarray, row: np.ndarray, col: np.ndarray) -> tuple[int, int]:
    """Return the shift, in pixels down and to the right, that fits drawn colours best to a photograph."""
    height, width = photograph.shape[:2]
    chosen = np.array(spread(range(len(row)), _SEARCHED))
    drawn, row, col = drawn[chosen], row[chosen], col[chosen]

    def unexplained(move: tuple[int, int]) -> float:
        there = photograph[np.clip(row + move[0], 0, height - 1), np.clip(col + move[1], 0, width - 1)]
        return _gain(drawn, there)[1]

    reach = int(_REACH * max(height, width))
    # The middle first: of equals it is the one.
    steps = sorted(range(-(reach // _STEP) * _STEP, reach + 1, _STEP), key=abs)
    down, right = min(((i, j) for i in steps for j in steps), key=unexplained)
    return min(((down + i, right + j) for i in (0, -1, 1) for j in (0, -1, 1)), key=unexplained)


def _locally_moved(view: _View) -> np.ndarray:
    """The drawn colours (H, W, 3), each moved by the few pixels with which its surroundings fit the photograph best."""
    out = np.full_like(view.drawn, np.nan)
    row, col = np.nonzero(np.isfinite(view.drawn[..., 0]))
    if not len(row):
        return out
    box = (slice(row.min(), row.max() + 1), slice(col.min(), col.max() + 1))
    drawn, photograph = view.drawn[box].astype(np.float32), view.photograph[box].astype(np.float32)
    best, least = drawn.copy(), np.full(drawn.shape[:2], np.inf, dtype=np.float32)
    # Try zero offset first, so that ties keep it.
    # Block matching: the squared difference, averaged over a window, decides for each pixel.
    for move in sorted(product(range(-_LOCAL, _LOCAL + 1), repeat=2), key=lambda move: max(map(abs, move))):
        moved = np.roll(drawn, move, (0, 1))
        covered = np.isfinite(moved[..., 0])
        rest = np.where(covered, ((moved - photograph) ** 2).sum(axis=-1), 0.0)
        rest = uniform_filter(rest, _WINDOW) / np.maximum(uniform_filter(covered.astype(np.float32), _WINDOW), 1e-3)
        better = covered & (rest < least)
        least[better], best[better] = rest[better], moved[better]
    best[np.isnan(drawn[..., 0])] = np.nan
    out[box] = best
    return out


def _gain(drawn: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, float]:
    """The gain (3,), never negative, of each channel, and the share of the variance that is left with it."""
    x, y = drawn - drawn.mean(axis=0), there - there.mean(axis=0)
    spread_x, spread_y = (x**2).mean(axis=0), (y**2).mean(axis=0)
    both = np.maximum((x * y).mean(axis=0), 0.0)
    gain = both / np.maximum(spread_x, 1e-12)
    return gain, float((spread_y - gain * both).sum() / max(float(spread_y.sum()), 1e-12))


def _blurred(values: np.ndarray) -> np.ndarray:
    return uniform_filter(values, (_BLUR, _BLUR, 1))


def _moved_to(mesh: TriangleMesh, target: TriangleMesh) -> TriangleMesh:
    """A mesh moved rigidly to where it fits another best."""
    before = mesh.vertices[spread(range(mesh.vertex_count), _ALIGNED)]
    after = aligned(before, target, search_tree(target))
    here, there = before.mean(axis=0), after.mean(axis=0)
    return mesh.with_vertices((mesh.vertices - here) @ rotation_between(before - here, after - there) + there)


def mirror_ratio(
    points: PointsLike,
    body: MeshLike,
    *,
    center: Float64[np.ndarray, " 3"],
    across: Float64[np.ndarray, " 3"],
) -> float:
    """The distance of points to a body over that of their mirror image, each moved rigidly to where it fits best.

    Above 1 the mirror image fits better. A person whose pose and shape are symmetric gives 1: no geometry can tell
    her from her image.

    Args:
        points: of the scan, skin at best.
        body: in the scan's pose.
        center: a point of the plane to mirror at: the body's middle.
        across: the plane's normal: from hip to hip.
    """
    body = as_mesh(body, subject="body")
    found, _ = as_points(points)
    tree = search_tree(body)
    one, other = (_aligned_distance(each, body, tree) for each in (found, reflected(found, center, across)))
    return one / max(other, 1e-9)


def reflected(
    points: Float64[np.ndarray, "P 3"], center: Float64[np.ndarray, " 3"], across: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "P 3"]:
    """The mirror image of points at the plane through `center` with the normal `across`, of any length."""
    normal = across / np.linalg.norm(across)
    return points - 2.0 * np.outer((points - center) @ normal, normal)


def search_tree(mesh: TriangleMesh) -> igl.AABB:
    """The tree in which the closest points of a mesh are found."""
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    return tree


def _aligned_distance(points: np.ndarray, body: TriangleMesh, tree: igl.AABB) -> float:
    """Mean capped distance of points that are moved rigidly to where they fit best."""
    squared, _, _ = tree.squared_distance(body.vertices, body.faces, np.ascontiguousarray(aligned(points, body, tree)))
    return float(np.minimum(np.sqrt(squared), _CAP).mean())


def aligned(points: Float64[np.ndarray, "P 3"], body: TriangleMesh, tree: igl.AABB) -> Float64[np.ndarray, "P 3"]:
    """Points after rigid steps towards the closest ones of a mesh (Besl and McKay 1992); `tree` is the mesh's."""
    for _ in range(_STEPS):
        squared, _, closest = tree.squared_distance(body.vertices, body.faces, points)
        distance = np.sqrt(squared)
        used = distance <= max(_CAP, 2.0 * float(np.median(distance)))
        here, there = points[used].mean(axis=0), closest[used].mean(axis=0)
        points = (points - here) @ rotation_between(points[used] - here, closest[used] - there) + there
    return points
