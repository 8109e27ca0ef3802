"""Webs: faces of a part that stand for no cloth, because the scan has no depth in a narrow gap.

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

from smplxpp.clean.components import drop_specks
from smplxpp.core.mesh import TriangleMesh, row_lengths
from smplxpp.core.topology import manifold_corners
from smplxpp.core.validation import require_at_least

REACH = 2.0
"""How wide the sides of a fold are, in distances from the body."""

_WIDENINGS = 4
"""Rings by which a cut is widened at most where it touches itself; sides part as two vertices after that."""


@dataclass(frozen=True)
class WebConfig:
    """When an edge of a part is taken for a bridge; all must hold, so that cloth that only hangs over a gap stays.

    That the body's two surfaces face each other in the scan's pose is not a matter of degree and has no option.

    Attributes:
        valley: the part itself faces itself across the edge, as the bottom of a fold does: how far the normals of its
            two sides lean towards each other, 0 where cloth runs straight across and 1 where its sides touch.
        jump: the points of the body that are nearest to the edge's ends lie, at rest, at least this many times the
            edge's length apart. Along cloth that follows the body the two are about the same.
        stretch: unposing makes the edge at least this many times as long. Loose cloth, whose weights change slowly,
            stretches less, however far apart the limbs under it are.
        speck_area: pieces that the cut leaves with less than this fraction of the part's area go with it.
        rounds: cuts at most; after each the weights are found anew without what was cut.
    """

    valley: float = 0.1
    jump: float = 3.0
    stretch: float = 2.0
    speck_area: float = 1e-3
    rounds: int = 3

    def __post_init__(self) -> None:
        for name, least in (("valley", 0.0), ("jump", 1.0), ("stretch", 1.0), ("speck_area", 0.0), ("rounds", 0)):
            require_at_least(f"webs: {name}", getattr(self, name), least)


def find_webs(
    posed: TriangleMesh,
    rest: TriangleMesh,
    body: TriangleMesh,
    body_rest: TriangleMesh,
    *,
    config: WebConfig | None = None,
) -> Bool[np.ndarray, " M"]:
    """Find the faces of a part with an edge that bridges two surfaces of the body; see `WebConfig`.

    Args:
        posed: the part as scanned. rest: unposed.
        body: in the pose of the scan. body_rest: in the T-pose. All in metres.
    """
    config = config or WebConfig()
    ends = posed.edges
    foot, place, normal = _feet(posed.vertices, body, body_rest)
    length, at_rest, apart = (
        row_lengths(points[ends[:, 1]] - points[ends[:, 0]]) for points in (posed.vertices, rest.vertices, place)
    )
    across = foot[ends[:, 1]] - foot[ends[:, 0]]
    facing = (np.einsum("ij,ij->i", across, normal[ends[:, 0]]) > 0) & (
        np.einsum("ij,ij->i", across, normal[ends[:, 1]]) < 0
    )
    bridge = np.flatnonzero(facing & (apart > config.jump * length) & (at_rest > config.stretch * length))
    away = row_lengths(posed.vertices - foot)[ends].mean(axis=1)
    reach = np.maximum(REACH * away, REACH * length)
    bridge = bridge[_valleys(posed, ends[bridge], across[bridge], reach[bridge]) > config.valley]
    return _faces_with(posed.faces, ends[bridge], posed.vertex_count)


def cut_webs(
    part: TriangleMesh, web: Bool[np.ndarray, " M"], *, config: WebConfig | None = None
) -> tuple[TriangleMesh, Int[np.ndarray, " N"]]:
    """Leave out faces and the specks that this leaves; the borders are openings like a hem.

    Where cuts meet in a vertex, the smaller of its sides goes too: as two vertices at one place of the scan they would
    leave a border that touches itself, and what closes it (`smplxpp.assemble.darn`) would have faces without area.

    Returns the rest, manifold, and for each of its vertices the vertex of `part` that it is.
    """
    config = config or WebConfig()
    left, source = part.submesh(~web)
    for _ in range(_WIDENINGS):
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
    """Faces about every old vertex that has become several, but those about the one of them with the most faces."""
    count = np.bincount(faces.ravel(), minlength=len(old))
    by_size = np.lexsort((np.arange(len(old)), -count, old))
    smaller = np.zeros(len(old), dtype=bool)
    smaller[by_size[1:]] = old[by_size[1:]] == old[by_size[:-1]]
    return np.asarray(smaller[faces].any(axis=1))


def _valleys(
    part: TriangleMesh,
    edges: Int[np.ndarray, "E 2"],
    across: Float[np.ndarray, "E 3"],
    reach: Float[np.ndarray, " E"],
) -> Float[np.ndarray, " E"]:
    """How far the part's normals on both sides of an edge lean towards each other, in [-1, 1]; below 0 on a ridge.

    Args:
        across: directions from one side to the other. reach: distance up to which faces count as a side's, metres.
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


def _feet(
    points: Float[np.ndarray, "N 3"], body: TriangleMesh, body_rest: TriangleMesh
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """The nearest point of the body, where it is at rest, and the body's normal there in the pose."""
    _, face, nearest = igl.point_mesh_squared_distance(points, body.vertices, body.faces)
    corners = body.triangles[face]
    weights = igl.barycentric_coordinates(nearest, *(np.ascontiguousarray(corners[:, k]) for k in range(3)))
    return nearest, np.einsum("ij,ijk->ik", weights, body_rest.triangles[face]), body.face_normals[face]


def _faces_with(faces: Int[np.ndarray, "M 3"], edges: Int[np.ndarray, "E 2"], count: int) -> Bool[np.ndarray, " M"]:
    """Whether a face has one of the edges; `count` vertices there are."""

    def keys(pairs: np.ndarray) -> np.ndarray:
        return pairs.min(axis=-1) * count + pairs.max(axis=-1)

    own = keys(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2))
    return np.asarray(np.isin(own, keys(edges)).any(axis=1))
