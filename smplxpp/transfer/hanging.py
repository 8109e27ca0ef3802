"""Bound what cloth that hangs free before both legs takes of them: the rest of its weight stays with the pelvis."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from smplxpp.core import TriangleMesh, row_lengths
from smplxpp.transfer.anchors import smooth_step
from smplxpp.transfer.enclosed import Enclosure, LimbAxis

_RAMP = (-0.05, 0.1)
"""From how far above the hip joints (negative) to how far below them the bound grows from 0 on, as shares of the body's
extent. Skin follows the leg from 5 cm under the joint on, cloth that hangs from the waist later: between the authored
weights of `benchmarks transfer_garments` and those that fit the same garments simulated."""
_LEAST = 0.1
"""The bound above the ramp: a tutu, which stands off the hips, follows the thighs a little (worst ratio there)."""
_LEGS = 0.03
"""Depth below the hip joints that cloth has to reach, as a share of the body's extent (6 cm): a shirt ends above it."""
_HALF = 1.6
"""Cone of a skirt (distance off the legs by height below the waist) of which the legs have at most a half."""
_RING = 0.02
"""Height of the bins over which distances are averaged, as a share of the body's extent (4 cm)."""
_TOUCHES = 0.01
"""Distance within which cloth touches the skin, as a share of the body's extent (2 cm)."""
_TOP = 0.1
"""Share of a component's height from which it hangs."""
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
    return hangs & (height >= (-high - _TOP * (-high - low))[component]), hangs


def leg_bound(
    mesh: TriangleMesh,
    component: Int[np.ndarray, " N"],
    distance: Float[np.ndarray, " N"],
    axes: list[LimbAxis],
    limbs: Enclosure,
    *,
    size: float,
    cone: tuple[float, float],
) -> Float64[np.ndarray, " N"]:
    """Return how much of each vertex's weight the legs can have: 1 for cloth on the skin and for trousers.

    A skirt hangs from the waist. The wider it falls, the less of a thigh's turn reaches it. With u the height below the
    hip joints along the legs, and r the mean distance of the cloth at that height by that height (the tangent of half
    the cone's angle; above u = 0.03 E its value there), the bound is

        1 - hung (1 - ramp(u) / (1 + r / 1.6)) ,   ramp from 0.1 at u = -0.05 E to 1 at 0.1 E

    where `hung` is 1 off the skin (from 0.01 E to 0.025 E) where r is above `cone`, no ring goes around one limb alone
    and, in a component with trouser legs, below the crotch. A shirt ends before there are legs below it; its r is 0.

    Args:
        mesh: the part, N vertices.
        component: of each vertex.
        distance: to the skin, metres; infinite where that is an arm's.
        axes: of `limb_axes`.
        limbs: of `enclosed_by_one`.
        size: E, the body's extent, metres.
        cone: r up to which there is no bound, and from which on it is full.
    """
    depth = _depth(mesh.vertices, axes[:2]) / size
    free = (1.0 - limbs.share) * _below_crotch(component, depth, limbs)
    known = np.isfinite(distance)
    off = np.where(known, distance, 0.0) / size
    wide = np.zeros(mesh.vertex_count)
    for k in np.unique(component):
        rows = component == k
        wide[rows] = _mean_at_depth(depth[rows], off[rows], (free * known)[rows])
    r = wide / (np.maximum(depth, _LEGS) - _RAMP[0])
    hung = free * smooth_step(distance / size, 0.01, 0.025) * smooth_step(r, *cone)
    ramp = _LEAST + (1.0 - _LEAST) * smooth_step(depth, *_RAMP)
    return 1.0 - hung * (1.0 - ramp / (1.0 + r / _HALF))


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


def _depth(vertices: np.ndarray, legs: list[LimbAxis]) -> Float64[np.ndarray, " N"]:
    """Return the height of vertices below the hip joints, along the nearest leg, metres; negative above them."""
    depth, nearest = np.zeros(len(vertices)), np.full(len(vertices), np.inf)
    for axis in legs:
        squared = ((vertices[:, None] - axis.points) ** 2).sum(axis=2)
        index = squared.argmin(axis=1)
        own = squared[np.arange(len(vertices)), index]
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
