"""Solve multiple-view geometry for many points at once: consensus triangulation, refinement, pixel noise, resection.

All functions work on N points and C cameras; a point that a camera does not see has weight 0 there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float64

from smplxpp.core import Camera, matrix_from_rotvec

# Points that are solved at once, which bounds the memory.
_CHUNK = 8192
# Depth in metres from which a point is in front of a camera.
_NEAR = 1e-3


@dataclass(frozen=True, eq=False)
class Sightings:
    """N points in the images of C cameras.

    Attributes:
        K: intrinsic matrices.
        cam_from_world: poses, `x_cam = R x_world + t`.
        pixels: where the points are seen.
        weight: 0 where a point is not seen, else up to 1.
        threshold: largest distance of an inlier from the point's projection, pixels.
        noise: standard deviation of a coordinate, pixels.
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
        """Collect sightings of cameras whose noise is not known yet; a quarter of the threshold stands for it."""
        K = np.stack([camera.K for camera in cameras])
        poses = np.stack([camera.cam_from_world[:3] for camera in cameras])
        return Sightings(K, poses, pixels, weight, threshold, threshold / 4)

    def of_points(self, rows: np.ndarray | slice) -> Sightings:
        """Return the sightings of some of the points."""
        return replace(self, pixels=self.pixels[:, rows], weight=self.weight[:, rows])

    def of_cameras(self, rows: np.ndarray) -> Sightings:
        """Return the sightings by some of the cameras."""
        return Sightings(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def residuals(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "C N 2"]:
        """Return the vectors from projections to sightings, pixels; infinite behind a camera and for NaN points."""
        cam = _in_cameras(self.cam_from_world, points)
        with np.errstate(invalid="ignore"):
            seen = cam[..., 2] > _NEAR
        # Pinhole projection u = K (X / Z, Y / Z). Infinite residuals keep points behind a camera from ever being
        # inliers.
        plane = cam[..., :2] / np.where(seen, cam[..., 2], 1.0)[..., None]
        uv = plane @ self.K[:, :2, :2].transpose(0, 2, 1) + self.K[:, None, :2, 2]
        return np.where(seen[..., None], self.pixels - uv, np.inf)


def all_pairs(cameras: int, *, most: int, seed: int) -> list[tuple[int, int]]:
    """Return all pairs of cameras, or a random choice of `most` of them if there are more."""
    pairs = list(combinations(range(cameras), 2))
    if len(pairs) <= most:
        return pairs
    chosen = np.random.default_rng(seed).choice(len(pairs), most, replace=False)
    return [pairs[k] for k in np.sort(chosen)]


def consensus(s: Sightings, pairs: Sequence[tuple[int, int]], *, least_degrees: float) -> Float64[np.ndarray, "N 3"]:
    """Triangulate every point by each pair of cameras that sees it, and keep the best result over all cameras.

    The best minimises the truncated cost `sum_c w_c min(r_c^2 / threshold_c^2, 1)` of MSAC (Torr and Zisserman 2000), a
    refinement of the consensus of Fischler and Bolles (1981). Pairs whose rays meet at less than `least_degrees` are
    skipped. Points without any pair are NaN.
    """
    parts = [
        _consensus(s.of_points(slice(start, start + _CHUNK)), pairs, np.cos(np.radians(least_degrees)))
        for start in range(0, s.weight.shape[1], _CHUNK)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _consensus(s: Sightings, pairs: Sequence[tuple[int, int]], most_cosine: float) -> np.ndarray:
    """Run the consensus on a chunk of points."""
    count = s.weight.shape[1]
    best, points = np.full(count, np.inf), np.full((count, 3), np.nan)
    # Unit rays of all sightings in world coordinates.
    inverse = np.linalg.inv(s.K)
    plane = s.pixels @ inverse[:, :2, :2].transpose(0, 2, 1) + inverse[:, None, :2, 2]
    rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=2) @ s.cam_from_world[:, :, :3]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    # Linear triangulation (DLT) A x = b with rows (u r_3 - r_1) x = t_1 - u t_3, and the same for v. The normal
    # matrices of the cameras add up, so that those of a pair are sums of two.
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
        # Score the pair's points by all cameras, and keep those that are better than before.
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
    """Minimise the reprojection errors of the inliers by eight Gauss-Newton steps with Cauchy weights.

    The weight of a sighting is `w / noise^2 / (1 + r^2 / (3 noise)^2)`.

    Returns:
        The points; their covariances in square metres, which are the inverses of the normal matrices without the robust
        weights; and which sightings are inliers. A point is NaN if fewer than two cameras, or fewer than a third of
        those that see it, are inliers.
    """
    parts = [
        _refine(s.of_points(slice(start, start + _CHUNK)), points[start : start + _CHUNK])
        for start in range(0, len(points), _CHUNK)
    ] or [(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((len(s.K), 0), dtype=bool))]
    found, covariance, inliers = zip(*parts, strict=True)
    return np.concatenate(found), np.concatenate(covariance), np.concatenate(inliers, axis=1)


def _refine(s: Sightings, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Refine a chunk of points."""
    steps, least_agree = 8, 1 / 3
    # Final inliers lie within four standard deviations, but never outside a quarter to the whole of the threshold.
    limit = np.clip(4.0 * s.noise, 0.25 * s.threshold, s.threshold)[:, None]
    points = points.copy()
    covariance = np.full((len(points), 3, 3), np.nan)
    for step in range(steps):
        residual = s.residuals(points)
        length = np.linalg.norm(residual, axis=2)
        # The first half of the steps accepts all inliers of the consensus, which is as noisy as its two cameras are.
        inliers = (s.weight > 0) & (length < (s.threshold[:, None] if step < steps // 2 else limit))
        good = inliers.sum(axis=0) >= np.maximum(2, least_agree * (s.weight > 0).sum(axis=0))
        weight = np.where(inliers & good, s.weight, 0.0) / s.noise[:, None] ** 2
        rows = np.flatnonzero(good)
        J = _point_jacobian(s, points[rows])
        if step == steps - 1:
            covariance[rows] = np.linalg.inv(_normal_matrix(J, weight[:, rows]) + 1e-12 * np.eye(3))
            points[~good] = np.nan
            return points, covariance, inliers & good
        # Solve (J^T W J) dx = J^T W r with the Cauchy weights.
        with np.errstate(invalid="ignore"):
            weight = (weight / (1.0 + (length / (3.0 * s.noise[:, None])) ** 2))[:, rows]
        pull = weight[..., None] * np.where(weight[..., None] > 0, residual[:, rows], 0.0)
        right = (J.transpose(0, 1, 3, 2) @ pull[..., None]).sum(axis=0)
        points[rows] += np.linalg.solve(_normal_matrix(J, weight) + 1e-9 * np.eye(3), right)[..., 0]
    raise AssertionError("unreachable")


def pixel_noise(
    s: Sightings, points: Float64[np.ndarray, "N 3"], inliers: Bool[np.ndarray, "C N"], *, unit: Float[np.ndarray, " C"]
) -> Float64[np.ndarray, " C"]:
    """Estimate the standard deviation of a coordinate in each camera's pixels from the residuals of the inliers.

    A residual is smaller than the noise because the point was fitted to it, by `sqrt(1 - h)` with the leverage
    `h = w J C J^T / noise^2`; sightings with a leverage over 0.7 are skipped. The robust standard deviation is 1.4826
    times the median of absolute values. A camera with fewer than 60 residuals gets that of all cameras, in its unit;
    the others are clamped to half and four times of it, because the noise of a close-up, whose points follow it most,
    could otherwise shrink without end.

    Args:
        s: sightings, with the noise with which the points were refined.
        points: refined points.
        inliers: whether a sighting is an inlier.
        unit: pixels in which the noise of cameras is compared, a share of their images' heights.
    """
    least_residuals, most_leverage, normal_mad = 60, 0.7, 1.4826
    rows = np.flatnonzero(inliers.any(axis=0))
    J, weight = (
        _point_jacobian(s, points[rows]),
        np.where(inliers[:, rows], s.weight[:, rows], 0.0) / s.noise[:, None] ** 2,
    )
    covariance = np.linalg.inv(_normal_matrix(J, weight) + 1e-12 * np.eye(3))
    leverage = weight[..., None] * ((J @ covariance) * J).sum(axis=3)
    size = np.abs(s.residuals(points))[:, rows] / np.sqrt(np.maximum(1.0 - leverage, 1e-3)) / unit[:, None, None]
    usable = inliers[:, rows, None] & (leverage < most_leverage)
    # One robust estimate for all cameras, then one each where there are enough residuals.
    everything = size[usable]
    common = normal_mad * float(np.median(everything)) if len(everything) else 1.0
    counts = usable.sum(axis=(1, 2))
    own = [normal_mad * np.median(size[c][usable[c]]) if n >= least_residuals else common for c, n in enumerate(counts)]
    # The floor of 4 % of the unit keeps weights finite for sightings without noise, as synthetic ones are.
    return np.maximum(np.clip(own, 0.5 * common, 4.0 * common), 0.04) * unit


@dataclass(frozen=True, eq=False)
class Resection:
    """The pose of a camera that explains its sightings of known points best.

    Attributes:
        pose: `x_cam = R x_world + t`.
        median: median of the remaining reprojection errors, as a share of the camera's threshold.
        moved: median of the distances that the projections moved, as a share of the threshold.
    """

    pose: Float64[np.ndarray, "3 4"]
    median: float
    moved: float


def resection(s: Sightings, camera: int, points: Float64[np.ndarray, "N 3"]) -> Resection:
    """Find a camera's pose from known points, with three or six degrees of freedom.

    A small rotation and a small translation look almost alike from some metres away. So the camera is only rotated
    about its centre, unless translating it too leaves less than 1/1.15 of the error.
    """
    rotated = _resection(s, camera, points, unknowns=3)
    moved = _resection(s, camera, points, unknowns=6)
    return rotated if rotated.median < 1.15 * moved.median else moved


def _resection(s: Sightings, camera: int, points: Float64[np.ndarray, "N 3"], *, unknowns: int) -> Resection:
    """Minimise the reprojection errors over a rotation, and with six unknowns a translation, by Gauss-Newton.

    The scale of the Cauchy weights falls from thirty thresholds to a half in 24 steps. Of more than 800 points every
    n-th is used.
    """
    rows = np.flatnonzero(np.isfinite(points).all(axis=1) & (s.weight[camera] > 0))
    rows = rows[:: max(1, len(rows) // 800)]
    given, known = s.of_cameras(np.array([camera])).of_points(rows), points[rows]
    own, threshold = given, float(s.threshold[camera])
    for scale in np.geomspace(30.0, 0.5, 24) * threshold:
        residual = own.residuals(known)[0]
        seen = np.isfinite(residual[:, 0])
        residual = np.where(seen[:, None], residual, 0.0)
        # Cauchy weights with a scale that falls: a grossly wrong pose is pulled first, and other people's points drop
        # out later.
        weight = own.weight[0] / (1.0 + (residual**2).sum(axis=1) / scale**2)
        J = _pose_jacobian(own.K[0], _in_cameras(own.cam_from_world, known)[0], seen)[..., :unknowns]
        weighted = (J * weight[:, None, None]).reshape(-1, unknowns).T
        normal = weighted @ J.reshape(-1, unknowns) + 1e-9 * np.eye(unknowns)
        # A rotation alone leaves the last three unknowns at 0.
        step = np.concatenate([np.linalg.solve(normal, weighted @ residual.ravel()), np.zeros(6 - unknowns)])
        turn, pose = matrix_from_rotvec(step[:3]), own.cam_from_world[0]
        shifted = np.concatenate([turn @ pose[:, :3], (turn @ pose[:, 3] + step[3:])[:, None]], axis=1)
        own = replace(own, cam_from_world=shifted[None])
    # Compare the errors before and after, over points that are in front of both poses.
    before, after = given.residuals(known)[0], own.residuals(known)[0]
    both = np.isfinite(before[:, 0]) & np.isfinite(after[:, 0])
    if not both.any():
        return Resection(own.cam_from_world[0], np.inf, np.inf)
    moved = float(np.median(np.linalg.norm((after - before)[both], axis=1)))
    left = float(np.median(np.linalg.norm(after, axis=1)))
    return Resection(own.cam_from_world[0], left / threshold, moved / threshold)


def _in_cameras(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (C, N, 3) points in the cameras' frames."""
    return points @ poses[:, :, :3].transpose(0, 2, 1) + poses[:, None, :, 3]


def _projection_jacobian(K: np.ndarray, cam: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return (..., 2, 3) derivatives of pixels by points in the camera's frame; 0 for points that are not seen."""
    one = np.where(seen, 1.0 / np.where(seen, cam[..., 2], 1.0), 0.0)
    out = np.empty((*cam.shape[:-1], 2, 3))
    out[..., :2] = K[..., :2, :2] * one[..., None, None]
    xy = np.where(seen[..., None], cam[..., :2], 0.0) * one[..., None] ** 2
    out[..., 2] = -(xy[..., None, :] * K[..., :2, :2]).sum(axis=-1)
    return out


def _normal_matrix(J: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return (N, 3, 3) sums over cameras of weighted `J^T J`."""
    # The root of the weights scales the rows; stacked over cameras, one batched product sums over all of them.
    rows = (J * np.sqrt(weight)[..., None, None]).transpose(1, 0, 2, 3).reshape(J.shape[1], -1, 3)
    return rows.transpose(0, 2, 1) @ rows


def _point_jacobian(s: Sightings, points: np.ndarray) -> np.ndarray:
    """Return (C, N, 2, 3) derivatives of pixels by points in world coordinates."""
    cam = _in_cameras(s.cam_from_world, points)
    return _projection_jacobian(s.K[:, None], cam, cam[..., 2] > _NEAR) @ s.cam_from_world[:, None, :, :3]


def _pose_jacobian(K: np.ndarray, cam: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return (N, 2, 6) derivatives of pixels by a rotation d and translation e of the frame, `x <- exp(d) x + e`."""
    plane = _projection_jacobian(K, cam, seen)
    x, y, z = cam.T
    zero = np.zeros_like(x)
    # d x = -[x]_x d
    turned = np.stack([np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)], 1)
    return np.concatenate([plane @ turned, plane], axis=2)
