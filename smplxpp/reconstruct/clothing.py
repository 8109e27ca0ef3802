"""Bound how far clothes and hair stand off a body, by its rims in the silhouettes of a turn.

A vertex whose normal is across the ray lies at the rim of the body. Its depth inside the silhouette is how far clothes
stand off there, unless another limb is beside it: then the contour is that limb's, and the rim is not counted. The
least depth of a vertex over the frames is kept, and every vertex takes the median over the rims near it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from smplxpp.reconstruct.carried import PosedPerson
from smplxpp.reconstruct.silhouettes import UNSEEN, Silhouette

REACH_M = 0.25
"""Distance from the body's surface to its farthest clothes and hair."""
_RIM_COSINE = 0.15  # between normal and ray
_THIN_M = 0.02  # gaps below it are no limb's
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
    for frame, silhouette in enumerate(silhouettes):
        points = carrier.carried(features, frame)
        flat = person.transforms[frame, :, :3, :3].reshape(-1, 9)
        normals = np.einsum("nij,nj->ni", (weights @ flat).reshape(-1, 3, 3), person.normals[rows])
        rays = points - silhouette.camera.position
        cosine = np.einsum("nx,nx->n", rays, normals) / np.linalg.norm(rays, axis=1)
        rim = np.flatnonzero(np.abs(cosine) < _RIM_COSINE)
        depth = silhouette.depth(points[rim].astype(np.float32))
        shown = depth < UNSEEN
        depth = np.maximum(depth, 0.0)
        # At half the depth outwards the image must show cloth and no body; else the contour belongs to another limb.
        outward = points[rim] + np.where(shown, 0.5 * depth, 0.0)[:, None] * normals[rim]
        own, screen = (silhouette.camera.screen_from_world(place) for place in (points, outward))
        away = cKDTree(own[:, :2]).query(screen[:, :2])[0] * silhouette.pixel * screen[:, 2]
        reached = (away > 0.3 * depth) | (depth < _THIN_M)
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
