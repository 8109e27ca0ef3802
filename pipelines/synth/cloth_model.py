"""What a garment is made of for the solver: masses, edges in colours, hinges, tethers, attachments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from smplxpp.core.mesh import TriangleMesh, row_lengths
from smplxpp.core.topology import paired_half_edges


@dataclass(frozen=True)
class Fabric:
    """A material, in SI units.

    Attributes:
        density: kg a square metre.
        stretch_compliance: of edges, m/N (inverse stiffness): 0 is inextensible.
        bend_stiffness: N m: how strongly a hinge returns to its rest curvature.
        attach_stiffness: N/m of a wholly attached vertex's spring to its place on the body.
        slack: how much longer than at rest the way from an attachment may become.
    """

    density: float = 0.22
    stretch_compliance: float = 1e-4
    bend_stiffness: float = 2e-5
    attach_stiffness: float = 40.0
    slack: float = 0.005


@dataclass(frozen=True, eq=False)
class ClothModel:
    """Constraints of one or more garments over N particles.

    Attributes:
        rest: the garments as they were cut.
        inverse_mass: 1/kg; 0 where the particle follows the body exactly.
        attach_compliance: m/N of the spring to its place on the body; inf where it is free.
        colors: edges in groups that share no particle, with their rest lengths.
        stretch_compliance: m/N.
        hinges: see `Hinges`.
        anchor, tether: the nearest particle that follows the body, and the longest distance to it; inf where
            there is none.
    """

    rest: TriangleMesh
    inverse_mass: Float[np.ndarray, " N"]
    attach_compliance: Float[np.ndarray, " N"]
    colors: tuple[tuple[Int[np.ndarray, "_ 2"], Float[np.ndarray, " _"]], ...]
    stretch_compliance: float
    hinges: Hinges
    anchor: Int[np.ndarray, " N"]
    tether: Float[np.ndarray, " N"]

    @property
    def fixed(self) -> Bool[np.ndarray, " N"]:
        """The particles that follow the body exactly."""
        return self.inverse_mass == 0.0


@dataclass(frozen=True, eq=False)
class Hinges:
    """Pairs of triangles that resist bending (the quadratic model of Bergou et al. 2006, with curvature at rest).

    With `c` the cotangent weights of an inner edge, `sum_i c_i x_i` is the curvature of the hinge as a vector; its part
    along the hinge's normal is held at its value at rest.

    Attributes:
        operator: (H, N), rows `c`.
        faces: the two triangles.
        rest: curvature at rest along the hinge's normal.
        compliance: 1 / stiffness.
        gather: (N, H) inverse mass times `c`, transposed.
        weight: `sum_i c_i^2 / m_i`, times the hinges that share a particle, for a stable simultaneous update.
    """

    operator: csr_matrix
    faces: Int[np.ndarray, "H 2"]
    rest: Float[np.ndarray, " H"]
    compliance: Float[np.ndarray, " H"]
    gather: csr_matrix
    weight: Float[np.ndarray, " H"]


def build_cloth(rest: TriangleMesh, attachment: Float[np.ndarray, " N"], fabric: Fabric) -> ClothModel:
    """Derive the constraints of garments from their shape at rest.

    Args:
        rest: N vertices; lengths and curvatures of this shape are the garment's own.
        attachment: in [0, 1]: 1 follows the body exactly, 0 is free, between is a spring.
        fabric: material.
    """
    n = rest.vertex_count
    area = np.zeros(n)
    for k in range(3):
        area += np.bincount(rest.faces[:, k], rest.face_areas / 3.0, minlength=n)
    fixed = attachment >= 1.0
    inverse_mass = np.where(fixed, 0.0, 1.0 / (fabric.density * np.maximum(area, 1e-7)))
    with np.errstate(divide="ignore"):
        compliance = (1.0 - attachment) / (fabric.attach_stiffness * attachment**2)
    edges = rest.edges[~fixed[rest.edges].all(axis=1)]
    lengths = row_lengths(rest.vertices[edges[:, 0]] - rest.vertices[edges[:, 1]])
    colors = tuple((edges[group], lengths[group]) for group in color_edges(edges, n))
    anchor, tether = _tethers(rest, fixed, fabric.slack)
    return ClothModel(
        rest=rest,
        inverse_mass=inverse_mass,
        attach_compliance=compliance,
        colors=colors,
        stretch_compliance=fabric.stretch_compliance,
        hinges=_hinges(rest, inverse_mass, fabric.bend_stiffness),
        anchor=anchor,
        tether=tether,
    )


def color_edges(edges: Int[np.ndarray, "E 2"], count: int) -> list[Int[np.ndarray, " _"]]:
    """Group edge indices such that edges of one group share no vertex; maximal groups, largest first.

    Each round takes the edges whose number is the lowest at both ends; numbers are shuffled once with a fixed seed.
    """
    order = np.random.default_rng(0).permutation(len(edges))
    left = np.ones(len(edges), dtype=bool)
    groups = []
    while left.any():
        open_edges, taken = left.copy(), np.zeros(count, dtype=bool)
        chosen = []
        while open_edges.any():
            index = np.flatnonzero(open_edges)
            lowest = np.full(count, len(edges))
            np.minimum.at(lowest, edges[index].ravel(), np.repeat(order[index], 2))
            wins = index[(lowest[edges[index]] == order[index, None]).all(axis=1)]
            chosen.append(wins)
            taken[edges[wins]] = True
            open_edges &= ~taken[edges].any(axis=1)
        groups.append(np.concatenate(chosen))
        left[groups[-1]] = False
    return groups


def _hinges(rest: TriangleMesh, inverse_mass: Float[np.ndarray, " N"], stiffness: float) -> Hinges:
    # Edge k of a face runs from corner k to k + 1; corner k + 2 lies opposite.
    half = paired_half_edges(rest.faces)
    face, corner = half // 3, half % 3
    a, b = (rest.faces[face[:, 0], (corner[:, 0] + k) % 3] for k in (0, 1))
    c, d = (rest.faces[face[:, k], (corner[:, k] + 2) % 3] for k in (0, 1))
    moves = (inverse_mass[np.stack([a, b, c, d])] > 0).any(axis=0)
    a, b, c, d, face = a[moves], b[moves], c[moves], d[moves], face[moves]
    x = rest.vertices

    def cot(at: Int[np.ndarray, " H"], p: Int[np.ndarray, " H"], q: Int[np.ndarray, " H"]) -> Float[np.ndarray, " H"]:
        u, v = x[p] - x[at], x[q] - x[at]
        return np.einsum("hi,hi->h", u, v) / np.maximum(row_lengths(np.cross(u, v)), 1e-12)

    # Needles would give weights without bound.
    ac, ad, bc, bd = (np.clip(cot(*way), -3.0, 3.0) for way in ((a, b, c), (a, b, d), (b, a, c), (b, a, d)))
    weights = np.stack([bc + bd, ac + ad, -ac - bc, -ad - bd])
    h, n = len(a), len(x)
    rows, columns = np.tile(np.arange(h), 4), np.concatenate([a, b, c, d])
    operator = csr_matrix((weights.ravel(), (rows, columns)), shape=(h, n))
    areas = rest.face_areas[face].sum(axis=1)
    share = np.bincount(columns, minlength=n)[np.stack([a, b, c, d])].max(axis=0)
    per_particle = weights**2 * inverse_mass[np.stack([a, b, c, d])]
    normal = hinge_normals(rest.face_normals, face)
    return Hinges(
        operator=operator,
        faces=face,
        rest=np.einsum("hi,hi->h", operator @ x, normal),
        compliance=areas / (3.0 * stiffness),
        gather=csr_matrix(operator.multiply(inverse_mass[None, :]).T),
        weight=per_particle.sum(axis=0) * share,
    )


def hinge_normals(face_normals: Float[np.ndarray, "M 3"], faces: Int[np.ndarray, "H 2"]) -> Float[np.ndarray, "H 3"]:
    """Return unit means of the normals of both triangles."""
    total = face_normals[faces[:, 0]] + face_normals[faces[:, 1]]
    return total / np.maximum(row_lengths(total), 1e-9)[:, None]


def _tethers(
    rest: TriangleMesh, fixed: Bool[np.ndarray, " N"], slack: float
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Find long-range attachments (Kim et al. 2012): the nearest fixed particle along the cloth and the longest way."""
    n = rest.vertex_count
    edges = rest.edges
    lengths = row_lengths(rest.vertices[edges[:, 0]] - rest.vertices[edges[:, 1]])
    graph = csr_matrix((lengths, edges.T), shape=(n, n))
    if not fixed.any():
        return np.zeros(n, dtype=np.int64), np.full(n, np.inf)
    distance, _, source = dijkstra(
        graph, directed=False, indices=np.flatnonzero(fixed), min_only=True, return_predecessors=True
    )
    return np.where(source >= 0, source, 0).astype(np.int64), (1.0 + slack) * distance
