"""Find and cut bridges: faces of a part that stand for no cloth, because the scan has no depth in a narrow gap.

A scan is one outer surface. Where a sleeve touches the side under an arm, no camera sees the gap, and the surface runs
straight from one to the other. Skin weights that are smoothed along the surface then mix arm and side far into both,
and the T-pose tears all of that open.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from smplxpp.clean.parts import drop_specks
from smplxpp.core import MeshLike, TriangleMesh, as_mesh, require_at_least, row_lengths
from smplxpp.core.topology import manifold_corners


@dataclass(frozen=True)
class BridgeConfig:
    """Thresholds of `find_bridges`; all must hold, so that cloth that only hangs over a gap stays.

    That the body's two surfaces face each other in the scan's pose is a condition without a threshold.

    Attributes:
        valley: how far the normals of the edge's two sides lean towards each other, as at the bottom of a fold: 0 where
            cloth runs straight across, 1 where its sides touch.
        jump: distance in the rest pose between the body points nearest to the edge's ends, as a multiple of the edge's
            length. It is about 1 along cloth that follows the body.
        stretch: factor of the edge's length in the T-pose. Loose cloth, whose weights change slowly, stretches less,
            however far apart the limbs under it are.
        tear: factor of the edge's length in the T-pose from which an edge is torn, however its sides lie; see
            `find_tears`.
        speck_area: area fraction of the part below which pieces that the cut leaves are removed, too.
        rounds: largest number of cuts of bridges, and of tears; after each the weights are computed again without the
            cut faces. 0 cuts nothing.
    """

    valley: float = 0.1
    jump: float = 3.0
    stretch: float = 2.0
    tear: float = 4.0
    speck_area: float = 1e-3
    rounds: int = 3

    def __post_init__(self) -> None:
        least_of = {"valley": 0.0, "jump": 1.0, "stretch": 1.0, "tear": 1.0, "speck_area": 0.0, "rounds": 0}
        for name, least in least_of.items():
            require_at_least(f"bridges: {name}", getattr(self, name), least)


def find_bridges(
    posed: MeshLike,
    rest: MeshLike,
    body: MeshLike,
    body_rest: MeshLike,
    *,
    config: BridgeConfig | None = None,
) -> Bool[np.ndarray, " M"]:
    """Find the faces of a part with an edge that bridges two surfaces of the body; see `BridgeConfig`.

    Args:
        posed: the part as scanned, metres.
        rest: the part in the T-pose.
        body: the body in the pose of the scan.
        body_rest: the body in the T-pose.
        config: thresholds.
    """
    posed = as_mesh(posed, subject="posed")
    rest = as_mesh(rest, subject="rest")
    body = as_mesh(body, subject="body")
    body_rest = as_mesh(body_rest, subject="body rest")
    config = config or BridgeConfig()
    # For each edge: its lengths posed and in the T-pose, and the distance at rest of the body points nearest to its
    # ends.
    ends = posed.edges
    nearest, place, normal = _nearest_on_body(posed.vertices, body, body_rest)
    length, at_rest, apart = (
        row_lengths(points[ends[:, 1]] - points[ends[:, 0]]) for points in (posed.vertices, rest.vertices, place)
    )
    across = nearest[ends[:, 1]] - nearest[ends[:, 0]]
    facing = _facing(nearest, normal, ends)
    bridge = np.flatnonzero(facing & (apart > config.jump * length) & (at_rest > config.stretch * length))
    # The sides of a fold are two distances from the body wide, and at least two edges.
    away = row_lengths(posed.vertices - nearest)[ends].mean(axis=1)
    reach = np.maximum(2.0 * away, 2.0 * length)
    bridge = bridge[_fold_depth(posed, ends[bridge], across[bridge], reach[bridge]) > config.valley]
    return _faces_with(posed.faces, ends[bridge], posed.vertex_count)


def find_tears(
    posed: MeshLike,
    rest: MeshLike,
    body: MeshLike,
    body_rest: MeshLike,
    *,
    config: BridgeConfig | None = None,
) -> Bool[np.ndarray, " M"]:
    """Find the faces of a part that unposing tears, where no fold shows a bridge.

    A coarse scan joins a sleeve and a jacket, a cuff and a pocket, or two trouser legs without a fold, and leaves faces
    beside a cut whose weights mix two limbs. Edges that leave one limb and arrive at another, as `find_bridges` has
    them, come first; where there are none, every torn edge counts, because the scan's cloth is lost there in any case.
    Arguments as for `find_bridges`.
    """
    posed = as_mesh(posed, subject="posed")
    rest = as_mesh(rest, subject="rest")
    body = as_mesh(body, subject="body")
    body_rest = as_mesh(body_rest, subject="body rest")
    config = config or BridgeConfig()
    ends = posed.edges
    nearest, place, normal = _nearest_on_body(posed.vertices, body, body_rest)
    length, at_rest, apart = (
        row_lengths(points[ends[:, 1]] - points[ends[:, 0]]) for points in (posed.vertices, rest.vertices, place)
    )
    # Edges that grow by less than half a centimetre are tiny edges, which a little noise of the weights stretches.
    torn = (at_rest > config.tear * length) & (at_rest - length > _LEAST_GROWTH * _extent(body))
    across = torn & (apart > config.jump * length) & _facing(nearest, normal, ends)
    return _faces_with(posed.faces, ends[across if across.any() else torn], posed.vertex_count)


_LEAST_GROWTH = 0.003
"""Growth of a torn edge, as a share of the body's extent: 5 mm of a person."""


def _extent(body: TriangleMesh) -> float:
    return float(np.ptp(body.vertices, axis=0).max())


def _facing(nearest: np.ndarray, normal: np.ndarray, ends: Int[np.ndarray, "E 2"]) -> Bool[np.ndarray, " E"]:
    """Return whether the body's surfaces nearest to the ends of edges face each other: each normal points across."""
    across = nearest[ends[:, 1]] - nearest[ends[:, 0]]
    leaves = np.einsum("ij,ij->i", across, normal[ends[:, 0]]) > 0
    return np.asarray(leaves & (np.einsum("ij,ij->i", across, normal[ends[:, 1]]) < 0))


def cut_bridges(
    part: MeshLike, bridge: Bool[np.ndarray, " M"], *, config: BridgeConfig | None = None
) -> tuple[TriangleMesh, Int[np.ndarray, " N"]]:
    """Remove the faces of bridges, and the specks that this leaves; the new borders are openings like a hem.

    Where cuts meet in a vertex, the smaller of its sides is removed, too. Otherwise the vertex would be doubled at one
    place of the scan, the border would touch itself, and the patch that closes it (`smplxpp.assemble.fill_holes`) would
    have faces without area.

    Returns:
        The rest, manifold, and for each of its vertices the vertex of `part` that it is.
    """
    part = as_mesh(part, subject="part")
    config = config or BridgeConfig()
    left, source = part.submesh(~bridge)
    # Widen the cut ring by ring where it touches itself. After four rings the sides part as two vertices.
    for _ in range(4):
        faces, of_kept = manifold_corners(left.faces)
        narrow = _smaller_sides(faces, of_kept)
        if not narrow.any():
            break
        left, kept = left.submesh(~narrow)
        source = source[kept]
    left, of_left = left.submesh(drop_specks(left, area_fraction=config.speck_area))
    faces, of_kept = manifold_corners(left.faces)
    return TriangleMesh(left.vertices[of_kept], faces), source[of_left][of_kept]


def _smaller_sides(faces: Int[np.ndarray, "M 3"], old: Int[np.ndarray, " N"]) -> Bool[np.ndarray, " M"]:
    """Return the faces around all copies of a doubled vertex but the copy with the most faces.

    Args:
        faces: faces after vertices were doubled (`manifold_corners`).
        old: the old vertex of each vertex.
    """
    count = np.bincount(faces.ravel(), minlength=len(old))
    by_size = np.lexsort((np.arange(len(old)), -count, old))
    smaller = np.zeros(len(old), dtype=bool)
    smaller[by_size[1:]] = old[by_size[1:]] == old[by_size[:-1]]
    return np.asarray(smaller[faces].any(axis=1))


def _fold_depth(
    part: TriangleMesh,
    edges: Int[np.ndarray, "E 2"],
    across: Float[np.ndarray, "E 3"],
    reach: Float[np.ndarray, " E"],
) -> Float[np.ndarray, " E"]:
    """Return how far the normals on both sides of an edge lean towards each other, in [-1, 1]; below 0 on a ridge.

    With the mean normals n1, n2 of the two sides and the unit direction d across the edge it is (n1 - n2) d / 2.

    Args:
        part: the part.
        edges: vertices of the edges.
        across: directions from one side to the other.
        reach: distance up to which faces belong to a side, metres.
    """
    tree = cKDTree(part.face_centers)
    out = np.zeros(len(edges))
    middle = part.vertices[edges].mean(axis=1)
    for k, near in enumerate(tree.query_ball_point(middle, reach)):
        direction = across[k] / np.linalg.norm(across[k])
        side = (part.face_centers[near] - middle[k]) @ direction
        first, second = (part.face_cross[near][chosen].sum(axis=0) for chosen in (side < 0, side > 0))
        lengths = np.linalg.norm(first), np.linalg.norm(second)
        if min(lengths) > 0:
            out[k] = 0.5 * (first / lengths[0] - second / lengths[1]) @ direction
    return out


def _nearest_on_body(
    points: Float[np.ndarray, "N 3"], body: TriangleMesh, body_rest: TriangleMesh
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Return the nearest point of the body, its place in the rest pose, and the body's normal there in the pose."""
    _, face, nearest = igl.point_mesh_squared_distance(points, body.vertices, body.faces)
    corners = body.triangles[face]
    weights = igl.barycentric_coordinates(nearest, *(np.ascontiguousarray(corners[:, k]) for k in range(3)))
    return nearest, np.einsum("ij,ijk->ik", weights, body_rest.triangles[face]), body.face_normals[face]


def _faces_with(faces: Int[np.ndarray, "M 3"], edges: Int[np.ndarray, "E 2"], count: int) -> Bool[np.ndarray, " M"]:
    """Return whether each face has one of the edges; `count` is the number of vertices."""

    def keys(pairs: np.ndarray) -> np.ndarray:
        return pairs.min(axis=-1) * count + pairs.max(axis=-1)

    own = keys(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2))
    return np.asarray(np.isin(own, keys(edges)).any(axis=1))
