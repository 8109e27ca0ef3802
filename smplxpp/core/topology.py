"""Compute the connectivity of triangle soups: paired half-edges, components, border loops, manifold corners.

A half-edge `h = 3 f + k` runs from corner k of face f to the next corner.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components


def half_edges(faces: Int[np.ndarray, "M 3"]) -> Int[np.ndarray, "H 2"]:
    """Return the start and end vertex of every half-edge, H = 3 M."""
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)


def edge_groups(
    faces: Int[np.ndarray, "M 3"],
) -> tuple[Int[np.ndarray, " H"], Int[np.ndarray, " E"], Int[np.ndarray, " E"]]:
    """Group the half-edges by their undirected edge.

    Returns (3M,) half-edges sorted by edge (then by index), and for each of the E edges the start of its run and the
    run's length.
    """
    ends = half_edges(faces)
    # An undirected edge as one integer, low * n + high, which sorts faster than pairs.
    low, high = np.minimum(*ends.T), np.maximum(*ends.T)
    key = low * (int(faces.max(initial=0)) + 1) + high
    # Stable: half-edges of an edge stay in index order.
    order = np.argsort(key, kind="stable")
    # Runs of equal keys begin where the sorted key changes.
    first = np.flatnonzero(np.diff(key[order], prepend=-1)) if len(key) else np.zeros(0, np.int64)
    return order, first, np.diff(first, append=len(key))


def paired_half_edges(faces: Int[np.ndarray, "M 3"]) -> Int[np.ndarray, "P 2"]:
    """Return the two half-edges of every edge with exactly two faces, lower index first."""
    order, first, count = edge_groups(faces)
    start = first[count == 2]
    return np.stack([order[start], order[start + 1]], axis=1)


def face_adjacency(faces: Int[np.ndarray, "M 3"]) -> tuple[Int[np.ndarray, "P 2"], Int[np.ndarray, "P 2"]]:
    """Return the pairs of faces that share an edge, once per edge, and the vertices of that edge.

    At an edge with more than two faces, faces that follow each other in index order are paired.
    """
    order, first, count = edge_groups(faces)
    last = np.zeros(len(order), dtype=bool)
    last[first + count - 1] = True
    position = np.flatnonzero(~last)
    pairs = np.stack([order[position], order[position + 1]], axis=1)
    # Half-edge h belongs to face h // 3.
    return pairs // 3, half_edges(faces)[pairs[:, 0]]


def component_labels(pairs: Int[np.ndarray, "P 2"], count: int) -> Int[np.ndarray, " count"]:
    """Return the connected component of every node of the graph with edges `pairs`, numbered by lowest node."""
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    first = np.full(int(labels.max(initial=-1)) + 1, count)
    np.minimum.at(first, labels, np.arange(count))
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[labels]


def face_components(faces: Int[np.ndarray, "M 3"]) -> Int[np.ndarray, " M"]:
    """Return the edge-connected component of every face."""
    return component_labels(face_adjacency(faces)[0], len(faces))


def manifold_corners(faces: Int[np.ndarray, "M 3"]) -> tuple[Int[np.ndarray, "M 3"], Int[np.ndarray, " n"]]:
    """Cut the surface where it is not a two-manifold, by giving corners new vertices.

    Corners of a vertex stay together when a chain of edges, each with exactly two faces of opposite direction, joins
    them: so edges with three or more faces open, and vertices where two fans meet split.

    Returns (M, 3) new faces and (n,) the old vertex of every new one; the first fan of a vertex keeps its place among
    the referenced vertices (in their order), further fans follow at the end.
    """
    # Join corners across edges with exactly two faces of opposite direction; a fan is a component of joined corners.
    pairs = paired_half_edges(faces)
    ends = half_edges(faces)
    # Opposite direction: the start of one half-edge is the end of the other.
    pairs = pairs[ends[pairs[:, 0], 0] == ends[pairs[:, 1], 1]]
    following = np.arange(3 * len(faces)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    a, b = pairs[:, 0], pairs[:, 1]
    # Across an edge, the corner at the start of one half-edge lies at the same vertex as the corner after the other's
    # start.
    links = np.concatenate([np.stack([a, following[b]], 1), np.stack([following[a], b], 1)])
    fan = component_labels(links, 3 * len(faces))
    # Number the fans: the first of each vertex in the order of the vertices, further ones after all of these.
    _, first_corner = np.unique(fan, return_index=True)
    vertex_of_fan = faces.ravel()[first_corner]
    order = np.lexsort((first_corner, vertex_of_fan))
    extra = np.zeros(len(order), dtype=bool)
    extra[1:] = vertex_of_fan[order][1:] == vertex_of_fan[order][:-1]
    order = np.concatenate([order[~extra], order[extra]])
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return place[fan].reshape(-1, 3), vertex_of_fan[order]


def border_loops(faces: Int[np.ndarray, "M 3"]) -> list[Int[np.ndarray, " _"]]:
    """Return the vertices of every border loop of a manifold surface, along its faces, from its lowest index.

    Loops come in order of their lowest vertex.
    """
    order, first, count = edge_groups(faces)
    # Half-edges without a partner; on a manifold each border vertex starts exactly one.
    start, end = half_edges(faces)[order[first[count == 1]]].T
    if not len(start):
        return []
    nodes = np.sort(start)
    # The successor of each border vertex along the loop, as an index into `nodes`.
    following = np.searchsorted(nodes, end[np.argsort(start, kind="stable")])
    loop = component_labels(np.stack([np.arange(len(nodes)), following], 1), len(nodes))
    # Count the steps from each vertex to the lowest one of its loop by pointer doubling, then sort by them.
    _, head = np.unique(loop, return_index=True)
    jump, steps = following.copy(), np.ones(len(nodes), np.int64)
    jump[head], steps[head] = head, 0
    # log2 n doublings cover any loop; the head points at itself with zero steps.
    for _ in range(int(np.ceil(np.log2(len(nodes) + 1)))):
        steps, jump = steps + steps[jump], jump[jump]
    length = np.bincount(loop)
    rank = np.where(steps > 0, length[loop] - steps, 0)
    ordered = nodes[np.lexsort((rank, loop))]
    return np.split(ordered, np.cumsum(length)[:-1])


def split_faces(
    faces: Int[np.ndarray, "M 3"], ends: Int[np.ndarray, "E 2"], count: int
) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """Split edges by a new vertex each, and their faces into two, three or four, as one, two or three edges are split.

    Args:
        faces: of a mesh of `count` vertices.
        ends: vertices of the edges; edge i gets the vertex `count` + i.
        count: number of vertices.

    Returns:
        The faces, those that stay first, and of each the one that it is a part of.
    """
    # The new vertex of each half edge (k, k + 1) of a face, -1 for those that stay: edges as numbers, in order.
    key = np.sort(ends, axis=1) @ [count, 1]
    order = np.argsort(key)
    half = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1) @ [count, 1]
    at = np.minimum(np.searchsorted(key[order], half), len(key) - 1)
    middle = np.where(key[order][at] == half, count + order[at], -1)
    # Turn each face so that its split edges are the first ones: (0, 1); (0, 1) and (1, 2); all three.
    split = middle >= 0
    pieces = split.sum(axis=1)
    first = np.where(pieces == 1, split.argmax(axis=1), (~split).argmin(axis=1))
    first = np.where(pieces == 2, ((~split).argmax(axis=1) + 1) % 3, first)
    turn = (first[:, None] + np.arange(3)) % 3
    corner, middle = np.take_along_axis(faces, turn, axis=1), np.take_along_axis(middle, turn, axis=1)
    (a, b, c), (ab, bc, ca) = corner.T, middle.T
    new, whole = [faces[pieces == 0]], [np.flatnonzero(pieces == 0)]
    for number, triangles in (
        (1, ((a, ab, c), (ab, b, c))),
        (2, ((ab, b, bc), (a, ab, bc), (a, bc, c))),
        (3, ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))),
    ):
        new += [np.stack(triangle, axis=1)[pieces == number] for triangle in triangles]
        whole += [np.flatnonzero(pieces == number)] * len(triangles)
    return np.concatenate(new), np.concatenate(whole)


def mean_of_neighbours(edges: Int[np.ndarray, "E 2"], border_edges: Int[np.ndarray, "B 2"], count: int) -> csr_matrix:
    """Return (N, N) rows that average a vertex's neighbours; a border vertex has only neighbours along the border."""
    on_border = np.zeros(count, dtype=bool)
    on_border[border_edges] = True
    ends = np.concatenate([edges, edges[:, ::-1]])
    inner = ends[~on_border[ends[:, 0]]]
    row, column = np.concatenate([inner, border_edges, border_edges[:, ::-1]]).T
    weights = 1.0 / np.bincount(row, minlength=count)[row]
    return coo_matrix((weights, (row, column)), shape=(count, count)).tocsr()
