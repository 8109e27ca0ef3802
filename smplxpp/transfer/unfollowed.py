"""Find arms that a part does not follow although they are near: beside empty sleeves, and under a poncho."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core import TriangleMesh, row_lengths
from smplxpp.core.topology import border_loops, manifold_corners
from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.enclosed import Enclosure, LimbAxis
from smplxpp.transfer.rings import piercings, rings_around

_LEAST_TUBE = 0.1
"""Length of the border of the narrowest empty tube, as a share of the body's extent; of the widest, three times it."""
_OPEN = 0.75
"""Least share of a turn about the trunk that what covers the arms has to make: a cape is open in front."""
_COVERED = 10
"""Planes across the trunk (20 cm) in which a ring has to go around an arm, too: armholes of a waistcoat are shorter."""


def empty_tubes(mesh: TriangleMesh, axes: list[LimbAxis], size: float) -> Bool[np.ndarray, " N"]:
    """Return the vertices of tubes that no limb is in, such as the sleeves of a coat over the shoulders.

    A tube starts at a border loop. Loops of equal distance from it along the surface stay about as long as it and hold
    no axis, over at least half their length; about a hole they grow, on a sheet they shrink.
    """
    empty = np.zeros(mesh.vertex_count, dtype=bool)
    edges = mesh.edges
    lengths = row_lengths(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]])
    graph = coo_matrix((lengths, edges.T), shape=(mesh.vertex_count,) * 2).tocsr()
    faces, vertex = manifold_corners(mesh.faces)
    for loop in (vertex[border] for border in border_loops(faces)):
        around = float(row_lengths(np.diff(mesh.vertices[loop], axis=0, append=mesh.vertices[loop[:1]])).sum())
        if not _LEAST_TUBE * size < around < 3 * _LEAST_TUBE * size or _holds_an_axis(mesh.vertices[loop], axes):
            continue
        distance = dijkstra(graph, directed=False, indices=loop, min_only=True, limit=around)
        depth = 0.0
        for level in np.arange(0.1, 1.0, 0.05) * around:
            ring = mesh.vertices[edges[((distance < level)[edges]).sum(axis=1) == 1]].mean(axis=1)
            # The ring's length, as that of the circle which its points would lie on.
            if len(ring) < 3 or _holds_an_axis(ring, axes):
                break
            spread = 2 * np.pi * np.sqrt(((ring - ring.mean(axis=0)) ** 2).sum(axis=1).mean())
            if not 0.5 * around < spread < 1.5 * around:
                break
            depth = level
        if depth > 0.5 * around:
            empty |= distance <= depth
    return empty


def unfollowed_arms(
    mesh: TriangleMesh, axes: list[LimbAxis], found: Enclosure, size: float, config: TransferConfig, joint_count: int
) -> Bool[np.ndarray, " J"]:
    """Return the joints (J,) of arms that the part does not follow although they are near: arms in no sleeve.

    Where the part has an empty sleeve, these are the whole arms. Where it goes around trunk and arm together, as a
    poncho does, the upper arm carries it, and forearm and hand move under it.
    """
    names = config.joint_names or JOINT_NAMES.get(joint_count, ())
    out = np.zeros(joint_count, dtype=bool)
    # The arms are the third and the fourth axis; fingers belong to their side's arm.
    bare = [(k, side) for k, side in ((2, "left_"), (3, "right_")) if not (found.limb == k).any()]
    if not bare:
        return out
    worn = ["hip", "knee", "ankle", "foot", "collar", "eye"]
    if empty_tubes(mesh, axes, size).any():
        hidden = [side for _, side in bare]
    else:
        hidden, worn = [side for k, side in bare if _covers(mesh, axes[-1], axes[k])], [*worn, "shoulder"]
    for k, name in enumerate(names):
        out[k] = name.startswith(tuple(hidden)) and not any(word in name for word in worn)
    return out


def _covers(mesh: TriangleMesh, trunk: LimbAxis, arm: LimbAxis) -> bool:
    """Return whether enough rings of a part about the trunk go around an arm, too."""
    side = trunk.tangents @ mesh.vertices.T - np.einsum("ij,ij->i", trunk.tangents, trunk.points)[:, None]
    count = sum((side > 0)[:, mesh.faces[:, c]].astype(np.int8) for c in range(3))
    cut = (count > 0) & (count < 3)
    both = 0
    for i in np.flatnonzero(cut.sum(axis=1) > 2):
        both += any(
            not ring.single
            for ring in rings_around(mesh, np.flatnonzero(cut[i]), side[i], trunk, int(i), [arm], closed=_OPEN)
        )
    return both >= _COVERED


def _holds_an_axis(ring: np.ndarray, axes: list[LimbAxis]) -> bool:
    """Return whether an axis pierces the plane of a ring's points within the middle of the ring."""
    centre = ring.mean(axis=0)
    normal = np.linalg.svd(ring - centre, full_matrices=False)[2][2]
    radius = np.median(row_lengths(ring - centre))
    return any((row_lengths(piercings(axis.points, centre, normal) - centre) < radius).any() for axis in axes)
