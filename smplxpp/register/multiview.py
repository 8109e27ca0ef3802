"""Points seen by several cameras: consensus of pairs, least squares of the reprojection, a camera against known points.

All of it is for N points at once; a point that a camera does not see has weight 0 there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float64

from smplxpp.core.camera import Camera
from smplxpp.core.rotations import matrix_from_rotvec

_CHUNK = 8192
_STEPS = 8
_NEAR = 1e-3  # metres: what lies nearer, or behind, is not seen
_LEAST_AGREE = 1 / 3  # of the cameras that see a point
_MAD = 1.4826  # of a normal distribution's median of absolute values
_RESECTION_STEPS, _RESECTION_POINTS, _ALMOST = 24, 800, 1.15
# Residuals that a camera's noise is told from: how many, and how far a point may follow the sighting itself.
_LEAST_RESIDUALS, _MOST_LEVERAGE = 60, 0.7


@dataclass(frozen=True, eq=False)
class Sightings:
    """N points in the images of C cameras.

    Attributes:
        K, cam_from_world: of the cameras.
        pixels: where they are seen. weight: 0 where they are not, else up to 1.
        threshold: pixels; a sighting farther than this from a point's projection is not of this point.
        noise: pixels, standard deviation of a coordinate.
    """

    K: Float64[np.ndarray, "C 3 3"]
    cam_from_world: Float64[np.ndarray, "C 3 4"]
    pixels: Float64[np.ndarray, "C N 2"]
    weight: Float64[np.ndarray, "C N"]
    threshold: Float64[np.ndarray, " C"]
    noise: Float64[np.ndarray, " C"]

    @staticmethod
    def of(
        cameras: Sequence[Camera],
        pixels: Float[np.ndarray, "C N 2"],
        weight: Float[np.ndarray, "C N"],
        *,
        threshold: Float[np.ndarray, " C"],
    ) -> Sightings:
        """Sightings by cameras, before the noise is known."""
        K = np.stack([camera.K for camera in cameras])
        poses = np.stack([camera.cam_from_world[:3] for camera in cameras])
        return Sightings(K, poses, pixels, weight, threshold, threshold / 4)

    def of_points(self, rows: np.ndarray | slice) -> Sightings:
        """Those of some of the points."""
        return replace(self, pixels=self.pixels[:, rows], weight=self.weight[:, rows])

    def of_cameras(self, rows: np.ndarray) -> Sightings:
        """Those by some of the cameras."""
        return Sightings(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def residuals(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "C N 2"]:
        """Pixels from the points' projections to where they are seen; infinite behind a camera and for NaN points."""
        cam = _turned(self.cam_from_world, points)
        with np.errstate(invalid="ignore"):
            seen = cam[..., 2] > _NEAR
        plane = cam[..., :2] / np.where(seen, cam[..., 2], 1.0)[..., None]
        uv = plane @ self.K[:, :2, :2].transpose(0, 2, 1) + self.K[:, None, :2, 2]
        return np.where(seen[..., None], self.pixels - uv, np.inf)


def all_pairs(cameras: int, *, most: int, seed: int) -> list[tuple[int, int]]:
    """Pairs of cameras: all, or where these are more than `most` so many at random."""
    pairs = list(combinations(range(cameras), 2))
    if len(pairs) <= most:
        return pairs
    chosen = np.random.default_rng(seed).choice(len(pairs), most, replace=False)
    return [pairs[k] for k in np.sort(chosen)]


def consensus(s: Sightings, pairs: Sequence[tuple[int, int]], *, least_degrees: float) -> Float64[np.ndarray, "N 3"]:
    """Triangulate every point by each pair that sees it, and keep what most cameras agree with (Fischler and Bolles
    1981): the least `sum_c w_c min(r_c^2 / threshold_c^2, 1)` (Torr and Zisserman's MSAC, 2000).

    Pairs whose rays meet at less than `least_degrees` say nothing. Points without any pair are NaN.
    """
    parts = [
        _consensus(s.of_points(slice(start, start + _CHUNK)), pairs, np.cos(np.radians(least_degrees)))
        for start in range(0, s.weight.shape[1], _CHUNK)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _consensus(s: Sightings, pairs: Sequence[tuple[int, int]], most_cosine: float) -> np.ndarray:
    count = s.weight.shape[1]
    best, points = np.full(count, np.inf), np.full((count, 3), np.nan)
    inverse = np.linalg.inv(s.K)
    plane = s.pixels @ inverse[:, :2, :2].transpose(0, 2, 1) + inverse[:, None, :2, 2]
    rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=2) @ s.cam_from_world[:, :, :3]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    # Rows of A x = b: (u r_3 - r_1) x = t_1 - u t_3, and the same for v.
    R, t = s.cam_from_world[:, :, :3], s.cam_from_world[:, :, 3]
    A = plane[..., None] * R[:, None, 2:] - R[:, None, :2]
    b = t[:, None, :2] - plane * t[:, None, 2:]
    normal = A.transpose(0, 1, 3, 2) @ A
    right = (A.transpose(0, 1, 3, 2) @ b[..., None])[..., 0]
    for one, other in pairs:
        meet = (s.weight[one] > 0) & (s.weight[other] > 0)
        meet &= np.abs(np.einsum("nx,nx->n", rays[one], rays[other])) < most_cosine
        rows = np.flatnonzero(meet)
        if not len(rows):
            continue
        sums = normal[one, rows] + normal[other, rows], right[one, rows] + right[other, rows]
        found = np.linalg.solve(sums[0], sums[1][..., None])[..., 0]
        own = s.of_points(rows)
        squares = (own.residuals(found) ** 2).sum(axis=2) / s.threshold[:, None] ** 2
        cost = (own.weight * np.minimum(squares, 1.0)).sum(axis=0)
        better = cost < best[rows]
        best[rows[better]], points[rows[better]] = cost[better], found[better]
    return points


def refine(
    s: Sightings, points: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3 3"], Bool[np.ndarray, "C N"]]:
    """Minimise the reprojection of the inliers by Gauss-Newton with Cauchy's weights, `w / (1 + r^2 / (3 noise)^2)`.

    Returns:
        The points, their covariances in square metres (inverse of the normal matrix, each sighting with the camera's
        noise and its weight), and which sightings count. NaN where fewer than two cameras, or fewer than a third of
        those that see the point, count.
    """
    parts = [
        _refine(s.of_points(slice(start, start + _CHUNK)), points[start : start + _CHUNK])
        for start in range(0, len(points), _CHUNK)
    ] or [(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((len(s.K), 0), dtype=bool))]
    found, covariance, inliers = zip(*parts, strict=True)
    return np.concatenate(found), np.concatenate(covariance), np.concatenate(inliers, axis=1)


def _refine(s: Sightings, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    limit = np.clip(4.0 * s.noise, 0.25 * s.threshold, s.threshold)[:, None]
    points = points.copy()
    covariance = np.full((len(points), 3, 3), np.nan)
    for step in range(_STEPS):
        residual = s.residuals(points)
        length = np.linalg.norm(residual, axis=2)
        # The first steps take all that the consensus took: it stands on two cameras, and is off by their noise.
        inliers = (s.weight > 0) & (length < (s.threshold[:, None] if step < _STEPS // 2 else limit))
        good = inliers.sum(axis=0) >= np.maximum(2, _LEAST_AGREE * (s.weight > 0).sum(axis=0))
        weight = np.where(inliers & good, s.weight, 0.0) / s.noise[:, None] ** 2
        rows = np.flatnonzero(good)
        J = _slopes(s, points[rows])
        if step == _STEPS - 1:
            covariance[rows] = np.linalg.inv(_normal(J, weight[:, rows]) + 1e-12 * np.eye(3))
            points[~good] = np.nan
            return points, covariance, inliers & good
        with np.errstate(invalid="ignore"):
            weight = (weight / (1.0 + (length / (3.0 * s.noise[:, None])) ** 2))[:, rows]
        pull = weight[..., None] * np.where(weight[..., None] > 0, residual[:, rows], 0.0)
        right = (J.transpose(0, 1, 3, 2) @ pull[..., None]).sum(axis=0)
        points[rows] += np.linalg.solve(_normal(J, weight) + 1e-9 * np.eye(3), right)[..., 0]
    raise AssertionError("unreachable")


def pixel_noise(
    s: Sightings, points: Float64[np.ndarray, "N 3"], inliers: Bool[np.ndarray, "C N"], *, unit: Float[np.ndarray, " C"]
) -> Float64[np.ndarray, " C"]:
    """The standard deviation of a coordinate in each camera's pixels, from the median of absolute residuals.

    A residual falls short of the noise because the point follows its sightings, by `sqrt(1 - h)` with the leverage
    `h = w J C J^T / noise^2`; sightings that a point follows altogether say nothing and are left out. A camera's noise
    is between a half and four times of all cameras', in each camera's unit: that of a close-up, which its points follow
    most, could else shrink without end.

    Args:
        s: with the noise that the points were refined with.
        points, inliers: as refined.
        unit: pixels, what cameras' noise is compared in (a share of their images' heights).
    """
    rows = np.flatnonzero(inliers.any(axis=0))
    J, weight = _slopes(s, points[rows]), np.where(inliers[:, rows], s.weight[:, rows], 0.0) / s.noise[:, None] ** 2
    covariance = np.linalg.inv(_normal(J, weight) + 1e-12 * np.eye(3))
    leverage = weight[..., None] * ((J @ covariance) * J).sum(axis=3)
    size = np.abs(s.residuals(points))[:, rows] / np.sqrt(np.maximum(1.0 - leverage, 1e-3)) / unit[:, None, None]
    telling = inliers[:, rows, None] & (leverage < _MOST_LEVERAGE)
    everything = size[telling]
    common = _MAD * float(np.median(everything)) if len(everything) else 1.0
    counts = telling.sum(axis=(1, 2))
    own = [_MAD * np.median(size[c][telling[c]]) if n >= _LEAST_RESIDUALS else common for c, n in enumerate(counts)]
    return np.maximum(np.clip(own, 0.5 * common, 4.0 * common), 0.04) * unit


@dataclass(frozen=True, eq=False)
class Resection:
    """Where a camera would have to stand to see known points where it says that it sees them.

    Attributes:
        pose: its transform, `x_cam = R x_world + t`.
        median: of the distances that are left, as shares of the camera's threshold.
        moved: median of the distances by which the points' projections move, as shares of it.
    """

    pose: Float64[np.ndarray, "3 4"]
    median: float
    moved: float


def resection(s: Sightings, camera: int, points: Float64[np.ndarray, "N 3"]) -> Resection:
    """Find a camera's pose from known points: turned about its own centre, or, where that leaves clearly more, moved as
    well (from some metres a small turn and a small shift look almost alike)."""
    turned = _resection(s, camera, points, numbers=3)
    moved = _resection(s, camera, points, numbers=6)
    return turned if turned.median < _ALMOST * moved.median else moved


def _resection(s: Sightings, camera: int, points: Float64[np.ndarray, "N 3"], *, numbers: int) -> Resection:
    """Gauss-Newton over a turn, and with six numbers a shift, with Cauchy's weights whose scale falls from thirty
    thresholds to a half; of many points some, evenly, are enough."""
    rows = np.flatnonzero(np.isfinite(points).all(axis=1) & (s.weight[camera] > 0))
    rows = rows[:: max(1, len(rows) // _RESECTION_POINTS)]
    given, known = s.of_cameras(np.array([camera])).of_points(rows), points[rows]
    own, threshold = given, float(s.threshold[camera])
    for scale in np.geomspace(30.0, 0.5, _RESECTION_STEPS) * threshold:
        residual = own.residuals(known)[0]
        seen = np.isfinite(residual[:, 0])
        residual = np.where(seen[:, None], residual, 0.0)
        weight = own.weight[0] / (1.0 + (residual**2).sum(axis=1) / scale**2)
        J = _camera_slopes(own.K[0], _turned(own.cam_from_world, known)[0], seen)[..., :numbers]
        weighted = (J * weight[:, None, None]).reshape(-1, numbers).T
        normal = weighted @ J.reshape(-1, numbers) + 1e-9 * np.eye(numbers)
        step = np.concatenate([np.linalg.solve(normal, weighted @ residual.ravel()), np.zeros(6 - numbers)])
        turn, pose = matrix_from_rotvec(step[:3]), own.cam_from_world[0]
        shifted = np.concatenate([turn @ pose[:, :3], (turn @ pose[:, 3] + step[3:])[:, None]], axis=1)
        own = replace(own, cam_from_world=shifted[None])
    before, after = given.residuals(known)[0], own.residuals(known)[0]
    both = np.isfinite(before[:, 0]) & np.isfinite(after[:, 0])
    if not both.any():
        return Resection(own.cam_from_world[0], np.inf, np.inf)
    moved = float(np.median(np.linalg.norm((after - before)[both], axis=1)))
    left = float(np.median(np.linalg.norm(after, axis=1)))
    return Resection(own.cam_from_world[0], left / threshold, moved / threshold)


def _turned(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(C, N, 3) points in the cameras' frames."""
    return points @ poses[:, :, :3].transpose(0, 2, 1) + poses[:, None, :, 3]


def _plane_slopes(K: np.ndarray, cam: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(..., 2, 3) pixels by metres in the camera's frame; 0 for what is not seen."""
    one = np.where(seen, 1.0 / np.where(seen, cam[..., 2], 1.0), 0.0)
    out = np.empty((*cam.shape[:-1], 2, 3))
    out[..., :2] = K[..., :2, :2] * one[..., None, None]
    xy = np.where(seen[..., None], cam[..., :2], 0.0) * one[..., None] ** 2
    out[..., 2] = -(xy[..., None, :] * K[..., :2, :2]).sum(axis=-1)
    return out


def _normal(J: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(N, 3, 3) sums over cameras of weighted `J^T J`."""
    rows = (J * np.sqrt(weight)[..., None, None]).transpose(1, 0, 2, 3).reshape(J.shape[1], -1, 3)
    return rows.transpose(0, 2, 1) @ rows


def _slopes(s: Sightings, points: np.ndarray) -> np.ndarray:
    """(C, N, 2, 3) pixels by metres in the world."""
    cam = _turned(s.cam_from_world, points)
    return _plane_slopes(s.K[:, None], cam, cam[..., 2] > _NEAR) @ s.cam_from_world[:, None, :, :3]


def _camera_slopes(K: np.ndarray, cam: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(N, 2, 6) pixels by a turn of the camera's frame, radians, and a shift, metres: `x <- exp(d) x + e`."""
    plane = _plane_slopes(K, cam, seen)
    x, y, z = cam.T
    zero = np.zeros_like(x)
    # d x = -[x]_x d
    turned = np.stack([np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)], 1)
    return np.concatenate([plane @ turned, plane], axis=2)
