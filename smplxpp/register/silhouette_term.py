"""Masks: bare limbs end at the contour, nothing of the body lies outside it, clothes keep their gap to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.core.camera import Camera
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.register.config import RegisterConfig
from smplxpp.register.gaps import Gaps
from smplxpp.register.keypoint_term import projected
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.normal_equations import NormalEquations
from smplxpp.register.outline import Outline
from smplxpp.register.robust import geman_mcclure

# A vertex is at the rim where its normal is this near to perpendicular to the ray: sine of the angle.
_RIM = 0.13
# Gaps that are believed, metres.
_LEAST_GAP, _LARGEST_GAP = -0.02, 0.12
_LEAST_SEEN = 8
# Pixels beyond a rim where there must be no body, and the height of the picture in which that is looked up.
_BEYOND = (2.5, 5.0)
_DRAWN_HEIGHT = 320


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Pixels that a body covers, of a smaller picture: `scale` of its pixels to one of the image's."""

    covered: Bool[np.ndarray, "h w"]
    scale: Float64[np.ndarray, " 2"]


@dataclass(frozen=True, eq=False)
class Surface:
    """All of a body's surface.

    Attributes:
        points: its vertices. faces: their triangles. normals: at rest, unit.
    """

    points: BodyPoints
    faces: Int64[np.ndarray, "F 3"]
    normals: Float64[np.ndarray, "V 3"]

    def posed(self, kinematics: Kinematics, posture: Posture) -> tuple[np.ndarray, np.ndarray]:
        """Vertices, and normals turned as the blended rotation turns them (not of unit length where it shrinks)."""
        turned = (self.points.weights @ posture.turned.reshape(len(posture.turned), 9)).reshape(-1, 3, 3)
        return kinematics.points(self.points, posture), np.einsum("nxy,ny->nx", turned, self.normals)


class SilhouetteTerm:
    """Signed distances from rim vertices to the contours of masks, metres.

    A rim vertex x of a camera has the signed distance `s = z / f sd(project(x))`, negative inside. Bare skin: s = 0,
    believed within a reach. Covered: s = -gap of this vertex, as far as its spread allows. Both: s > 0 is outside
    the person, which no part of a body is.

    A rim within the body's own outline, or within that of what it is known to wear, has no contour of its own: the
    body, grown by its gaps, is drawn, and rims beyond which there is still body are left out.

    Args:
        body: all vertices. faces: of the body. normals: of all vertices on the rest shape, unit.
        index: the vertices that are looked at. bare: which of all vertices are skin for sure.
        cameras, outlines: by camera, and by camera and row of the registration.
    """

    def __init__(
        self,
        surface: Surface,
        index: Int64[np.ndarray, " N"],
        bare: Bool[np.ndarray, " V"],
        cameras: Mapping[str, Camera],
        outlines: Mapping[tuple[str, int], Outline],
        config: RegisterConfig,
    ) -> None:
        self.surface, self.index, self.bare = surface, index, bare[index]
        self.cameras, self.outlines, self.config = dict(cameras), outlines, config
        self.gaps = Gaps.unknown(len(index))
        # The sampled vertex that stands for each vertex of the body.
        _, self._nearest = cKDTree(surface.points.rest[index]).query(surface.points.rest)
        self.reach = self.first_reach = config.silhouette_reach_m
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []

    def add(
        self, equations: NormalEquations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool
    ) -> None:
        """Add the masks of a frame."""
        index, direction, residual, weight = self._residuals(row, kinematics, posture, learn=True)
        if not len(index):
            return
        used, place = np.unique(index, return_inverse=True)
        points = self.surface.points.select(self.index[used])
        jacobian = equations.columns.jacobian(kinematics.motion(points, posture))
        rows = np.einsum("nx,nxp->np", direction, jacobian[place.reshape(-1)], optimize=True)
        root = np.sqrt(weight)
        equations.add(row, rows * root[:, None], residual * root, shape=shape)

    def learn(self) -> None:
        """Take the gaps from what was seen since the last time."""
        if self._seen:
            place, distance = (np.concatenate(parts) for parts in zip(*self._seen, strict=True))
            self.gaps = Gaps.learned(place, distance, len(self.index), least=_LEAST_SEEN, tight=self.config.tight_m)
        self._seen = []

    def residual_px(self, row: int, kinematics: Kinematics, posture: Posture) -> float:
        """Mean pixels by which rim vertices miss their contour where it is known; NaN without any."""
        _, _, residual, weight = self._residuals(row, kinematics, posture, learn=False, in_pixels=True)
        use = weight > 0
        return float(np.mean(np.abs(residual[use]))) if use.any() else float("nan")

    def _residuals(
        self, row: int, kinematics: Kinematics, posture: Posture, *, learn: bool, in_pixels: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Index (M,), direction (M, 3), residual (M,) and weight (M,) of rims, of all cameras."""
        points, normals = self.surface.posed(kinematics, posture)
        grown = points + normals * (np.where(self.bare, 0.0, self.gaps.median)[self._nearest])[:, None]
        drawn = TriangleMesh(grown, self.surface.faces)
        found: list[tuple[np.ndarray, ...]] = []
        for name, camera in self.cameras.items():
            outline = self.outlines.get((name, row))
            if outline is not None:
                view = points[self.index], normals[self.index], _drawn(drawn, camera)
                found.append(self._of_camera(camera, outline, *view, learn=learn, in_pixels=in_pixels))
        if not found:
            none = np.zeros(0)
            return none.astype(np.int64), np.zeros((0, 3)), none, none
        index, direction, residual, weight = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return index, direction, residual, weight

    def _of_camera(
        self,
        camera: Camera,
        outline: Outline,
        points: np.ndarray,
        normals: np.ndarray,
        drawn: _Drawn,
        *,
        learn: bool,
        in_pixels: bool,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        rays = points - camera.position
        depth = np.linalg.norm(rays, axis=1)
        at_rim = np.flatnonzero(np.abs(np.einsum("nx,nx->n", rays, normals)) < _RIM * depth)
        pixels, jacobian, seen = projected(camera, points[at_rim])
        distance, gradient, known = outline.sample(pixels)
        # Of a rim whose outside does not lead out of the mask, the contour is another limb's.
        outward = np.einsum("na,nax,nx->n", gradient, jacobian, normals[at_rim])
        direction = np.einsum("nax,nx->na", jacobian, normals[at_rim])
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        metres = depth[at_rim] / np.sqrt(abs(np.linalg.det(camera.K[:2, :2])))
        gap = np.where(self.bare, 0.0, self.gaps.median)[at_rim] / metres
        keep = seen & known & (outward > 0)
        for further in _BEYOND:
            keep &= ~_at(drawn, pixels + direction * (gap + further * outline.factor)[:, None])
        index, distance, gradient, jacobian = at_rim[keep], distance[keep], gradient[keep], jacobian[keep]
        metres = metres[keep]
        direction = np.einsum("na,nax->nx", gradient, jacobian) * metres[:, None]
        length = distance * metres
        sigma = self.config.silhouette_px * outline.factor * metres + 0.001
        bare, gap, spread = self.bare[index], self.gaps.median[index], self.gaps.spread[index]
        residual = np.where(bare, length, length + gap)
        covered_spread = np.hypot(spread, sigma)
        of_bare = geman_mcclure(length, np.maximum(self.reach, 3 * sigma)) / sigma**2
        of_covered = self.config.cloth_share * geman_mcclure(residual, 2.5 * covered_spread) / covered_spread**2
        weight = np.where(bare, of_bare, np.where(np.isfinite(spread), of_covered, 0.0))
        outside = length > 0
        # Outside the mask, whatever covers it: one-sided, and cut off late, for masks err too.
        one_sided = geman_mcclure(length, np.maximum(2 * self.reach, 6 * sigma)) / (2 * sigma) ** 2
        stronger = outside & ~bare & (one_sided > weight)
        residual, weight = np.where(stronger, length, residual), np.where(stronger, one_sided, weight)
        if learn:
            fit = ~bare & (length > -_LARGEST_GAP) & (length < -_LEAST_GAP)
            self._seen.append((index[fit], -length[fit]))
        if in_pixels:
            residual = residual / metres
        return index, direction, residual, weight


def _drawn(mesh: TriangleMesh, camera: Camera) -> _Drawn:
    factor = max(1.0, camera.height / _DRAWN_HEIGHT)
    small = camera.resized(round(camera.width / factor), round(camera.height / factor))
    # One thread: images so small are not worth two.
    covered = rasterize_mesh(mesh, small, threads=1).face_id >= 0
    return _Drawn(covered, np.array([small.width / camera.width, small.height / camera.height]))


def _at(drawn: _Drawn, pixels: np.ndarray) -> np.ndarray:
    """Whether pixels are covered; those outside the image are not."""
    covered = drawn.covered
    column, row = np.floor(pixels * drawn.scale).astype(np.int64).T
    inside = (column >= 0) & (column < covered.shape[1]) & (row >= 0) & (row < covered.shape[0])
    return inside & covered[np.where(inside, row, 0), np.where(inside, column, 0)]
