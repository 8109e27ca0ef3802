"""Bound what cloth that hangs free before both legs takes of them: the rest of its weight stays with the pelvis."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from smplxpp.core import TriangleMesh, normalize_rows, row_lengths
from smplxpp.transfer.anchors import smooth_step
from smplxpp.transfer.checks import extent
from smplxpp.transfer.enclosed import Enclosure
from smplxpp.transfer.rings import LimbAxis

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
_TOUCHES = 0.01
"""Distance within which cloth touches the skin, as a share of the body's extent (2 cm)."""
_LEG_SHARE = 0.05
"""Share of a component that rings about one leg alone hold from which on it counts as trousers."""


def hung_from_top(
    vertices: Float[np.ndarray, "N 3"],
    component: Int[np.ndarray, " N"],
    distance: Float[np.ndarray, " N"],
    trunk: LimbAxis,
    size: float,
) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Return the top tenth of components that touch the skin nowhere, and all of their vertices.

    A beard stands off the chest by less than off the jaw from which it hangs, so that the nearest skin is not what
    carries it. Up is from the pelvis to the head.
    """
    nearest = np.full(component.max() + 1, np.inf)
    np.minimum.at(nearest, component, distance)
    hangs = nearest[component] > _TOUCHES * size
    height = vertices @ (trunk.points[-1] - trunk.points[0])
    low, high = np.full((2, len(nearest)), np.inf)
    np.minimum.at(low, component, height)
    np.minimum.at(high, component, -height)
    top = 0.1  # share of a component's height from which it hangs
    return hangs & (height >= (-high - top * (-high - low))[component]), hangs


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


def leg_bound(
    depth: Float[np.ndarray, " N"],
    component: Int[np.ndarray, " N"],
    distance: Float[np.ndarray, " N"],
    limbs: Enclosure,
    behind: Float[np.ndarray, " N"],
    *,
    size: float,
    cone: tuple[float, float],
) -> Float64[np.ndarray, " N"]:
    """Return how much of each vertex's weight the legs can have: 1 for cloth on the skin and for trousers.

    A skirt hangs from the waist. The wider it falls, the less of a thigh's turn reaches it. With u the height below the
    hip joints along the legs, and r the mean distance of the cloth at that height by that height (the tangent of half
    the cone's angle; above u = 0.03 E its value there), the bound is

        1 - hung (1 - ramp(u) / (1 + r / 1.2)) ,   ramp from 0.1 at u = -0.05 E to 1 at 0.1 E

    where `hung` is 1 off the skin (from 0.005 E to 0.015 E) where r is above `cone` or the cloth is open, no ring goes
    around one limb alone and, in a component with trouser legs, below the crotch. A shirt ends before there are legs
    below it; its r is 0. Open is what goes around the legs at few heights, as an apron, a coat and a cape: a leg pushes
    it and does not draw it along, so that behind the legs, which turn forwards, the bound of open cloth is halved.

    Args:
        depth: of N vertices, by `depth_below_hips`.
        component: of each vertex.
        distance: to the skin, metres; infinite where that is an arm's.
        limbs: of `enclosed_by_one`.
        behind: of `behind_legs`.
        size: E, the body's extent, metres.
        cone: r up to which there is no bound, and from which on it is full.
    """
    depth = depth / size
    open_cloth = _open_below_hips(depth, component, limbs)
    free = (1.0 - limbs.share) * _below_crotch(component, depth, limbs)
    known = np.isfinite(distance)
    off = np.where(known, distance, 0.0) / size
    wide = np.zeros(len(depth))
    for k in np.unique(component):
        rows = component == k
        wide[rows] = _mean_at_depth(depth[rows], off[rows], (free * known)[rows])
    r = wide / (np.maximum(depth, _LEGS) - _RAMP[0])
    wide_or_open = np.maximum(smooth_step(r, *cone), open_cloth)
    hung = free * smooth_step(distance / size, 0.005, 0.015) * wide_or_open
    ramp = _LEAST + (1.0 - _LEAST) * smooth_step(depth, *_RAMP)
    pushed = 1.0 - 0.5 * open_cloth * behind
    return 1.0 - hung * (1.0 - pushed * ramp / (1.0 + r / _HALF))


def behind_legs(vertices: Float[np.ndarray, "N 3"], axes: list[LimbAxis]) -> Float64[np.ndarray, " N"]:
    """Return how far behind its nearest leg a vertex lies: 1 straight behind it, 0 from beside it forwards."""
    offset, nearest = np.zeros((len(vertices), 3)), np.full(len(vertices), np.inf)
    for axis in axes[:2]:
        own, index = cKDTree(axis.points).query(vertices)
        closer = own < nearest
        offset[closer], nearest[closer] = (vertices - axis.points[index])[closer], own[closer]
    back = -normalize_rows(offset) @ _directions(axes)[2]
    return smooth_step(back, 0.0, 0.7)


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
        bound: of `leg_bound`.
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
    side, up, front = _directions(axes)
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


def _directions(axes: list[LimbAxis]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit vectors to the body's left, upwards and forwards, across the line from hip to hip."""
    side, up = axes[0].points[0] - axes[1].points[0], axes[-1].points[-1] - axes[-1].points[0]
    side /= np.linalg.norm(side)
    front = np.cross(side, up)
    front /= np.linalg.norm(front)
    return side, np.cross(front, side), front


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


def depth_below_hips(vertices: Float[np.ndarray, "N 3"], legs: list[LimbAxis]) -> Float64[np.ndarray, " N"]:
    """Return the height of vertices below the hip joints, along the nearest leg, metres; negative above them."""
    depth, nearest = np.zeros(len(vertices)), np.full(len(vertices), np.inf)
    for axis in legs:
        own, index = cKDTree(axis.points).query(vertices)
        along = np.einsum("ij,ij->i", vertices - axis.points[index], axis.tangents[index])
        # Between the axis' ends its nearest point says the height, outside them the continued line.
        outside = (index == 0) | (index == len(axis.points) - 1)
        height = index * row_lengths(axis.points[1:2] - axis.points[:1]) + np.where(outside, along, 0.0)
        depth = np.where(own < nearest, height, depth)
        nearest = np.minimum(own, nearest)
    return depth


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
