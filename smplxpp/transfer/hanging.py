"""Bound what cloth that hangs free before both legs takes of them: the rest of its weight stays with the pelvis."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from smplxpp.core import TriangleMesh
from smplxpp.transfer.anchors import smooth_step
from smplxpp.transfer.checks import extent
from smplxpp.transfer.enclosed import Enclosure
from smplxpp.transfer.rings import LimbAxis, body_directions

_RAMP = (-0.05, 0.1)
"""From how far above the hip joints (negative) to how far below them the bound grows from 0 on, as shares of the body's
extent. Skin follows the leg from 5 cm under the joint on, cloth that hangs from the waist later: between the authored
weights of `benchmarks transfer_garments` and those that fit the same garments simulated."""
_LEAST = 0.1
"""The bound above the ramp: a tutu, which stands off the hips, follows the thighs a little (worst ratio there)."""
_LEGS = 0.03
"""Depth below the hip joints that cloth has to reach, as a share of the body's extent (6 cm): a shirt ends above it."""
_THIGHS = 0.08
"""Depth of the middle of the thighs below the hip joints, as a share of the body's extent (15 cm)."""
_HALF = 1.2
"""Cone of a skirt (distance off the legs by height below the waist) of which the legs have at most a half (worst ratio
of loose garments on three persons)."""
_RING = 0.02
"""Height of the bins over which distances are averaged, as a share of the body's extent (4 cm)."""
_LEG_SHARE = 0.05
"""Share of a component that rings about one leg alone hold from which on it counts as trousers."""


def beside_trunk(
    vertices: Float[np.ndarray, "N 3"],
    weights: Float[np.ndarray, "N J"],
    copied: Float[np.ndarray, "N J"],
    near: Float[np.ndarray, " N"],
    trunk: LimbAxis,
    shoulders: tuple[int, ...],
) -> Float64[np.ndarray, "N J"]:
    """Return weights that divide what follows the trunk as the skin at the same height does, where that is lower.

    A cape that touches the shoulders alone has only them to inpaint from, so that all of it would turn with the chest.
    What hangs beside the waist turns with the waist; what stands off it, as a tutu does, with what carries it.

    Args:
        vertices: N places.
        weights: of all J joints.
        copied: of the nearest skin.
        near: 1 where the nearest skin tells the height, 0 where the axis of the trunk does, between which it is mixed.
        trunk: its axis, with pelvis and spine as its first four joints.
        shoulders: further joints of the trunk: the collars, and shoulders that the part lies on.
    """
    low, high = list(trunk.joints[:3]), [trunk.joints[3], *shoulders]
    at = trunk.weights[cKDTree(trunk.points).query(vertices)[1]]
    here = np.clip(near * smooth_step(copied[:, [*trunk.joints, *shoulders]].sum(axis=1), 0.5, 0.9), 0.0, 1.0)
    at = at + here[:, None] * (copied - at)
    # The share of pelvis and waist in the trunk's skin there, and what is left to chest and shoulders.
    below = at[:, low].sum(axis=1)
    share = below / np.maximum(at[:, [*trunk.joints, *shoulders]].sum(axis=1), 1e-9)
    total, above = weights[:, low + high].sum(axis=1), weights[:, high] + 1e-9 * (np.arange(len(high)) == 0)
    out = np.array(weights, dtype=np.float64)
    out[:, low] = (total * share / np.maximum(below, 1e-9))[:, None] * at[:, low]
    out[:, high] = (total * (1.0 - share) / above.sum(axis=1))[:, None] * above
    # Places along the spine, of which only lower ones are taken; those lower by a fifth of a joint in full.
    lower_joints = 0.2
    place = np.array([0.0, 1.0, 2.0, *(3.0 for _ in high)])
    lower = (weights[:, low + high] - out[:, low + high]) @ place
    return weights + smooth_step(lower, 0.0, lower_joints)[:, None] * (out - weights)


@dataclass(frozen=True, eq=False)
class HangingCloth:
    """How cloth hangs before both legs, at each of N vertices.

    Attributes:
        free: 0 to 1, how far the vertex hangs off the skin, before both legs.
        wide: 0 to 1, how far that is a wide skirt, or cloth that is open, as a coat is.
        bound: how much of the vertex's weight the legs can have.
    """

    free: Float64[np.ndarray, " N"]
    wide: Float64[np.ndarray, " N"]
    bound: Float64[np.ndarray, " N"]


def cloth_before_legs(
    depth: Float[np.ndarray, " N"],
    component: Int[np.ndarray, " N"],
    distance: Float[np.ndarray, " N"],
    limbs: Enclosure,
    behind: Float[np.ndarray, " N"],
    *,
    size: float,
    cone: tuple[float, float],
) -> HangingCloth:
    """Return how cloth hangs before both legs, and how much of its weight they can have: 1 on the skin, for trousers.

    A skirt hangs from the waist. The wider it is, the less of a thigh's turn reaches it. Let u be the height below the
    hip joints along the legs, and r the mean distance of the cloth at that height by that height (the tangent of half
    the cone's angle; above u = 0.03 E its value there). The distance is that of the cloth with its folds smoothed out,
    because a circle skirt that has settled hangs as close as a narrow one. The bound is the lesser of

        1 - hung (1 - ramp'(u)) ,   1 - hung wide (1 - ramp(u) / (1 + r / 1.2))

    where `ramp` grows from 0.1 at u = -0.05 E to 1 at 0.1 E, `ramp'` from -0.11 E to 0.11 E; `hung` is 1 off the skin
    (from 0.005 E to 0.015 E) where no ring goes around one limb alone and, in a component with trouser legs, below the
    crotch; `wide` is 1 where r is above `cone` or the cloth is open. The first holds for what reaches the middle of the
    thighs: cloth that hangs from the waist follows a leg from farther down than skin does. A shirt ends before there
    are legs below it; its r is 0. Open is what goes around the legs at few heights, as an apron, a coat and a cape: a
    leg pushes it and does not draw it along, so that behind the legs, which turn forwards, the bound of open cloth is
    halved.

    Args:
        depth: of N vertices, by `depth_below_hips`.
        component: of each vertex.
        distance: to the skin, metres; infinite where that is an arm's.
        limbs: of `enclosed_by_one`.
        behind: of `behind_legs`.
        size: E, the body's extent, metres.
        cone: r up to which cloth is narrow, and from which on it is wide.
    """
    depth = depth / size
    open_cloth = _open_below_hips(depth, component, limbs)
    free = (1.0 - limbs.share) * _below_crotch(component, depth, limbs)
    # The mean distance at every height, and what folds hide of it.
    known, folded = np.isfinite(distance), np.isfinite(limbs.slack)
    off, slack = (np.where(seen, d, 0.0) / size for seen, d in ((known, distance), (folded, limbs.slack)))
    out_to, long = np.zeros(len(depth)), np.zeros(len(depth), dtype=bool)
    for k in np.unique(component):
        rows = component == k
        long[rows] = depth[rows].max() > _THIGHS
        out_to[rows] = _mean_at_depth(depth[rows], off[rows], (free * known)[rows])
        out_to[rows] += _mean_at_depth(depth[rows], slack[rows], (free * folded)[rows])
    r = out_to / (np.maximum(depth, _LEGS) - _RAMP[0])
    # The bound of narrow cloth and of wide.
    wide = np.maximum(smooth_step(r, *cone), open_cloth)
    hung = free * smooth_step(distance / size, 0.005, 0.015)
    ramp = _LEAST + (1.0 - _LEAST) * smooth_step(depth, *_RAMP)
    pushed = 1.0 - 0.5 * open_cloth * behind
    # Narrow cloth turns with the legs over a longer way: over a shorter one seats tear where they bend, over a longer
    # one hems lag (stretch of the embedded person's skirt in a squat, mini skirts of `benchmarks transfer_garments`).
    narrow_ramp = _LEAST + (1.0 - _LEAST) * smooth_step(depth, -0.11, 0.11)
    bound = 1.0 - hung * np.maximum(long * (1.0 - narrow_ramp), wide * (1.0 - pushed * ramp / (1.0 + r / _HALF)))
    return HangingCloth(hung, wide, bound)


def with_own_legs(
    mixed: Float[np.ndarray, "N J"],
    own: Float[np.ndarray, "N J"],
    cloth: HangingCloth,
    axes: list[LimbAxis],
) -> Float64[np.ndarray, "N J"]:
    """Return mixed weights in which the joints of the legs share what these have as in `own`, where cloth hangs free.

    The published method's weights run on into what hangs off the skin, so that both legs draw a skirt's sides along. In
    narrow cloth the legs together have their own total, too; in wide cloth the mixed one.

    Args:
        mixed: the mean of two methods' weights.
        own: of the method whose division counts.
        cloth: of `cloth_before_legs`.
        axes: of `limb_axes`.
    """
    legs = [joint for axis in axes[:2] for joint in axis.joints]
    before, after = own[:, legs].sum(axis=1), mixed[:, legs].sum(axis=1)
    total = before + cloth.wide * (after - before)
    # Without any weight there is nothing to go by.
    least = 1e-6
    rows = (before > least) & ((after < 1.0 - least) | (before > 1.0 - least))
    rest = (1.0 - total) / np.maximum(1.0 - after, 1e-9)
    out = np.array(mixed, dtype=np.float64)
    out[rows] *= rest[rows, None]
    out[np.ix_(rows, legs)] = own[np.ix_(rows, legs)] * (total / np.maximum(before, least))[rows, None]
    return mixed + cloth.free[:, None] * (out - mixed)


def _open_below_hips(depth: np.ndarray, component: np.ndarray, limbs: Enclosure) -> Float64[np.ndarray, " N"]:
    """Return 1 for vertices of cloth that goes around the legs at few of its heights below the hips, 0 for rings."""
    below, open_cloth = depth > _LEGS, np.zeros(len(depth))
    # Crumbs of a scan are as open as the whole of it.
    crumbs, plane = 0.05 * len(depth), 0.01
    for k in np.unique(component):
        rows = component == k
        chosen = rows & below if rows.sum() > crumbs else below
        about = np.sort(depth[chosen & limbs.about_legs])
        # What ends above the middle of the thighs, as a tutu does, has too few heights to tell.
        if depth[chosen].max(initial=-np.inf) < _THIGHS:
            continue
        # A height is that of a ring if one crosses the cloth within the distance of two planes.
        at = np.searchsorted(about, depth[chosen] - plane), np.searchsorted(about, depth[chosen] + plane)
        open_cloth[rows] = smooth_step(np.asarray(np.mean(at[1] > at[0])), 0.5, 0.2)
    return open_cloth


def lifted_by_thighs(
    mesh: TriangleMesh,
    weights: Float[np.ndarray, "N J"],
    bound: Float[np.ndarray, " N"],
    depth: Float[np.ndarray, " N"],
    component: Int[np.ndarray, " N"],
    source: TriangleMesh,
    source_weights: Float[np.ndarray, "V J"],
    axes: list[LimbAxis],
) -> Float64[np.ndarray, " N"]:
    """Return the bound, raised where thighs that rise would come through what it holds back.

    Both legs, and each alone, are turned forwards by 90 degrees about the hip joints, as in a chair and on a stair.
    Where a bounded vertex is then within the body, its bound is the least of four steps towards its own weight that
    brings it out, the whole of it where none does; along the surface that falls off over a few edges.

    Args:
        mesh: the part, N vertices.
        weights: of all J joints, before they are bounded.
        bound: of `cloth_before_legs`.
        depth: of the vertices, by `depth_below_hips`.
        component: of each vertex.
        source: the body.
        source_weights: of its vertices.
        axes: of `limb_axes`.
    """
    legs = [list(axis.joints) for axis in axes[:2]]
    own = np.stack([weights[:, joints].sum(axis=1) for joints in legs], axis=1)
    total = own.sum(axis=1)
    # What ends above the middle of the thighs is no skirt that they lift.
    deepest = np.full(component.max() + 1, -np.inf)
    np.maximum.at(deepest, component, depth)
    held = np.flatnonzero((total > bound + 1e-3) & (deepest > _THIGHS * extent(source))[component])
    if not len(held):
        return bound
    # The turn about the line from hip to hip.
    side, up, front = body_directions(axes)
    turn = np.outer(side, side) + np.outer(up, front) - np.outer(front, up)

    def raised(points: np.ndarray, shares: np.ndarray, chosen: tuple[int, ...]) -> np.ndarray:
        moved = points.copy()
        for k in chosen:
            offset = points - axes[k].points[0]
            moved += shares[:, k : k + 1] * (offset @ turn.T - offset)
        return np.ascontiguousarray(moved)

    # Of the body its lower half alone, which is a quarter of the faces.
    lower = source_weights[:, [*legs[0], *legs[1], *axes[-1].joints[:3]]].sum(axis=1) > 0.5
    body, used = source.submesh(lower[source.faces].all(axis=1))
    of_body = np.stack([source_weights[used][:, joints].sum(axis=1) for joints in legs], axis=1)
    step = np.zeros(mesh.vertex_count)
    levels = np.linspace(0.0, 1.0, 5)

    def outside(chosen: tuple[int, ...], rows: np.ndarray, levels: np.ndarray) -> np.ndarray:
        shares = [(bound[rows] + t * (total[rows] - bound[rows])) / total[rows] for t in levels]
        at = np.concatenate([raised(mesh.vertices[rows], own[rows] * s[:, None], chosen) for s in shares])
        winding = igl.fast_winding_number(raised(body.vertices, of_body, chosen), body.faces, at)
        return winding.reshape(len(levels), -1) < 0.5

    for chosen in ((0, 1), (0,), (1,)):
        # Most are out as they are: further levels are tried for the others alone.
        within = held[~outside(chosen, held, levels[:1])[0]]
        if len(within):
            out = outside(chosen, within, levels[1:])
            least = np.where(out.any(axis=0), levels[1:][out.argmax(axis=0)], 1.0)
            step[within] = np.maximum(step[within], least)
    # Neighbours follow, the less the farther, over edges of 8 cm together.
    rings = 6
    edges = mesh.edges
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(mesh.vertex_count,) * 2).tocsr()
    graph = graph + graph.T
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1.0)
    for _ in range(rings):
        step = np.maximum(step, graph @ step / degree)
    return bound + step * np.maximum(total - bound, 0.0)


def bounded_legs(
    weights: Float[np.ndarray, "N J"], bound: Float[np.ndarray, " N"], axes: list[LimbAxis], pelvis: int
) -> Float64[np.ndarray, "N J"]:
    """Return the weights with the legs' scaled down to the bound and the rest given to the pelvis."""
    legs = [joint for axis in axes[:2] for joint in axis.joints]
    total = weights[:, legs].sum(axis=1)
    scale = np.minimum(1.0, bound / np.maximum(total, 1e-9))
    out = np.array(weights, dtype=np.float64)
    out[:, legs] *= scale[:, None]
    out[:, pelvis] += total * (1.0 - scale)
    return out


def _below_crotch(component: np.ndarray, depth: np.ndarray, limbs: Enclosure) -> np.ndarray:
    """Return 1 for vertices that may hang before both legs: in trousers those below the top of the legs alone."""
    leg = limbs.share * ((limbs.limb == 0) | (limbs.limb == 1))
    out = np.ones(len(depth))
    trousers = np.bincount(component, leg) > _LEG_SHARE * np.bincount(component)
    for k in np.flatnonzero(trousers):
        rows = component == k
        crotch = np.percentile(depth[rows & (leg > 0.5)], 2) if (rows & (leg > 0.5)).any() else np.inf
        out[rows] = depth[rows] > crotch + _RING
    return out


def _mean_at_depth(depth: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted mean of values over vertices of about the same depth, at least `_LEGS`."""
    # Bins of a component from its lowest depth on, smoothed by a binomial kernel as wide as a bin.
    kernel = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    bins = np.floor((depth - depth.min()) / _RING).astype(int)
    total, count = (np.convolve(np.bincount(bins, w), kernel)[2:-2] for w in (values * weight, weight))
    mean = total / np.maximum(count, 1e-9)
    if depth.max() < _LEGS:
        return np.zeros(len(depth))
    at = (np.maximum(depth, _LEGS) - depth.min()) / _RING - 0.5
    return np.interp(at, np.arange(len(mean)), mean)
