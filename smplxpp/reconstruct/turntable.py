"""Reconstruct a person who turns before one camera: silhouettes and photographs carried to one pose by skinning.

Every frame has a pose of its own. A point x of the space around the body in the reference pose is carried to frame t by
the skinning weights of the body near it,

    x_t = sum_j w_j(x) G_tj G_j^-1 x

with G_tj the transforms of the joints in frame t and G_j those in the reference pose (after Alldieck et al. 2018,
"Video Based Reconstruction of 3D People Models", who carry the rays of silhouettes instead). There the photograph of
frame t says whether the point lies inside its silhouette, and what colour it has. Hull and colours are those of
`reconstruct`, with all views looking at points that are carried.

Poses are wrong by some degrees, and each wrong one cuts into the surface. So a share of the frames may reject a point,
and the surface is smoothed. It is not swept along its normals to where photographs agree: at poses that are off by
millimetres, in views 15 degrees apart, stripes agree with their neighbours, and plain cloth with anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy import sparse
from scipy.spatial import cKDTree

from smplxpp.core import InputError, ProgressCallback, TriangleMesh, ignore_progress, spread
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct.hull import Field, main_body, zero_surface
from smplxpp.reconstruct.photographs import Pyramids, Sight, sight_of_camera
from smplxpp.reconstruct.reconstruct import ReconstructConfig, Reconstruction, cell_size, refined
from smplxpp.reconstruct.silhouettes import UNSEEN, Silhouette, least_shown
from smplxpp.reconstruct.sweep import mean_of_neighbours, taubin
from smplxpp.reconstruct.views import INSIDE, LEAST_VIEWS, Box, PhotoView, mask_fault

# Share of the frames that may reject a point of the surface, and of the first hull, which a wrong frame must not spoil.
# It trades thin limbs, which wrong poses cut off, against fat ones.
_DISSENT, _FIRST_DISSENT = 0.03, 0.15
_SMOOTHING = 15  # Taubin steps, against the edges that few silhouettes leave
# Frames whose mask and surface agree less than the median frame by this much were posed wrongly.
_WORSE_IOU = 0.08
_COARSE_M = 0.012  # cells of the first hull
_COARSEST_M = 0.08  # cells with which a hull is begun: the box around spread arms is mostly air
_MOST_FRAMES = 60  # more, evenly spread, add minutes and no side
_REACH_M = 0.25  # from the body's surface to its farthest clothes and hair


@dataclass(frozen=True, eq=False)
class PosedPerson:
    """The body that carries the space around it from the reference pose to the poses of T frames.

    Attributes:
        vertices: of the body in the reference pose, metres.
        weights: skinning weights.
        transforms: of the joints, from the reference pose to that of each frame.
    """

    vertices: Float64[np.ndarray, "V 3"]
    weights: Float[np.ndarray, "V J"]
    transforms: Float64[np.ndarray, "T J 4 4"]

    def select(self, rows: Sequence[int]) -> PosedPerson:
        """Return the person in some of the frames."""
        return replace(self, transforms=self.transforms[list(rows)])

    def carrier(self) -> Carrier:
        """Return what finds weights near points."""
        return Carrier(cKDTree(self.vertices), np.asarray(self.weights, np.float32), self.transforms)


@dataclass(frozen=True, eq=False)
class Carrier:
    """Skinning of points near a body.

    Attributes:
        tree: of the body's vertices in the reference pose.
        weights: skinning weights of the vertices.
        transforms: of the joints, from the reference pose to that of each frame.
    """

    tree: cKDTree
    weights: Float32[np.ndarray, "V J"]
    transforms: Float64[np.ndarray, "T J 4 4"]

    def neighbours(
        self, points: Float[np.ndarray, "N 3"], *, reach: float = np.inf
    ) -> tuple[Float64[np.ndarray, "N K"], Int64[np.ndarray, "N K"]]:
        """Return distances and indices of the four nearest vertices within reach; farther ones are at infinity."""
        distance, index = self.tree.query(points, k=4, distance_upper_bound=reach)
        return distance, index.astype(np.int64)

    def weights_of(
        self, distance: Float64[np.ndarray, "N K"], index: Int64[np.ndarray, "N K"]
    ) -> Float32[np.ndarray, "N J"]:
        """Return the mean weights of neighbours, by the inverse square of distance plus 1 cm."""
        soft = 0.01
        share = 1.0 / (distance + soft) ** 2
        share /= share.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(index)), index.shape[1])
        known = np.minimum(index, len(self.weights) - 1).ravel()  # those at infinity have no share
        matrix = sparse.csr_matrix(
            (share.astype(np.float32).ravel(), (rows, known)), shape=(len(index), len(self.weights))
        )
        return np.asarray(matrix @ self.weights)

    def weights_at(self, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N J"]:
        """Return the mean weights of the vertices near points."""
        return self.weights_of(*self.neighbours(points))

    def features(
        self, points: Float[np.ndarray, "N 3"], weights: Float32[np.ndarray, "N J"]
    ) -> Float32[np.ndarray, "N _"]:
        """Return each weight times each homogeneous coordinate, of which carried points are linear functions."""
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1).astype(np.float32)
        return (weights[:, :, None] * homogeneous[:, None, :]).reshape(len(points), 4 * weights.shape[1])

    def carried(self, features: Float32[np.ndarray, "N _"], frame: int) -> Float64[np.ndarray, "N 3"]:
        """Return the points of some features carried to a frame."""
        matrix = self.transforms[frame, :, :3].transpose(0, 2, 1).reshape(-1, 3)
        return (features @ matrix.astype(np.float32)).astype(np.float64)


@dataclass(frozen=True, eq=False)
class CarriedPyramids(Pyramids):
    """Photographs of one camera in T poses, which see points that are carried from the reference pose.

    Attributes:
        carrier: of the points.
    """

    carrier: Carrier

    @staticmethod
    def of_turn(views: Sequence[PhotoView], carrier: Carrier) -> CarriedPyramids:
        """Return the pyramids of the views, one a frame of the carrier."""
        plain = Pyramids.of(views)
        return CarriedPyramids(plain.values, plain.starts, plain.sizes, plain.projections, plain.cameras, carrier)

    def sight(self, mesh: TriangleMesh, normals: Float[np.ndarray, "N 3"]) -> Sight:
        """Compute which vertices of a surface each frame sees, on the surface in the pose of that frame."""
        weights = self.carrier.weights_at(mesh.vertices)
        features = self.carrier.features(mesh.vertices, weights)
        columns = []
        for frame, camera in enumerate(self.cameras):
            posed = mesh.with_vertices(self.carrier.carried(features, frame))
            flat = self.carrier.transforms[frame, :, :3, :3].reshape(-1, 9)
            turned = np.einsum("nij,nj->ni", (weights @ flat).reshape(-1, 3, 3), normals)
            turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
            columns.append(sight_of_camera(posed, turned, camera))
        return Sight(*(np.stack([column[part] for column in columns], axis=1) for part in (0, 1)))

    def screen(self, view: int, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4"]:
        """Project points of the surface into a frame."""
        features = self.carrier.features(points, self.carrier.weights_at(points))
        return self.cameras[view].screen_from_world(self.carrier.carried(features, view))

    def projections_of(
        self, points: Float64[np.ndarray, "N 3"]
    ) -> list[tuple[Int64[np.ndarray, " _"], Float64[np.ndarray, "V 3 4"]]]:
        """Group points by their heaviest joint, whose rigid motion they follow: patches are small against limbs."""
        heaviest = self.carrier.weights_at(points).argmax(axis=1)
        return [
            (np.flatnonzero(heaviest == joint), self.projections @ self.carrier.transforms[:, joint])
            for joint in np.unique(heaviest)
        ]


def reconstruct_turntable(
    views: Sequence[PhotoView],
    person: PosedPerson,
    config: ReconstructConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> Reconstruction:
    """Reconstruct a person who turns before one camera, in the reference pose.

    Args:
        views: a photograph and a mask a frame, through the camera that stands still.
        person: the body in these frames.
        config: `cell`, and `dissent` in frames, in addition to 3 % of them; there is no sweep.
        progress: called with the running step and its share done.

    Raises:
        InputError: fewer than four masks that may show a person, or a body that lies in no silhouette.

    Example:
        >>> found = reconstruct_turntable([PhotoView("0", camera, image, mask), ...], person)  # doctest: +SKIP
    """
    config = replace(config or ReconstructConfig(), refine=False)
    progress("masks", 0.0)
    views, person, faults = _usable(views, person)
    notes = [f"mask of {name} left out: {why}" for name, why in faults.items()]
    box = Box(person.vertices.min(axis=0) - _REACH_M, person.vertices.max(axis=0) + _REACH_M)
    progress("hull", 0.0)
    # A coarse hull shows which frames do not fit; the fine one is made of the others.
    first = max(1, round(_FIRST_DISSENT * len(views)))
    shares = agreements(_hull(views, person, box, cell=_COARSE_M, dissent=first)[0], views, person)
    kept = np.flatnonzero(shares >= np.median(shares) - _WORSE_IOU)
    for row in np.setdiff1d(np.arange(len(views)), kept):
        faults[views[row].name] = f"the posed surface covers {100 * shares[row]:.0f} % of its union with the mask"
        notes.append(f"frame {views[row].name} left out: {faults[views[row].name]}, probably a wrong pose")
    views, person = [views[row] for row in kept], person.select(kept.tolist())
    pixel = _pixel(views, person)
    cell = cell_size(pixel, config)
    hull, inside = _hull(views, person, box, cell=cell, dissent=config.dissent + int(_DISSENT * len(views)))
    hull, more = main_body(hull)
    notes += more
    hull = taubin(hull, mean_of_neighbours(hull), steps=_SMOOTHING)
    numbers: dict[str, Any] = {
        "views": [view.name for view in views],
        "left_out": faults,
        "explained": {},
        "pixel_mm": 1e3 * pixel,
        "cell_mm": 1e3 * cell,
    }
    pyramids = CarriedPyramids.of_turn(views, person.carrier())
    return refined(hull, pyramids, inside, config, (notes, numbers), progress=progress)


def _usable(views: Sequence[PhotoView], person: PosedPerson) -> tuple[list[PhotoView], PosedPerson, dict[str, str]]:
    """Return evenly spread frames whose masks may show a person, and the faults of the other masks by name.

    Raises:
        InputError: fewer than four of them.
    """
    faults = {view.name: fault for view in views if (fault := mask_fault(view))}
    rows = spread([k for k, view in enumerate(views) if view.name not in faults], _MOST_FRAMES)
    if len(rows) < LEAST_VIEWS:
        raise InputError(
            "frames to reconstruct from",
            expected=f"at least {LEAST_VIEWS} with a photograph, a mask of the person and a pose",
            received=f"{len(rows)} of {len(views)}",
            remedy="look at the masks (`smplxpp capture check`)",
        )
    return [views[row] for row in rows], person.select(rows), faults


def _hull(
    views: Sequence[PhotoView], person: PosedPerson, box: Box, *, cell: float, dissent: int
) -> tuple[TriangleMesh, Field]:
    """Return the surface of the points that enough frames accept, and the field that it is the zero set of."""
    silhouettes, carrier = [Silhouette.of(view) for view in views], person.carrier()
    least = least_shown(len(views))

    def inside(points: np.ndarray) -> np.ndarray:
        chunk = 1 << 16  # points at once, which bounds the memory
        out = np.empty(len(points), np.float32)
        for first in range(0, len(points), chunk):
            part = points[first : first + chunk]
            # Far from the body there is nothing of the person, whatever the silhouettes hold.
            distance, index = carrier.neighbours(part, reach=_REACH_M)
            out[first : first + chunk] = _REACH_M - np.minimum(distance[:, 0], 2 * _REACH_M)
            rows = np.flatnonzero(distance[:, 0] < _REACH_M)
            features = carrier.features(part[rows], carrier.weights_of(distance[rows], index[rows]))
            depths = np.empty((len(silhouettes), len(rows)), np.float32)
            for frame, silhouette in enumerate(silhouettes):
                depths[frame] = silhouette.depth(carrier.carried(features, frame).astype(np.float32))
            depth = np.partition(depths, dissent, axis=0)[dissent]
            depth[(depths < UNSEEN).sum(axis=0) < least] = -UNSEEN
            out[first + rows] = np.minimum(out[first + rows], depth)
        return out

    return zero_surface(inside, box, cell=cell, coarsest=_COARSEST_M), inside


def agreements(surface: TriangleMesh, views: Sequence[PhotoView], person: PosedPerson) -> Float64[np.ndarray, " T"]:
    """Return the intersection over union of the posed surface and the mask of each frame, at some 320 rows."""
    carrier = person.carrier()
    features = carrier.features(surface.vertices, carrier.weights_at(surface.vertices))
    shares = []
    for frame, view in enumerate(views):
        step = max(1, view.camera.height // 320)
        small = view.camera.resized(view.camera.width // step, view.camera.height // step)
        posed = surface.with_vertices(carrier.carried(features, frame))
        drawn = rasterize_mesh(posed, small, threads=1).mask
        mask = view.opacity[step // 2 :: step, step // 2 :: step][: small.height, : small.width] > INSIDE
        union = int((drawn | mask).sum())
        shares.append(float((drawn & mask).sum()) / union if union else 0.0)
    return np.array(shares)


def _pixel(views: Sequence[PhotoView], person: PosedPerson) -> float:
    """Return the size of a pixel at the body, metres, as the median over the frames."""
    middle = np.append(person.vertices.mean(axis=0), 1.0)
    places = person.transforms[:, 0] @ middle
    depths = [float((view.camera.cam_from_world @ place)[2]) for view, place in zip(views, places, strict=True)]
    return float(
        np.median([2.0 * z / (v.camera.K[0, 0] + v.camera.K[1, 1]) for v, z in zip(views, depths, strict=True)])
    )
