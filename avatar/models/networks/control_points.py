"""Control points of a mesh: a few vertices whose displacements are interpolated to all the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64, Shaped
from scipy.spatial import cKDTree

from smplxpp.core import InputError, require_at_least
from smplxpp.template.template import Template


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """K control vertices of V, and the interpolation of every vertex from them.

    Attributes:
        vertices: index of each control vertex.
        neighbours: control points of each vertex, from 0 to K - 1.
        weights: of those control points, non-negative; rows sum to 1.
    """

    vertices: Int64[np.ndarray, " K"]
    neighbours: Int64[np.ndarray, "V k"]
    weights: Float64[np.ndarray, "V k"]


def choose_control_points(
    vertices: Float[np.ndarray, "V 3"],
    groups: Shaped[np.ndarray, " V"],
    *,
    count: int,
    neighbour_count: int = 6,
    importance: Float[np.ndarray, " V"] | None = None,
) -> ControlPoints:
    """Spread control points evenly over every group of vertices and tie each vertex to the nearest of its own group.

    Farthest-point sampling, started at the vertex farthest from the group's centroid. Weights are inverse distances
    that fade to zero at the next nearest control point, `w_j ~ (d_max - d_j) / (d_max d_j)` (Shepard's method in Franke
    and Little's local form): a control point keeps its own value. Groups (cloth over body, for example) do not mix,
    however close they lie.

    Args:
        vertices: metres.
        groups: the group of each vertex.
        count: number of control points, shared among the groups by their numbers of vertices (at least one each).
        neighbour_count: number of control points a vertex depends on.
        importance: positive; a group's vertices count as many times in its share. None: all alike.

    Raises:
        InputError: fewer control points than groups or more than vertices, or no neighbour.
    """
    # Number the groups, and check the count.
    vertices = np.asarray(vertices, dtype=np.float64)
    names, group = np.unique(np.asarray(groups), return_inverse=True)
    importance = np.ones(len(vertices)) if importance is None else np.asarray(importance, dtype=np.float64)
    if not len(names) <= count <= len(vertices):
        raise InputError(
            "number of control points",
            expected=f"{len(names)} (one for every group) to {len(vertices)} (one for every vertex)",
            received=str(count),
        )
    require_at_least("neighbours of a vertex", neighbour_count, 1)

    # Group by group: sample the control points, then tie the group's vertices to the nearest of them.
    chosen: list[np.ndarray] = []
    neighbours = np.zeros((len(vertices), neighbour_count), dtype=np.int64)
    weights = np.zeros((len(vertices), neighbour_count))
    before, shares = 0, _shares(np.bincount(group), np.bincount(group, weights=importance), count)
    for k in range(len(names)):
        # Where a group has fewer control points than neighbours, the columns left over repeat the nearest with weight
        # 0.
        members = np.flatnonzero(group == k)
        share = shares[k]
        controls = members[_farthest_points(vertices[members], share)]
        used = min(neighbour_count, share)
        nearest, w = _local_weights(vertices[members], vertices[controls], used)
        neighbours[members, :used] = before + nearest
        neighbours[members, used:] = before + nearest[:, :1]
        weights[members, :used] = w
        chosen.append(controls)
        before += share
    return ControlPoints(np.concatenate(chosen), neighbours, weights)


def template_control_points(template: Template, count: int) -> ControlPoints:
    """Choose control points of a template, part by part, four times as densely on its clothes, which fold.

    Args:
        template: the clothed body.
        count: number of control points; at most all vertices.
    """
    cloth_density = 4.0  # relative to the body

    density = np.where(template.cloth_mask, cloth_density, 1.0)
    count = min(count, template.vertex_count)
    return choose_control_points(template.vertices, template.vertex_part, count=count, importance=density)


def _shares(sizes: np.ndarray, wishes: np.ndarray, count: int) -> np.ndarray:
    """Split `count` in proportion to `wishes`, exactly: from 1 to the size of each group.

    The largest remainders are rounded up; the excess of a full group goes to the others in the same proportion.
    """
    shares = np.ones(len(sizes), dtype=np.int64)
    while (left := count - shares.sum()) > 0:
        # Distribute what is left among the groups that are not full.
        open_wishes = np.where(shares < sizes, wishes, 0.0)
        more = left * open_wishes / open_wishes.sum()
        whole = np.minimum(np.floor(more).astype(np.int64), sizes - shares)
        if not whole.any():
            # All quotas are below one: give single points to the largest remainders that still have room.
            rest = np.argsort(-(more - whole), kind="stable")
            whole[rest[shares[rest] < sizes[rest]][:left]] = 1
        shares += whole
    return shares


def _farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` points by farthest-point sampling."""
    # Start at the point farthest from the centroid, then take the point farthest from all chosen before.
    picked = np.empty(count, dtype=np.int64)
    picked[0] = np.argmax(np.linalg.norm(points - points.mean(0), axis=1))
    distance = np.full(len(points), np.inf)
    columns = np.ascontiguousarray(points.T)
    # Sequential, because each choice depends on the one before.
    for i in range(1, count):
        x, y, z = (columns - columns[:, picked[i - 1], None]) ** 2
        np.minimum(distance, x + y + z, out=distance)
        picked[i] = np.argmax(distance)
    return picked


def _local_weights(points: np.ndarray, controls: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the `count` nearest controls of each point, and their weights."""
    # One neighbour more than is used: its distance is where the weights fade to zero.
    asked = min(count + 1, len(controls))
    distance, nearest = cKDTree(controls).query(points, k=np.arange(1, asked + 1))
    # A vertex that is itself a control point has distance 0; 1e-9 m gives it nearly all of the weight.
    distance = np.maximum(distance, 1e-9)
    # Where there is no next nearest control point, a distance twice the largest keeps every weight above zero.
    limit = (distance[:, -1] if asked > count else 2.0 * distance[:, -1])[:, None]
    weights = (limit - distance[:, :count]) / (limit * distance[:, :count])
    # Equal distances all round (a point among symmetric controls) leave nothing to tell them apart.
    weights[weights.sum(1) <= 0.0] = 1.0
    return nearest[:, :count], weights / weights.sum(1, keepdims=True)
