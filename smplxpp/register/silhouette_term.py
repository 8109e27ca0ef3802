"""Compare masks with the body: bare limbs end at the contour, cloth keeps its gap to it, no body lies outside.

A vertex x is at the rim of a camera where its normal is nearly perpendicular to the ray. Its signed distance to the
contour of the mask, in metres at the depth z of the vertex and with focal length f, is `d = z / f sdf(project(x))`,
negative inside the mask. Residuals and robust weights (GM is the weight of Geman and McClure, s the standard deviation
of a contour) are

    bare vertex          d          GM(d; max(reach, 3 s)) / s^2
    covered vertex       d + gap    cloth_share GM(d + gap; 2.5 w) / w^2             w^2 = spread^2 + s^2
    covered, outside     d          GM(d; max(2 reach, 6 s)) / (2 s)^2               where d > 0, if it weighs more

The gap of a vertex and its spread are estimated over all views and frames after every step (`Gaps`).

A rim inside the outline of the body itself, or of what it wears, has no contour of its own. So the body, grown by its
gaps, is rasterised into every view, and rims with body beside them on the outer side are dropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64, UInt8
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from smplxpp.core import Camera, TriangleMesh
from smplxpp.native import map_in_threads
from smplxpp.raster import rasterize_mesh
from smplxpp.register.clothing import Gaps, in_order_of_frames
from smplxpp.register.keypoint_term import projected
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.normal_equations import Equations, geman_mcclure
from smplxpp.register.observations import RegisterConfig

# An outline is a signed distance field of a reduced image, stored in eight bits: quarters of a reduced pixel, up to
# +-31 pixels.
_STEPS_A_PIXEL, _FARTHEST_PX = 4.0, 31.0


@dataclass(frozen=True, eq=False)
class Outline:
    """The signed distance field of one mask's contour, negative inside.

    Attributes:
        field: distances in quarters of a reduced pixel, in a window of the image.
        corner: x and y of the window's corner, in reduced pixels.
        factor: pixels of the image a reduced pixel.
        width: of the reduced image.
        height: of the reduced image.
    """

    field: Int8[np.ndarray, "h w"]
    corner: tuple[int, int]
    factor: int
    width: int
    height: int

    @staticmethod
    def of(mask: UInt8[np.ndarray, "H W"]) -> Outline | None:
        """Compute the outline of a person's opacity; None if the mask is empty."""
        # Reduce the mask to at most 800 rows by averaging blocks: half a pixel of that is less than a mask's error.
        factor = max(1, -(-mask.shape[0] // 800))
        height, width = mask.shape[0] // factor, mask.shape[1] // factor
        alpha = mask[: height * factor, : width * factor].astype(np.float32) / 255.0
        if factor > 1:
            alpha = alpha.reshape(height, factor, width, factor).mean(axis=(1, 3))
        rows, columns = np.flatnonzero((alpha > 0.5).any(axis=1)), np.flatnonzero((alpha > 0.5).any(axis=0))
        if not len(rows):
            return None
        # Keep a window with a margin about the person; distances farther out are not needed.
        margin = 24
        y0, y1 = max(rows[0] - margin, 0), min(rows[-1] + 1 + margin, height)
        x0, x1 = max(columns[0] - margin, 0), min(columns[-1] + 1 + margin, width)
        # A person who is cut off by the image's edge has no contour there: the mask is continued outside the image.
        window = np.pad(alpha[y0:y1, x0:x1], _pads(x0, y0, x1, y1, width, height), mode="edge")
        inside = window > 0.5
        distance = np.where(inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5)
        # Partly covered pixels at the contour give the distance to a fraction of a pixel.
        mixed = (window > 0.02) & (window < 0.98) & (np.abs(distance) < 1.5)
        distance[mixed] = 0.5 - window[mixed]
        (top, _), (left, _) = _pads(x0, y0, x1, y1, width, height)
        field = np.round(np.clip(distance, -_FARTHEST_PX, _FARTHEST_PX) * _STEPS_A_PIXEL).astype(np.int8)
        return Outline(field, (int(x0) - left, int(y0) - top), factor, width, height)

    def sample(
        self, pixels: Float64[np.ndarray, "N 2"]
    ) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, "N 2"], np.ndarray]:
        """Interpolate the signed distance at pixels of the full image.

        Returns:
            Distances in pixels of the full image, their unit gradients, and where both are known: inside the window,
            and nearer than the largest distance that the field stores.
        """
        # Coordinates in which integers are the centres of reduced pixels of the window.
        place = pixels / self.factor - 0.5 - np.asarray(self.corner)
        h, w = self.field.shape
        known = (place > 0).all(axis=1) & (place[:, 0] < w - 1) & (place[:, 1] < h - 1)
        place = np.where(known[:, None], place, 0.0)
        column, row = np.minimum(place.astype(np.int64), np.array([w - 2, h - 2])).T
        x, y = place[:, 0] - column, place[:, 1] - row
        # Bilinear interpolation of the four neighbours, and its derivative.
        a, b = self.field[row, column] / _STEPS_A_PIXEL, self.field[row, column + 1] / _STEPS_A_PIXEL
        c, d = self.field[row + 1, column] / _STEPS_A_PIXEL, self.field[row + 1, column + 1] / _STEPS_A_PIXEL
        value = (a * (1 - x) + b * x) * (1 - y) + (c * (1 - x) + d * x) * y
        gradient = np.stack([(b - a) * (1 - y) + (d - c) * y, (c - a) * (1 - x) + (d - b) * x], axis=1)
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        known &= (np.abs(value) < _FARTHEST_PX - 1) & (length[:, 0] > 0.5)
        return value * self.factor, gradient / np.maximum(length, 1e-9), known


def _pads(x0: int, y0: int, x1: int, y1: int, width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return how many pixels to add outside the image on each side where the window touches its edge."""
    pad = int(_FARTHEST_PX) + 2
    return (pad * (y0 == 0), pad * (y1 == height)), (pad * (x0 == 0), pad * (x1 == width))


@dataclass(frozen=True, eq=False)
class _Rasterised:
    """The pixels that a body covers in a smaller image.

    Attributes:
        covered: whether a pixel is covered.
        scale: pixels of the smaller image a pixel of the camera's, along x and y.
    """

    covered: Bool[np.ndarray, "h w"]
    scale: Float64[np.ndarray, " 2"]


@dataclass(frozen=True, eq=False)
class Surface:
    """The whole surface of a body.

    Attributes:
        points: all vertices.
        faces: triangles.
        normals: unit normals of the vertices at rest.
    """

    points: BodyPoints
    faces: Int64[np.ndarray, "F 3"]
    normals: Float64[np.ndarray, "V 3"]

    def posed(self, kinematics: Kinematics, posture: Posture) -> tuple[np.ndarray, np.ndarray]:
        """Return posed vertices, and normals rotated by the blended rotation (shorter than 1 where it shrinks)."""
        # Normals turn with the blended rotation. That is exact for rigid parts and close enough elsewhere to find rims.
        blended = (self.points.weights @ posture.rotations.reshape(len(posture.rotations), 9)).reshape(-1, 3, 3)
        return kinematics.points(self.points, posture), np.einsum("nxy,ny->nx", blended, self.normals)


class SilhouetteTerm:
    """Signed distances from rim vertices to the contours of masks, metres; see the module's docstring.

    Args:
        surface: of the body.
        index: the vertices that may be at a rim.
        bare: vertices that are known to be bare skin.
        cameras: by name.
        outlines: by name of the camera and row of the registration.
        config: standard deviations and cutoffs.
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
        # The nearest sampled vertex of each vertex, whose gap it takes.
        _, self._nearest = cKDTree(surface.points.rest[index]).query(surface.points.rest)
        self.reach = self.first_reach = config.silhouette_reach_m
        self.least_sightings = 8
        self._distances: list[tuple[int, np.ndarray, np.ndarray]] = []  # by row

    def add(self, equations: Equations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool) -> None:
        """Add the masks of one frame to the normal equations."""
        index, direction, residual, weight = self._residuals(row, kinematics, posture, collect=row)
        if not len(index):
            return
        # A vertex may be at the rim of several cameras; its derivative by the pose is the same and computed once.
        used, place = np.unique(index, return_inverse=True)
        points = self.surface.points.select(self.index[used])
        jacobian = equations.columns.jacobian(kinematics.motion(points, posture, equations.columns.joints))
        rows = np.einsum("nx,nxp->np", direction, jacobian[place.reshape(-1)], optimize=True)
        root = np.sqrt(weight)
        equations.add(row, rows * root[:, None], residual * root, shape=shape)

    def estimate_gaps(self) -> None:
        """Estimate the gaps from the distances of the last step; a vertex needs `least_sightings` of them."""
        if self._distances:
            place, distance = in_order_of_frames(self._distances)
            self.gaps = Gaps.estimated(
                place, distance, len(self.index), least=self.least_sightings, tight=self.config.tight_m
            )
        self._distances = []

    def residual_px(self, row: int, kinematics: Kinematics, posture: Posture) -> float:
        """Return the mean absolute residual of a frame's rim vertices, pixels; NaN without any."""
        _, _, residual, weight = self._residuals(row, kinematics, posture, in_pixels=True)
        use = weight > 0
        return float(np.mean(np.abs(residual[use]))) if use.any() else float("nan")

    def _residuals(
        self, row: int, kinematics: Kinematics, posture: Posture, *, collect: int | None = None, in_pixels: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return index (M,), direction (M, 3), residual (M,) and weight (M,) of the rim vertices of all cameras.

        Args:
            row: of the frame.
            kinematics: of the body.
            posture: of the frame.
            collect: row under which distances are kept for the next estimate of the gaps; None: they are not.
            in_pixels: return residuals in pixels.
        """
        # The body with its clothes: every vertex moved out by the gap of its nearest sample.
        points, normals = self.surface.posed(kinematics, posture)
        grown = points + normals * (np.where(self.bare, 0.0, self.gaps.median)[self._nearest])[:, None]
        clothed = TriangleMesh(grown, self.surface.faces)
        # Small images, each drawn by one thread, and several at a time.
        seen = [name for name in self.cameras if (name, row) in self.outlines]
        drawn = map_in_threads(lambda name: _rasterised(clothed, self.cameras[name]), seen)
        found = [
            self._of_camera(
                self.cameras[name],
                self.outlines[name, row],
                *(points[self.index], normals[self.index], view),
                collect=collect,
                in_pixels=in_pixels,
            )
            for name, view in zip(seen, drawn, strict=True)
        ]
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
        clothed: _Rasterised,
        *,
        collect: int | None,
        in_pixels: bool,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the same arrays for one camera."""
        # Rim vertices: the sine of the angle between normal and image plane is below 0.13, some 7 degrees.
        rays = points - camera.position
        depth = np.linalg.norm(rays, axis=1)
        at_rim = np.flatnonzero(np.abs(np.einsum("nx,nx->n", rays, normals)) < 0.13 * depth)
        pixels, jacobian, seen = projected(camera, points[at_rim])
        distance, gradient, known = outline.sample(pixels)
        # The outward direction of the rim in the image must lead out of the mask; else the contour is another limb's.
        outward = np.einsum("na,nax,nx->n", gradient, jacobian, normals[at_rim])
        direction = np.einsum("nax,nx->na", jacobian, normals[at_rim])
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        metres = depth[at_rim] / np.sqrt(abs(np.linalg.det(camera.K[:2, :2])))
        gap = np.where(self.bare, 0.0, self.gaps.median)[at_rim] / metres
        keep = seen & known & (outward > 0)
        # 2.5 and 5 pixels outside the clothed rim there must be no body: it would hide the contour.
        for further in (2.5, 5.0):
            keep &= ~_covers(clothed, pixels + direction * (gap + further * outline.factor)[:, None])
        index, distance, gradient, jacobian = at_rim[keep], distance[keep], gradient[keep], jacobian[keep]
        metres = metres[keep]
        # The derivative of the distance by the vertex, in metres a metre, and the distance in metres.
        direction = np.einsum("na,nax->nx", gradient, jacobian) * metres[:, None]
        length = distance * metres
        # Noise of the contour at this depth, and a millimetre for the body's own shape.
        sigma = self.config.silhouette_px * outline.factor * metres + 0.001
        bare, gap, spread = self.bare[index], self.gaps.median[index], self.gaps.spread[index]
        residual = np.where(bare, length, length + gap)
        covered_spread = np.hypot(spread, sigma)
        of_bare = geman_mcclure(length, np.maximum(self.reach, 3 * sigma)) / sigma**2
        of_covered = self.config.cloth_share * geman_mcclure(residual, 2.5 * covered_spread) / covered_spread**2
        weight = np.where(bare, of_bare, np.where(np.isfinite(spread), of_covered, 0.0))
        # Outside the mask, whatever covers the vertex: one-sided, with twice the cutoff because masks have errors too.
        outside = length > 0
        one_sided = geman_mcclure(length, np.maximum(2 * self.reach, 6 * sigma)) / (2 * sigma) ** 2
        stronger = outside & ~bare & (one_sided > weight)
        residual, weight = np.where(stronger, length, residual), np.where(stronger, one_sided, weight)
        if collect is not None:
            # Gaps from -2 cm to 12 cm enter the next estimate; larger ones belong to another limb.
            usable = ~bare & (length > -0.12) & (length < 0.02)
            self._distances.append((collect, index[usable], -length[usable]))
        if in_pixels:
            residual = residual / metres
        return index, direction, residual, weight


def _rasterised(mesh: TriangleMesh, camera: Camera) -> _Rasterised:
    """Rasterise a body at 320 rows, which is enough to see which rims it hides."""
    factor = max(1.0, camera.height / 320)
    small = camera.resized(round(camera.width / factor), round(camera.height / factor))
    # A second thread costs more than it saves on images of this size.
    covered = rasterize_mesh(mesh, small, threads=1).face_id >= 0
    return _Rasterised(covered, np.array([small.width / camera.width, small.height / camera.height]))


def _covers(raster: _Rasterised, pixels: np.ndarray) -> np.ndarray:
    """Return whether pixels are covered; pixels outside the image are not."""
    covered = raster.covered
    column, row = np.floor(pixels * raster.scale).astype(np.int64).T
    inside = (column >= 0) & (column < covered.shape[1]) & (row >= 0) & (row < covered.shape[0])
    return inside & covered[np.where(inside, row, 0), np.where(inside, column, 0)]
