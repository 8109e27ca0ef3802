"""Carry points near a body from a reference pose to the poses of other frames by its skinning weights.

A point x of the space around the body follows the weights w_j(x) of the body near it,
`x_t = sum_j w_j(x) G_tj G_j^-1 x`, with G_tj the transforms of the joints in frame t, G_j those in the reference pose.

How far clothes and hair stand off the body is seen at its rims in the silhouettes of a turn. A vertex whose normal is
across the ray lies at the rim; its depth inside the silhouette is the distance of clothes there, unless another limb is
beside it, because then the contour is that limb's. The least depth of a vertex over the frames is kept, and every
vertex takes the median over the rims near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy import sparse
from scipy.spatial import cKDTree

from smplxpp.core import TriangleMesh
from smplxpp.reconstruct.photographs import Pyramids, Sight, sight_of_camera
from smplxpp.reconstruct.views import UNSEEN, PhotoView, Silhouette


@dataclass(frozen=True, eq=False)
class PosedPerson:
    """The body that carries the space around it from the reference pose to the poses of T frames.

    Attributes:
        vertices: of the body's surface in the reference pose, metres; limbs apart from each other.
        normals: of these vertices, outward unit vectors.
        weights: skinning weights.
        transforms: of the joints, from the reference pose to that of each frame.
        result: of the joints, from the reference pose to that of the finished surface; None: they are the same.
    """

    vertices: Float64[np.ndarray, "V 3"]
    normals: Float64[np.ndarray, "V 3"]
    weights: Float[np.ndarray, "V J"]
    transforms: Float64[np.ndarray, "T J 4 4"]
    result: Float64[np.ndarray, "J 4 4"] | None = None

    def select(self, rows: Sequence[int]) -> PosedPerson:
        """Return the person in some of the frames."""
        return replace(self, transforms=self.transforms[list(rows)])

    def finished(self, mesh: TriangleMesh) -> TriangleMesh:
        """Return a surface in the reference pose carried to the pose of the finished surface."""
        if self.result is None:
            return mesh
        carrier = replace(self, transforms=self.result[None]).carrier()
        features = carrier.features(mesh.vertices, carrier.weights_at(mesh.vertices))
        return mesh.with_vertices(carrier.carried(features, 0))

    def room(
        self,
        points: Float[np.ndarray, "N 3"],
        distance: Float64[np.ndarray, "N K"],
        index: Int64[np.ndarray, "N K"],
        limits: Float64[np.ndarray, " V"],
    ) -> Float32[np.ndarray, " N"]:
        """Return the signed depth of points inside the surface at a given distance from each vertex, metres.

        Args:
            points: in the reference pose.
            distance: to the nearest vertices, as `Carrier.neighbours` gives them.
            index: of these vertices.
            limits: distance of the surface from each vertex.
        """
        found = np.isfinite(distance[:, 0])
        near = index[found]
        known = np.minimum(near, len(limits) - 1)
        share = 1.0 / (distance[found] + 0.01) ** 2
        share /= share.sum(axis=1, keepdims=True)
        # The signed distance is the mean of those from the nearest vertices' planes (implicit moving least squares).
        along = np.einsum("nkx,nkx->nk", points[found][:, None] - self.vertices[known], self.normals[known])
        limit = (share * limits[known]).sum(axis=1)
        out = np.full(len(points), -float(limits.max()), np.float32)
        out[found] = limit - (share * along).sum(axis=1)
        return out

    def carrier(self) -> Carrier:
        """Return the skinning of points near the body."""
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
        """Return distances and indices of the six nearest vertices within reach; farther ones are at infinity."""
        distance, index = self.tree.query(points, k=6, distance_upper_bound=reach)
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
        """Carry points, given by their features, to a frame."""
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


REACH_M = 0.25
"""Distance from the body's surface to its farthest clothes and hair."""
_NEAR_M, _MOST_NEAR, _LEAST_NEAR = 0.2, 48, 8
# Added to the median: folds, and errors of body and poses. Where no rim is near, what most clothes keep to.
_SLACK_M, _UNKNOWN_M = 0.008, 0.08


def clothing_limits(silhouettes: Sequence[Silhouette], person: PosedPerson) -> Float64[np.ndarray, " V"]:
    """Return the largest distance of clothes from each vertex of the body, metres.

    Args:
        silhouettes: a frame each.
        person: the body in these frames.
    """
    # Every second vertex is enough, because the limits are medians over 20 cm.
    rows = np.arange(0, len(person.vertices), 2)
    carrier = person.carrier()
    weights = np.asarray(person.weights, np.float32)[rows]
    features = carrier.features(person.vertices[rows], weights)
    least = np.full(len(rows), np.inf)
    # Between normal and ray.
    rim_cosine = 0.15
    # Gaps below it are no limb's.
    thin_m = 0.02
    for frame, silhouette in enumerate(silhouettes):
        points = carrier.carried(features, frame)
        flat = person.transforms[frame, :, :3, :3].reshape(-1, 9)
        normals = np.einsum("nij,nj->ni", (weights @ flat).reshape(-1, 3, 3), person.normals[rows])
        rays = points - silhouette.camera.position
        cosine = np.einsum("nx,nx->n", rays, normals) / np.linalg.norm(rays, axis=1)
        rim = np.flatnonzero(np.abs(cosine) < rim_cosine)
        depth = silhouette.depth(points[rim].astype(np.float32))
        shown = depth < UNSEEN
        depth = np.maximum(depth, 0.0)
        # At half the depth outwards the image must show cloth and no body; else the contour belongs to another limb.
        outward = points[rim] + np.where(shown, 0.5 * depth, 0.0)[:, None] * normals[rim]
        own, screen = (silhouette.camera.screen_from_world(place) for place in (points, outward))
        away = cKDTree(own[:, :2]).query(screen[:, :2])[0] * silhouette.pixel * screen[:, 2]
        reached = (away > 0.3 * depth) | (depth < thin_m)
        least[rim] = np.minimum(least[rim], np.where(shown & reached, depth, np.inf))
    # The median over the rims that lie near in the reference pose.
    seen = np.flatnonzero(np.isfinite(least))
    limits = np.full(len(person.vertices), _UNKNOWN_M)
    if len(seen) >= _LEAST_NEAR:
        tree = cKDTree(person.vertices[rows[seen]])
        distance, index = tree.query(person.vertices, k=min(_MOST_NEAR, len(seen)), distance_upper_bound=_NEAR_M)
        found = np.isfinite(distance)
        gap = np.where(found, least[seen][np.minimum(index, len(seen) - 1)], np.nan)
        enough = found.sum(axis=1) >= _LEAST_NEAR
        limits[enough] = np.nanmedian(gap[enough], axis=1) + _SLACK_M
    return np.minimum(limits, REACH_M)
