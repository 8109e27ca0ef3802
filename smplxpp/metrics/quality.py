"""Quality of a mesh: manifoldness, borders, winding, components, shape of its faces, self-intersections."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float64, Integer

from smplxpp.core.errors import GeometryWarning
from smplxpp.core.foreign import MeshLike, as_mesh
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import component_labels, edge_groups
from smplxpp.metrics.intersections import self_intersections
from smplxpp.metrics.sampling import require_surface


@dataclass(frozen=True)
class MeshQuality:
    """Figures of a mesh's quality, as `mesh_quality` measures them.

    Attributes:
        vertices, faces: counts.
        unreferenced_vertices: in no face.
        duplicate_faces: faces with the corners of an earlier one, in any order.
        components: pieces that share no vertex.
        euler: V - E + F over referenced vertices (2 for one closed piece, less 1 a border, less 2 a handle).
        nonmanifold_edges: edges with three or more faces.
        nonmanifold_vertices: whose faces form more than one fan.
        inconsistent_edges: edges with two faces that run along them in the same direction (one has the wrong winding).
        flipped_faces: faces to turn so that each orientable patch is consistent, its majority kept.
        border_edges: with one face.
        border_loops: connected pieces of border.
        border_lengths_mm: longest first.
        zero_area_faces: with no area at all.
        aspect_p50, aspect_p95, aspect_p99, aspect_max: circumradius over twice the inradius (1 for an equilateral
            triangle), of the faces with area.
        edge_length_mean_mm: over edges.
        area_m2: of the surface.
        self_intersections: pairs of faces that cut each other; None when not asked for.
    """

    vertices: int
    faces: int
    unreferenced_vertices: int
    duplicate_faces: int
    components: int
    euler: int
    nonmanifold_edges: int
    nonmanifold_vertices: int
    inconsistent_edges: int
    flipped_faces: int
    border_edges: int
    border_loops: int
    border_lengths_mm: tuple[float, ...]
    zero_area_faces: int
    aspect_p50: float
    aspect_p95: float
    aspect_p99: float
    aspect_max: float
    edge_length_mean_mm: float
    area_m2: float
    self_intersections: int | None = None

    @property
    def manifold(self) -> bool:
        """Return whether no edge has three faces and no vertex two fans."""
        return not self.nonmanifold_edges and not self.nonmanifold_vertices

    @property
    def closed(self) -> bool:
        """Return whether the mesh has no border edge."""
        return not self.border_edges

    def as_dict(self) -> dict:
        """Return the figures as plain numbers for JSON."""
        return {**asdict(self), "manifold": self.manifold, "closed": self.closed}


def mesh_quality(mesh: MeshLike, *, self_intersection: bool = False) -> MeshQuality:
    """Measure the quality of a mesh; `self_intersection` adds the slowest test.

    Raises:
        InputError: no faces, or no area.
    """
    mesh = as_mesh(mesh, subject="mesh")
    require_surface(mesh, "mesh")
    # Vertices without a face are reported, but belong to no component and do not count in Euler's characteristic
    # V - E + F.
    edges, counts = mesh.edges_with_counts
    used = np.unique(mesh.faces)
    length = np.linalg.norm(mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]], axis=1)
    borders = border_loop_lengths(mesh)
    inconsistent = int(inconsistent_edges(mesh).sum())
    # Faces without area have an infinite ratio; they are counted on their own and left out of the percentiles.
    aspect = aspect_ratios(mesh)
    aspect = aspect[np.isfinite(aspect)]
    p50, p95, p99 = np.percentile(aspect, (50, 95, 99))
    return MeshQuality(
        vertices=mesh.vertex_count,
        faces=mesh.face_count,
        unreferenced_vertices=mesh.vertex_count - len(used),
        duplicate_faces=_duplicate_face_count(mesh),
        components=len(np.unique(component_labels(edges, mesh.vertex_count)[used])),
        euler=len(used) - len(edges) + mesh.face_count,
        nonmanifold_edges=int((counts > 2).sum()),
        nonmanifold_vertices=int((fan_counts(mesh) > 1).sum()),
        inconsistent_edges=inconsistent,
        flipped_faces=int(flipped_against_majority(mesh).sum()) if inconsistent else 0,
        border_edges=len(mesh.border_edges),
        border_loops=len(borders),
        border_lengths_mm=tuple((np.sort(borders)[::-1] * 1e3).tolist()),
        zero_area_faces=int((mesh.face_areas == 0).sum()),
        aspect_p50=float(p50),
        aspect_p95=float(p95),
        aspect_p99=float(p99),
        aspect_max=float(aspect.max()),
        edge_length_mean_mm=float(length.mean() * 1e3),
        area_m2=float(mesh.face_areas.sum()),
        self_intersections=len(self_intersections(mesh)) if self_intersection else None,
    )


def faulty_faces(
    mesh: MeshLike, *, pieces: Integer[np.ndarray, " M"] | None = None
) -> dict[str, Bool[np.ndarray, " M"]]:
    """Return which faces have each fault that a mesh can have, by the fault's name, worst first.

    A needle has a circumradius over 200 times its inradius; a face that cuts another does so away from common vertices.

    Args:
        mesh: of M faces.
        pieces: number of the piece that each face belongs to; pieces may cut each other, as eyes and teeth do a face.

    Example:
        >>> faults = faulty_faces(([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [1, 0, 2]]))
        >>> {name: int(faces.sum()) for name, faces in faults.items() if faces.any()}
        {'faces that repeat another': 1}
    """
    mesh = as_mesh(mesh)
    require_surface(mesh, "mesh")
    order, _, count = edge_groups(mesh.faces)
    crowded, cutting = np.zeros(mesh.face_count, dtype=bool), np.zeros(mesh.face_count, dtype=bool)
    crowded[order[np.repeat(count > 2, count)] // 3] = True
    # Winding means something where every edge has at most two faces.
    wound = flipped_against_majority(mesh) if inconsistent_edges(mesh).any() else np.zeros_like(crowded)
    cuts = self_intersections(mesh)
    cutting[cuts[pieces[cuts[:, 0]] == pieces[cuts[:, 1]]].ravel() if pieces is not None else cuts.ravel()] = True
    corners = np.sort(mesh.faces, axis=1)
    by_corners = np.lexsort(corners.T[::-1])
    repeats = np.zeros_like(crowded)
    repeats[by_corners[1:]] = (corners[by_corners[1:]] == corners[by_corners[:-1]]).all(axis=1)
    return {
        "faces at an edge of three": crowded,
        "faces that repeat another": repeats,
        "faces wound the other way": wound & ~repeats,
        "faces without area": mesh.face_areas == 0,
        "faces that cut another": cutting,
        "needles": (aspect_ratios(mesh) > 100.0) & (mesh.face_areas > 0),
    }


def aspect_ratios(mesh: TriangleMesh) -> Float64[np.ndarray, " M"]:
    """The ratio circumradius / (2 inradius) = abc (a + b + c) / (16 A^2): 1 if equilateral, inf without area."""
    t = mesh.triangles
    a, b, c = (np.linalg.norm(t[:, (k + 2) % 3] - t[:, (k + 1) % 3], axis=1) for k in range(3))
    return np.divide(
        a * b * c * (a + b + c), 16.0 * mesh.face_areas**2, out=np.full(len(t), np.inf), where=mesh.face_areas > 0
    )


def border_loop_lengths(mesh: TriangleMesh) -> Float64[np.ndarray, " L"]:
    """The length in metres of each connected piece of border (a loop, where the mesh is manifold)."""
    border = mesh.border_edges
    if not len(border):
        return np.zeros(0)
    nodes, local = np.unique(border, return_inverse=True)
    local = local.reshape(border.shape)
    piece = component_labels(local, len(nodes))[local[:, 0]]
    length = np.linalg.norm(mesh.vertices[border[:, 1]] - mesh.vertices[border[:, 0]], axis=1)
    return np.bincount(piece, length)


def fan_counts(mesh: TriangleMesh) -> Integer[np.ndarray, " N"]:
    """The number of fans at each vertex: groups of its faces that hang together by edges at the vertex."""
    f, m = mesh.faces, mesh.face_count
    # Half-edge k of a face runs from corner k to corner k + 1; corner k of face i is node k * m + i.
    tail, head = np.arange(3 * m), np.roll(np.arange(3 * m), -m)
    vertex = f.T.ravel()
    forward = vertex[tail] < vertex[head]
    low, high = np.where(forward, tail, head), np.where(forward, head, tail)
    order = np.argsort(vertex[low] * mesh.vertex_count + vertex[high], kind="stable")
    low, high = low[order], high[order]
    # Sorted by their two ends, half-edges of one edge are neighbours: link the corners that they share at each end.
    same = (vertex[low][1:] == vertex[low][:-1]) & (vertex[high][1:] == vertex[high][:-1])
    links = np.concatenate([np.stack([end[:-1], end[1:]], axis=1)[same] for end in (low, high)])
    fan = component_labels(links, 3 * m)
    # Each component of linked corners is one fan; count it at the vertex of its first corner.
    first = np.unique(fan, return_index=True)[1]
    return np.bincount(vertex[first], minlength=mesh.vertex_count)


def inconsistent_edges(mesh: TriangleMesh) -> Bool[np.ndarray, " E"]:
    """The edges, in the order of `mesh.edges`, along which two faces run in the same direction."""
    edges, counts = mesh.edges_with_counts
    f, n = mesh.faces, mesh.vertex_count
    # Two faces wound alike run along their common edge in opposite directions, so the sum of the signs is 0.
    directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    index = np.searchsorted(edges[:, 0] * n + edges[:, 1], directed.min(axis=1) * n + directed.max(axis=1))
    direction = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    return (counts == 2) & (np.bincount(index, direction, minlength=len(edges)) != 0)


def flipped_against_majority(mesh: TriangleMesh) -> Bool[np.ndarray, " M"]:
    """The faces wound against the majority of their orientable patch (libigl's `bfs_orient`)."""
    oriented, patch = igl.bfs_orient(mesh.faces)
    # The same cyclic order means that the face was kept; faces with a repeated corner have no orientation.
    kept = np.zeros(mesh.face_count, dtype=bool)
    for shift in range(3):
        kept |= (np.roll(oriented, shift, axis=1) == mesh.faces).all(axis=1)
    turned = ~kept
    minority_is_kept = np.bincount(patch, turned) > 0.5 * np.bincount(patch)
    return np.where(minority_is_kept[patch], kept, turned)


def _duplicate_face_count(mesh: TriangleMesh) -> int:
    corners = np.sort(mesh.faces, axis=1)
    corners = corners[np.lexsort(corners.T)]
    return int((corners[1:] == corners[:-1]).all(axis=1).sum())


def doubtful_pair(a: MeshLike, b: MeshLike) -> str:
    """Return in words why two meshes may not belong together: their sizes differ as units do, or their boxes are apart.

    An empty string where neither is so. A pose changes the size of a person's box by less than a factor of 1.5, so
    that factors from 6.7 on suggest another unit.

    Example:
        >>> square = ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> doubtful_pair(square, (1000 * np.array(square[0]), square[1]))
        'the second mesh is 1,000 times as large as the first: their units differ by 1000'
    """
    one, other = as_mesh(a, subject="first mesh"), as_mesh(b, subject="second mesh")
    boxes = [
        np.stack([m.vertices[m.referenced].min(axis=0), m.vertices[m.referenced].max(axis=0)]) for m in (one, other)
    ]
    ratio = other.bbox_diagonal / max(one.bbox_diagonal, np.finfo(float).tiny)
    for factor in (10, 100, 1000):
        if factor / 1.5 <= max(ratio, 1.0 / max(ratio, np.finfo(float).tiny)) <= 1.5 * factor:
            large, small, times = ("second", "first", ratio) if ratio > 1 else ("first", "second", 1.0 / ratio)
            return f"the {large} mesh is {times:,.4g} times as large as the {small}: their units differ by {factor}"
    # Overlap along each axis, as a share of the shorter of both extents; a flat box overlaps where it lies within.
    shared = np.minimum(boxes[0][1], boxes[1][1]) - np.maximum(boxes[0][0], boxes[1][0])
    shortest = np.minimum(*(box[1] - box[0] for box in boxes))
    margin = 0.01 * max(one.bbox_diagonal, other.bbox_diagonal)
    share = np.clip((shared + margin) / (shortest + margin), 0.0, 1.0).prod()
    if share < _OVERLAP:
        apart = float(np.linalg.norm(boxes[0].mean(axis=0) - boxes[1].mean(axis=0)))
        return (
            f"their boxes share {share:.0%} of the smaller, their middles are {apart:.3g} apart: check place and axes"
        )
    return ""


_OVERLAP = 0.25
"""Share of the smaller box below which two meshes hardly overlap; a person turned by 90 degrees shares about 0.3."""


def warn_of_mixed_winding(mesh: TriangleMesh, angles: tuple[np.ndarray, ...], subject: str) -> None:
    """Warn that angles of normals mean nothing because a mesh's faces are wound both ways.

    Asked only where more than 1 % of the angles (degrees) are obtuse, because the answer costs a sort of the edges.
    Vertices in one place count as one, so that triangle soups are seen through.
    """
    obtuse = np.concatenate(angles) > 90.0
    if obtuse.mean() <= 0.01:
        return
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    welded = TriangleMesh(mesh.vertices, place.reshape(-1)[mesh.faces])
    mixed = int(inconsistent_edges(welded).sum())
    if mixed:
        warnings.warn(
            f"{subject}: winding is mixed at {mixed} edges, so that the angle of the normals means nothing; "
            "read normal_consistency, or repair it with smplxpp.clean.sanitize",
            GeometryWarning,
            stacklevel=3,
        )
