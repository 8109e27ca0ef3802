"""Constraints of cloth for the solver: masses, edges, hinges, tethers, springs, and what it may touch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from smplxpp.cloth.cloth_mesh import edge_graph
from smplxpp.core.errors import require_at_least, require_positive
from smplxpp.core.mesh import TriangleMesh, row_lengths
from smplxpp.core.topology import paired_half_edges


@dataclass(frozen=True, kw_only=True)
class Fabric:
    """Parameters of a cloth material, in SI units.

    Attributes:
        density: kg a square metre.
        stretch_stiffness: N/m of a sheet that is pulled: an edge of length l between triangles of area A has the
            stiffness `stretch_stiffness A / l^2`.
        compression: share of it with which an edge resists being shortened. Between particles that are centimetres
            apart cloth buckles; edges that resist more hold a skirt open and stiff.
        bend_stiffness: N m: how strongly a hinge returns to its curvature at rest. 0: not at all, which saves a third
            of the time.
        slack: relative elongation of the path from an attachment that tethers allow.
        drag: of the air, 1/s.
        normal_drag: of what moves along its own normal, 1/s, on top.
        inner_friction: at which neighbours' velocities become alike, 1/s.
        friction: Coulomb's coefficient against the skin.
    """

    density: float = 0.22
    stretch_stiffness: float = 660.0
    compression: float = 0.05
    bend_stiffness: float = 1e-6
    slack: float = 0.0
    drag: float = 2.5
    normal_drag: float = 0.8
    inner_friction: float = 0.75
    friction: float = 0.15

    def __post_init__(self) -> None:
        for name in ("density", "stretch_stiffness", "compression"):
            require_positive(f"fabric: {name}", getattr(self, name))
        for name in ("bend_stiffness", "slack", "drag", "normal_drag", "inner_friction", "friction"):
            require_at_least(f"fabric: {name}", getattr(self, name), 0.0)


@dataclass(frozen=True, kw_only=True)
class SolverConfig:
    """Options of the time integration of the solver.

    Attributes:
        substep: seconds at most. Longer ones leave the cloth softer: corrections travel an edge a substep.
        contacts_every: substeps between two searches for contacts.
        own_margin: metres that particles of one garment keep from each other, where they are no nearer at rest; 0: they
            may pass through each other, unless the garment touches another one that is simulated.
        most_speed: metres a second; a safeguard, above what a garment does.
        most_stretch: longest edge over its length at rest: a hard bound at the end of every span of time.
        gravity: m/s^2 downwards.
    """

    substep: float = 1.0 / 500.0
    contacts_every: int = 8
    own_margin: float = 0.0
    most_speed: float = 8.0
    most_stretch: float = 1.2
    gravity: float = 9.81

    def __post_init__(self) -> None:
        for name in ("substep", "most_speed"):
            require_positive(f"solver: {name}", getattr(self, name))
        require_at_least("solver: most_stretch", self.most_stretch, 1.0)
        require_at_least("solver: contacts_every", self.contacts_every, 1)
        for name in ("own_margin", "gravity"):
            require_at_least(f"solver: {name}", getattr(self, name), 0.0)


@dataclass(frozen=True, eq=False)
class ClothModel:
    """Constraints over n particles, as `smplxpp/native/cloth/xpbd.cpp` reads them.

    Attributes:
        faces: of the simulated mesh.
        inverse_mass: 1/kg; 0 where the particle follows its place exactly.
        edges, lengths: pairs of particles, and their distance at rest along the cloth, metres.
        stretch, compress: compliances of the edges, m/N.
        hinges: the two ends of an inner edge, then the corners across it.
        curvature: weights of the four corners.
        rest_curvature: along the hinge's normal.
        bend: compliance of a hinge.
        spring: m/N to the particle's place, inf where there is none; None: nowhere.
        anchor, tether: the particle that holds this one, -1 where none does, and the longest distance to it, metres.
        apart: metres at rest to the nearest particle that no edge joins to it; `SolverConfig.own_margin` keeps no more.
    """

    faces: Int32[np.ndarray, "m 3"]
    inverse_mass: Float32[np.ndarray, " n"]
    edges: Int32[np.ndarray, "e 2"]
    lengths: Float32[np.ndarray, " e"]
    stretch: Float32[np.ndarray, " e"]
    compress: Float32[np.ndarray, " e"]
    hinges: Int32[np.ndarray, "b 4"]
    curvature: Float32[np.ndarray, "b 4"]
    rest_curvature: Float32[np.ndarray, " b"]
    bend: Float32[np.ndarray, " b"]
    anchor: Int32[np.ndarray, " n"]
    tether: Float32[np.ndarray, " n"]
    apart: Float32[np.ndarray, " n"]
    spring: Float32[np.ndarray, " n"] | None = None


def build_model(
    rest: TriangleMesh,
    attachment: Float[np.ndarray, " n"],
    fabric: Fabric,
    *,
    lengths: Float[np.ndarray, " e"] | None = None,
    attach_stiffness: float = 0.0,
) -> ClothModel:
    """Derive the constraints of a garment from its shape at rest.

    Args:
        rest: lengths and curvatures of this shape are the garment's own, metres.
        attachment: in [0, 1]: 1 follows its place exactly, 0 is free; between it is a spring, of `attach_stiffness`
            N/m for a wholly attached particle.
        fabric: material.
        lengths: of `rest.edges`, metres; None: the chords.
    """
    n, (a, b) = rest.vertex_count, rest.edges.T
    # Lumped masses: a third of each face's area times the density goes to each corner. Fixed particles have infinite
    # mass.
    area = sum(np.bincount(rest.faces[:, k], rest.face_areas / 3.0, minlength=n) for k in range(3))
    fixed = attachment >= 1.0
    inverse_mass = np.where(fixed, 0.0, 1.0 / (fabric.density * np.maximum(area, 1e-7)))
    chord = row_lengths(rest.vertices[a] - rest.vertices[b])
    lengths = chord if lengths is None else lengths
    # Spring constant of an edge, N/m: membrane stiffness times the area that the edge stands for, over its length
    # squared. The solver takes compliances, the inverses.
    stiffness = fabric.stretch_stiffness * np.maximum(_edge_areas(rest), 1e-9) / np.maximum(chord, 1e-6) ** 2
    # From what holds the cloth downwards: corrections then travel far within a substep.
    anchor, tether, depth = _tethers(rest, lengths, fixed, fabric.slack)
    moves = np.flatnonzero(~(fixed[a] & fixed[b]))
    order = moves[np.argsort((depth[a] + depth[b])[moves], kind="stable")]
    hinges, curvature, rest_curvature, bend = _hinges(rest, fixed, fabric.bend_stiffness)
    # Partly attached particles hang on springs, whose compliance falls from infinity (free) to 0 (fixed).
    spring = None
    if attach_stiffness > 0 and ((attachment > 0) & ~fixed).any():
        with np.errstate(divide="ignore"):
            spring = ((1.0 - attachment) / (attach_stiffness * attachment**2)).astype(np.float32)
    return ClothModel(
        faces=rest.faces.astype(np.int32),
        inverse_mass=inverse_mass.astype(np.float32),
        edges=np.ascontiguousarray(rest.edges[order], dtype=np.int32),
        lengths=lengths[order].astype(np.float32),
        stretch=(1.0 / stiffness)[order].astype(np.float32),
        compress=(1.0 / (fabric.compression * stiffness))[order].astype(np.float32),
        hinges=hinges,
        curvature=curvature,
        rest_curvature=rest_curvature,
        bend=bend,
        anchor=anchor,
        tether=tether,
        apart=_apart(rest),
        spring=spring,
    )


def shuffled(model: ClothModel) -> ClothModel:
    """Return the same constraints with their edges in an order at random, always the same.

    For fine, stiff cloth: over thousands of edges that hardly give, each sweep from what holds the cloth downwards
    hands all errors on to the hem, and edges tremble by half their length. At random errors meet and cancel.
    """
    order = np.random.default_rng(0).permutation(len(model.edges))
    return replace(
        model,
        edges=model.edges[order],
        lengths=model.lengths[order],
        stretch=model.stretch[order],
        compress=model.compress[order],
    )


def _edge_areas(rest: TriangleMesh) -> Float[np.ndarray, " e"]:
    """Areas of the faces at each edge together, in the order of `rest.edges`, square metres."""
    n = max(rest.vertex_count, 1)
    key = rest.edges[:, 0] * n + rest.edges[:, 1]
    total = np.zeros(len(key))
    for k in range(3):
        ends = np.sort(np.stack([rest.faces[:, k], rest.faces[:, (k + 1) % 3]], axis=1), axis=1)
        np.add.at(total, np.searchsorted(key, ends[:, 0] * n + ends[:, 1]), rest.face_areas)
    return total


def _hinges(
    rest: TriangleMesh, fixed: np.ndarray, stiffness: float
) -> tuple[Int32[np.ndarray, "b 4"], Float32[np.ndarray, "b 4"], Float32[np.ndarray, " b"], Float32[np.ndarray, " b"]]:
    """Pairs of triangles that resist bending (the quadratic model of Bergou et al. 2006, with curvature at rest).

    With `c` the cotangent weights of an inner edge, `sum_i c_i x_i` is the curvature of the hinge as a vector; its part
    along the hinge's normal is held at its value at rest.
    """
    # Edge k of a face runs from corner k to k + 1; corner k + 2 lies opposite.
    half = paired_half_edges(rest.faces)
    if stiffness == 0.0:
        half = half[:0]
    face, corner = half // 3, half % 3
    a, b = (rest.faces[face[:, 0], (corner[:, 0] + k) % 3] for k in (0, 1))
    c, d = (rest.faces[face[:, k], (corner[:, k] + 2) % 3] for k in (0, 1))
    moves = (~fixed[np.stack([a, b, c, d])]).any(axis=0)
    a, b, c, d, face = a[moves], b[moves], c[moves], d[moves], face[moves]
    x = rest.vertices
    # Needles would give weights without bound.
    ac, ad, bc, bd = (
        np.clip(_cotangents(x, *corners), -3.0, 3.0) for corners in ((a, b, c), (a, b, d), (b, a, c), (b, a, d))
    )
    weights = np.stack([bc + bd, ac + ad, -ac - bc, -ad - bd], axis=1)
    corners = np.stack([a, b, c, d], axis=1)
    normal = np.cross(x[b] - x[a], x[c] - x[a]) + np.cross(x[d] - x[a], x[b] - x[a])
    normal /= np.maximum(row_lengths(normal), 1e-12)[:, None]
    at_rest = np.einsum("hk,hki,hi->h", weights, x[corners], normal)
    areas = rest.face_areas[face].sum(axis=1)
    compliance = areas / (3.0 * stiffness) if stiffness else areas
    return (
        np.ascontiguousarray(corners, dtype=np.int32),
        np.ascontiguousarray(weights, dtype=np.float32),
        at_rest.astype(np.float32),
        compliance.astype(np.float32),
    )


def _cotangents(
    x: Float[np.ndarray, "N 3"], at: Int[np.ndarray, " b"], p: Int[np.ndarray, " b"], q: Int[np.ndarray, " b"]
) -> Float[np.ndarray, " b"]:
    u, v = x[p] - x[at], x[q] - x[at]
    return np.einsum("hi,hi->h", u, v) / np.maximum(row_lengths(np.cross(u, v)), 1e-12)


def _apart(rest: TriangleMesh) -> Float32[np.ndarray, " n"]:
    """Return the distance from each particle to the nearest one that no edge joins to it; inf: there is none."""
    n, edges = rest.vertex_count, rest.edges
    most = int(np.bincount(edges.ravel(), minlength=n).max(initial=0))
    # Of as many as neighbours, itself and one more, one at least is no neighbour.
    away, near = cKDTree(rest.vertices).query(rest.vertices, k=list(range(1, most + 3)))
    own = np.repeat(np.arange(n)[:, None], most + 2, axis=1)
    joined = np.isin(np.minimum(own, near) * (n + 1) + np.maximum(own, near), edges @ [n + 1, 1]) | (near == own)
    return np.where(joined, np.inf, away).min(axis=1).astype(np.float32)


def _tethers(
    rest: TriangleMesh, lengths: Float[np.ndarray, " e"], fixed: np.ndarray, slack: float
) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return long-range attachments (Kim et al. 2012): the nearest fixed particle along the cloth, and its distance
    bound.

    A path along edges zigzags, so that the straight distance and a little more is the bound where it is shorter.
    """
    n = rest.vertex_count
    if not fixed.any():
        return np.full(n, -1, np.int32), np.zeros(n, np.float32), np.zeros(n)
    # Shortest path along the cloth from each particle to its nearest fixed one.
    distance, _, source = dijkstra(
        edge_graph(rest, lengths),
        directed=False,
        indices=np.flatnonzero(fixed),
        min_only=True,
        return_predecessors=True,
    )
    held = np.isfinite(distance) & ~fixed
    anchor = np.where(held, source, -1)
    straight = row_lengths(rest.vertices - rest.vertices[np.maximum(source, 0)])
    bound = np.minimum(distance, 1.01 * straight + 1e-3) * (1.0 + slack)
    depth = np.where(np.isfinite(distance), distance, 0.0)
    return anchor.astype(np.int32), np.where(held, bound, 0.0).astype(np.float32), depth
