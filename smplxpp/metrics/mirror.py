"""Whether a scan is the mirror image of the person that the body was fitted to."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float64

from smplxpp.core.foreign import MeshLike, PointsLike, as_mesh, as_points
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.rotations import rotation_between

_STEPS = 15
# Farther points are capped: a coat's hem must not outvote the hands.
_CAP = 0.03


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
        center, across: a point of the plane to mirror at, and its normal: the body's middle, from hip to hip.
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
