"""Find arms and hands that a part does not follow although they are near: beside empty sleeves, under a poncho, in a
pocket.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core import TriangleMesh, row_lengths
from smplxpp.core.topology import border_loops, manifold_corners
from smplxpp.transfer.checks import extent
from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.correspond import closest_points
from smplxpp.transfer.enclosed import Enclosure, enclosed_by_one, limb_axes
from smplxpp.transfer.rings import LimbAxis, piercings, rings_around

_LEAST_TUBE = 0.1
"""Length of the border of the narrowest empty tube, as a share of the body's extent; of the widest, three times it."""
_OPEN = 0.75
"""Least share of a turn about the trunk that what covers the arms has to make: a cape is open in front."""
_COVERED = 10
"""Planes across the trunk (20 cm) in which a ring has to go around an arm, too: armholes of a waistcoat are shorter."""


_HAND, _ARM = ("wrist", "thumb", "index", "middle", "ring", "pinky"), ("collar", "shoulder", "elbow")
"""Parts of the names of joints of hands and of arms."""


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


@dataclass(frozen=True, eq=False)
class Unfollowed:
    """Arms in no sleeve, which a part does not follow although they are near.

    Attributes:
        joints: of these arms.
        tubes: vertices of empty sleeves.
        shoulders: indices of the shoulders that the part lies on, going around trunk and arm together.
    """

    joints: Bool[np.ndarray, " J"]
    tubes: Bool[np.ndarray, " N"]
    shoulders: tuple[int, ...]


def unfollowed_arms(
    mesh: TriangleMesh, axes: list[LimbAxis], found: Enclosure, size: float, config: TransferConfig, joint_count: int
) -> Unfollowed:
    """Find the arms that the part does not follow although they are near: arms in no sleeve.

    Where the part has an empty sleeve, these are the whole arms. Where it goes around trunk and arm together, as a
    poncho does, the upper arm carries it, and forearm and hand move under it.
    """
    names = config.joint_names or JOINT_NAMES.get(joint_count, ())
    out, tubes = np.zeros(joint_count, dtype=bool), np.zeros(mesh.vertex_count, dtype=bool)
    # The arms are the third and the fourth axis; fingers belong to their side's arm.
    bare = [(k, side) for k, side in ((2, "left_"), (3, "right_")) if not (found.limb == k).any()]
    if not bare:
        return Unfollowed(out, tubes, ())
    tubes, covered = empty_tubes(mesh, axes, size), []
    worn = ["hip", "knee", "ankle", "foot", "collar", "eye"]
    if tubes.any():
        hidden = [side for _, side in bare]
    else:
        over = _covered(mesh, axes[-1], [axes[k] for k, _ in bare])
        hidden, worn = [side for (_, side), own in zip(bare, over, strict=True) if own], [*worn, "shoulder"]
        covered = [names.index(f"{side}shoulder") for side in hidden]
    for k, name in enumerate(names):
        out[k] = name.startswith(tuple(hidden)) and not any(word in name for word in worn)
    return Unfollowed(out, tubes, tuple(covered))


@dataclass(frozen=True, eq=False)
class PassedHand:
    """Cloth that passes a hand, without being worn on it.

    Attributes:
        vertices: that are nearest to the hand, and cloth of the trunk.
        hand: joints of the hand.
        arm: joints of the hand and its arm.
    """

    vertices: Bool[np.ndarray, " N"]
    hand: Bool[np.ndarray, " J"]
    arm: Bool[np.ndarray, " J"]

    def without_arm(self, weights: Float64[np.ndarray, "N J"]) -> Float64[np.ndarray, "N J"]:
        """Return weights whose rows of these vertices leave the arm out, unless they have nothing else."""
        out = np.where(self.vertices[:, None] & self.arm, 0.0, weights)
        total = out.sum(axis=1, keepdims=True)
        return np.where(total > 1e-3, out / np.maximum(total, 1e-3), weights)


def passed_hands(
    mesh: TriangleMesh, copied: Float64[np.ndarray, "N J"], found: Enclosure | None, config: TransferConfig
) -> list[PassedHand]:
    """Find the hands at the sleeves of a part that it passes and is not worn on.

    What is worn on a hand, or ends at it, continues into the sleeve; cloth of the trunk that a hand lies behind, in
    front of, or in, continues into the trunk. The longer of the two borders of the vertices nearest to a hand decides;
    cloth is then the trunk's where that border is nearer along the surface.

    Args:
        mesh: the part.
        copied: weights of the body's closest points.
        found: the limbs that it goes around; capes and skirts, which have no sleeves, blend what is near. None leaves
            it open whether there are sleeves.
        config: settings, with the names of the joints.
    """
    names = config.joint_names or JOINT_NAMES.get(copied.shape[1], ())
    edges = mesh.edges
    length = row_lengths(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]])
    out = []
    for limb, side in ((2, "left_"), (3, "right_")):
        hand, arm = (
            np.array([name.startswith(side) and any(word in name for word in words) for name in names], dtype=bool)
            for words in (_HAND, _HAND + _ARM)
        )
        at_hand, on_arm = (copied[:, joints].sum(axis=1) > 0.5 for joints in (hand, arm))
        # A sleeve lies about the arm that it goes around.
        sleeve = None if found is None else (found.limb == limb) & (found.share > 0.5)
        if sleeve is not None and not on_arm[sleeve].sum() > 0.5 * sleeve.sum():
            continue
        # The edges across the border of what is at the hand, and their ends on its other side.
        border = at_hand[edges[:, 0]] != at_hand[edges[:, 1]]
        outer = np.where(at_hand[edges[:, 0]], edges[:, 1], edges[:, 0])[border]
        if length[border] @ ~on_arm[outer] <= length[border] @ on_arm[outer]:
            continue
        within = at_hand[edges].any(axis=1)
        graph = coo_matrix((length[within], edges[within].T), shape=(mesh.vertex_count,) * 2).tocsr()
        far = [
            dijkstra(graph, directed=False, indices=np.unique(outer[ends]), min_only=True)
            if ends.any()
            else np.full(mesh.vertex_count, np.inf)
            for ends in (~on_arm[outer], on_arm[outer])
        ]
        out.append(PassedHand(at_hand & (far[0] <= far[1]), hand, arm))
    return out


def webs_to_hands(
    source: TriangleMesh,
    weights: Float64[np.ndarray, "V J"],
    target: TriangleMesh,
    config: TransferConfig,
    *,
    limbs: Enclosure | None = None,
) -> Bool[np.ndarray, " M"]:
    """Return the faces of a part that join cloth that passes a hand with the sleeve, as scans fuse them.

    Args:
        source: the body.
        weights: of its vertices.
        target: the part, in the body's pose.
        config: settings, with the names of the joints.
        limbs: that the part goes around, where the caller has them.
    """
    web = np.zeros(target.face_count, dtype=bool)
    copied = closest_points(source, target).interpolate(source, weights)
    # Rings are looked for only where cloth passes a hand at all.
    if not passed_hands(target, copied, None, config):
        return web
    if limbs is None:
        axes = limb_axes(source, weights, extent(source), config)
        if not axes:
            return web
        limbs = enclosed_by_one(target, axes, weights.shape[1])
    for passed in passed_hands(target, copied, limbs, config):
        on_arm = (copied[:, passed.arm].sum(axis=1) > 0.5) & ~passed.vertices
        web |= passed.vertices[target.faces].any(axis=1) & on_arm[target.faces].any(axis=1)
    return web


def _covered(mesh: TriangleMesh, trunk: LimbAxis, arms: list[LimbAxis]) -> list[bool]:
    """Return for each arm whether enough rings of a part about the trunk go around it, too."""
    rings = rings_around(mesh, trunk, arms, closed=_OPEN)
    return [len({plane for plane, ring in rings if k in ring.holds}) >= _COVERED for k in range(len(arms))]


def _holds_an_axis(ring: np.ndarray, axes: list[LimbAxis]) -> bool:
    """Return whether an axis pierces the plane of a ring's points within the middle of the ring."""
    centre = ring.mean(axis=0)
    normal = np.linalg.svd(ring - centre, full_matrices=False)[2][2]
    radius = np.median(row_lengths(ring - centre))
    return any((row_lengths(piercings(axis.points, centre, normal) - centre) < radius).any() for axis in axes)
