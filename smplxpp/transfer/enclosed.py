"""Find which limb each ring of a garment goes around, and the weights at that place along the limb."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import cKDTree

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core import TriangleMesh, row_lengths
from smplxpp.core.topology import component_labels
from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.rings import LimbAxis, Septum, heights, rings_around, septum_of

_SPACING = 0.01
"""Distance of the planes along a limb, as a share of the body's extent: less than a ring of a coarse garment."""
_BEYOND = 0.1
"""How far a limb's axis continues past ankle and wrist, as a share of the body's extent: hems reach lower."""
_KERNEL = 0.006
"""Standard deviation of the mean of weights along a limb, as a share of the body's extent (1 cm)."""


@dataclass(frozen=True, eq=False)
class Enclosure:
    """Which limb each of N vertices goes around.

    Attributes:
        share: 0 to 1, how far the vertex belongs to rings around one limb and nothing else.
        weights: of that limb's skin at the same place along it; zero where `share` is.
        limb: index of the limb, -1 where `share` is 0.
        centre: the point of the limb's axis at its place, metres; zero where `share` is.
        about_legs: whether a closed ring about one leg or both cuts a face of the vertex.
        slack: what folds hide of the radius of rings about both legs there, metres; NaN where there is none.
    """

    share: Float64[np.ndarray, " N"]
    weights: Float64[np.ndarray, "N J"]
    limb: Int[np.ndarray, " N"]
    centre: Float64[np.ndarray, "N 3"]
    about_legs: Bool[np.ndarray, " N"]
    slack: Float64[np.ndarray, " N"]

    def of(self, rows: Int[np.ndarray, " n"]) -> Enclosure:
        """Return the enclosure of some of the vertices."""
        return Enclosure(**{name: values[rows] for name, values in vars(self).items()})

    def joining_legs(self, faces: Int[np.ndarray, "M 3"]) -> Bool[np.ndarray, " M"]:
        """Return the faces from one leg to the other, where a scan has fused trousers."""
        first, second = (((self.limb == k) & (self.share > 0.5))[faces].any(axis=1) for k in (0, 1))
        return np.asarray(first & second)


def limb_axes(
    source: TriangleMesh, weights: Float[np.ndarray, "V J"], size: float, config: TransferConfig
) -> list[LimbAxis]:
    """Return the axes of both legs and arms, then that of trunk and head; none for joints with other names.

    The end of a bone is where the skin follows it and the next one alike: the mean of the skin's vertices, weighted by
    the product of both weights. So no skeleton is needed beside the weights.
    """
    names = config.joint_names or JOINT_NAMES.get(weights.shape[1], ())
    chains = [
        *(("pelvis", f"{side}_hip", f"{side}_knee", f"{side}_ankle") for side in ("left", "right")),
        *((f"{side}_collar", f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist") for side in ("left", "right")),
        ("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
    ]
    out = []
    for chain in chains:
        if not set(chain) <= set(names):
            return []
        joints = tuple(names.index(name) for name in chain)
        shares = [weights[:, a] * weights[:, b] for a, b in itertools.pairwise(joints)]
        if not all(share.any() for share in (*shares, weights[:, joints[0]], weights[:, joints[-1]])):
            return []
        knots = [_mean(source.vertices, share) for share in shares]
        # A limb starts where it leaves the trunk and continues straight past its end; the trunk ends in the head.
        if chain[-1] == "head":
            ends = [_mean(source.vertices, weights[:, joints[k]]) for k in (0, -1)]
            line = [ends[0], *knots, ends[1]]
        else:
            joints, line = joints[1:], knots
            line.append(line[-1] + _BEYOND * size * (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2]))
        onwards = 0.5 if chain[-1].endswith("ankle") else 0.0
        out.append(_axis(np.array(line), joints, source, weights, size, onwards=onwards))
    return out


def enclosed_by_one(mesh: TriangleMesh, axes: list[LimbAxis], joint_count: int) -> Enclosure:
    """Return for each vertex how far its ring goes around one limb alone, and the weights at that place.

    Planes across each limb's axis cut the surface into rings. A ring goes around an axis if the angle under which it
    is seen from there adds up to a full turn. A ring about one leg is that of trousers, one about both is a skirt's,
    one about an arm and the trunk a shirt's below the armpit. This is a matter of topology: how wide the garment is,
    and what else is near it, does not count.

    Args:
        mesh: the part; open, with holes.
        axes: of `limb_axes`; the last one is the trunk's.
        joint_count: J.
    """
    n = mesh.vertex_count
    alone, other = np.zeros((len(axes), n)), np.zeros((len(axes), n))
    place = np.zeros((len(axes), n))
    slack, about_both = np.zeros((2, n))
    # Each limb's rings.
    rings = [rings_around(mesh, axis, [a for a in axes if a is not axis]) for axis in axes[:-1]]
    # Where one leg is distinguished from the other, so is that from it.
    walls = [septum_of(found, len(axis.points)) for found, axis in zip(rings, axes[:-1], strict=True)]
    for k, m in ((0, 1), (1, 0)):
        wall = walls[m]
        if walls[k] is None and wall is not None:
            walls[k] = septum_of(rings[k], len(axes[k].points), first=wall.first)
    for k, (axis, wall) in enumerate(zip(axes[:-1], walls, strict=True)):
        if not rings[k]:
            continue
        side, step = heights(axis, mesh), np.linalg.norm(axis.points[1] - axis.points[0])
        # Planes across a leg that is spread in the T-pose leave a skirt's hem between the legs: below rings about both
        # legs up to two (4 cm) about one are no leg of trousers.
        most = 2
        tube = k > 1 or len({plane for plane, ring in rings[k] if not ring.holds}) > most
        tube |= not any(ring.holds for _, ring in rings[k])
        for plane, ring in rings[k]:
            if k < 2 and ring.holds:
                slack[ring.corners] += ring.slack
                about_both[ring.corners] += 1.0
            corners, single = ring.corners, not ring.holds and tube
            if wall is not None and plane >= wall.first and ring.neck is not None and ring.neck.width < 1.0:
                # This limb's are the vertices on its axis' side of the wall.
                here = np.full(len(corners), float(plane))
                corners, single = corners[wall.past(mesh.vertices[corners], here) < 0], True
            if len(corners):
                # A vertex of a cut face counts the more, the nearer it lies to the plane.
                near = step / (np.abs(side[plane, corners]) + 0.05 * step)
                (alone if single else other)[k, corners] += near
                if single:
                    place[k, corners] += near * (plane + side[plane, corners] / step)
    share, at, limb = np.zeros(n), np.zeros(n), np.full(n, -1)
    for k in range(len(axes) - 1):
        seen = alone[k] > 0
        own = np.where(seen, alone[k] / np.maximum(alone[k] + other[k], 1e-300), 0.0)
        better = own > share
        share[better], limb[better] = own[better], k
        at[better] = place[k, better] / alone[k, better]
    open_rows = (alone + other).sum(axis=0) == 0
    legs = [(k, wall) for k, wall in enumerate(walls[:2]) if wall is not None]
    _fill_fused(mesh, axes, legs, share, at, limb, open_rows=open_rows)
    _continue_to_hems(mesh, axes, share, at, limb, open_rows=open_rows)
    # The axis' point and the weights at each vertex's place along its limb.
    weights, centre = np.zeros((n, joint_count)), np.zeros((n, 3))
    for k, axis in enumerate(axes[:-1]):
        rows = np.flatnonzero(limb == k)
        places = np.arange(len(axis.points))
        for out, values in ((weights, axis.weights), (centre, axis.points)):
            out[rows] = np.stack([np.interp(at[rows], places, column) for column in values.T], axis=1)
    slack = np.where(about_both > 0, slack / np.maximum(about_both, 1.0), np.nan)
    return Enclosure(share, weights, limb, centre, np.asarray((alone[:2] + other[:2]).any(axis=0)), slack)


def _continue_to_hems(
    mesh: TriangleMesh,
    axes: list[LimbAxis],
    share: np.ndarray,
    at: np.ndarray,
    limb: np.ndarray,
    *,
    open_rows: Bool[np.ndarray, " N"],
) -> None:
    """Continue share, place and limb, in place, outwards to vertices that no closed ring reaches.

    Near a slanted or jagged hem planes across the limb leave the cloth, so that they make no ring. Only vertices from
    eight planes before the last ring on count, and none much farther off the axis than rings are: the side of an open
    coat below the armpit makes no ring either. A scan goes round the edge of a hem and some way up inside: on legs
    whatever is within two planes of a ring there follows it, too.
    """
    rings = share > 0.5
    reach = 2.0 * float(np.linalg.norm(axes[0].points[1] - axes[0].points[0]))
    lining = np.zeros(mesh.vertex_count, dtype=bool)
    if rings.any():
        lining = (share == 0) & (
            cKDTree(mesh.vertices[rings]).query(mesh.vertices, distance_upper_bound=reach)[0] < reach
        )
    last, widest = np.zeros(len(axes)), np.zeros(len(axes))
    for k, axis in enumerate(axes[:-1]):
        rows = np.flatnonzero(limb == k)
        if len(rows):
            index = np.clip(at[rows].round().astype(int), 0, len(axis.points) - 1)
            last[k] = at[rows].max()
            widest[k] = 1.2 * row_lengths(mesh.vertices[rows] - axis.points[index]).max()
    ends = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    # Hems are seldom more slanted, and linings seldom deeper, than 16 vertices are high.
    for _ in range(16):
        legs = lining[ends[:, 1]] & (limb[ends[:, 0]] >= 0) & (limb[ends[:, 0]] < 2)
        pairs = ends[(share[ends[:, 0]] > 0) & (share[ends[:, 1]] == 0) & (open_rows[ends[:, 1]] | legs)]
        if not len(pairs):
            return
        origin, next_one = pairs.T
        index = np.clip(at[origin].astype(int), 0, None)
        tangent, step, off = np.zeros((len(pairs), 3)), np.ones(len(pairs)), np.zeros(len(pairs))
        for k, axis in enumerate(axes[:-1]):
            rows = limb[origin] == k
            nearest = np.minimum(index[rows], len(axis.points) - 1)
            tangent[rows] = axis.tangents[nearest]
            offset = mesh.vertices[next_one[rows]] - axis.points[nearest]
            # The part of the offset across the axis.
            off[rows] = row_lengths(offset - np.einsum("ij,ij->i", offset, tangent[rows])[:, None] * tangent[rows])
            step[rows] = np.linalg.norm(axis.points[1] - axis.points[0])
        along = np.einsum("ij,ij->i", mesh.vertices[next_one] - mesh.vertices[origin], tangent)
        # Only outwards: upwards cloth that makes no ring is an open jacket's shoulder.
        outwards = along > -0.3 * row_lengths(mesh.vertices[next_one] - mesh.vertices[origin])
        outwards |= lining[next_one] & (limb[origin] < 2)
        outwards &= at[origin] > last[limb[origin]] - 8.0
        outwards &= off < widest[limb[origin]]
        origin, next_one, along, step = (values[outwards] for values in (origin, next_one, along, step))
        share[next_one], limb[next_one] = share[origin], limb[origin]
        at[next_one] = at[origin] + along / step
        open_rows = open_rows & (share == 0)


def _fill_fused(
    mesh: TriangleMesh,
    axes: list[LimbAxis],
    walls: list[tuple[int, Septum]],
    share: np.ndarray,
    at: np.ndarray,
    limb: np.ndarray,
    *,
    open_rows: Bool[np.ndarray, " N"],
) -> None:
    """Give what is left of two fused tubes, in place, to the limb on whose side of the wall it lies.

    That is their lining, and hems where planes leave the cloth: of a tube that goes around two legs nothing below the
    crotch is between them.
    """
    if not walls:
        return
    component = component_labels(mesh.edges, mesh.vertex_count)
    of_tubes = np.isin(component, component[np.isin(limb, [k for k, _ in walls])]) & open_rows
    nearest = np.full(mesh.vertex_count, np.inf)
    for k, wall in walls:
        axis = axes[k]
        step = float(np.linalg.norm(axis.points[1] - axis.points[0]))
        index = cKDTree(axis.points).query(mesh.vertices)[1]
        plane = index + np.einsum("ij,ij->i", mesh.vertices - axis.points[index], axis.tangents[index]) / step
        past = wall.past(mesh.vertices, plane)
        rows = of_tubes & (plane >= wall.first) & (past < np.minimum(nearest, 0.5 * step))
        limb[rows], at[rows], nearest[rows] = k, plane[rows], past[rows]
    share[np.isfinite(nearest)] = 1.0


def _mean(vertices: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the mean of vertices weighted by `share`."""
    return share @ vertices / share.sum()


def _axis(
    line: np.ndarray,
    joints: tuple[int, ...],
    source: TriangleMesh,
    weights: np.ndarray,
    size: float,
    *,
    onwards: float,
) -> LimbAxis:
    """Return a polyline evenly resampled, with tangents that turn gradually and the mean weights of the skin there."""
    length = np.concatenate([[0.0], np.cumsum(row_lengths(np.diff(line, axis=0)))])
    at = np.linspace(0, length[-1], max(2, int(np.ceil(length[-1] / (_SPACING * size))) + 1))
    points = np.stack([np.interp(at, length, column) for column in line.T], axis=1)
    tangents = np.gradient(points, axis=0)
    # At a bent joint the planes turn over three points to each side.
    kernel = np.ones(7) / 7
    tangents = np.stack([np.convolve(np.pad(c, 3, mode="edge"), kernel, mode="valid") for c in tangents.T], axis=1)
    tangents /= np.maximum(row_lengths(tangents), 1e-300)[:, None]
    # Skin that follows the limb, without what hangs on its last joint, such as fingers and toes.
    own = weights[:, list(joints)].sum(axis=1) > 0.5
    skin, rows = source.vertices[own], weights[own]
    nearest = cKDTree(points).query(skin)[1]
    kernel = np.exp(-0.5 * ((np.arange(len(points))[:, None] - nearest) * (at[1] - at[0]) / (_KERNEL * size)) ** 2)
    # Far from any skin the kernel vanishes; the least share there is that of the nearest.
    kernel += 1e-12
    mean = kernel @ rows
    whole = np.concatenate([points, points[-1:] + onwards * size * tangents[-1:]])
    return LimbAxis(joints, points, tangents, mean / mean.sum(axis=1, keepdims=True), whole)
