"""The mesh that is simulated: openings, few particles, lengths along the cloth."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from smplxpp.core.mesh import TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.topology import face_components

# Metres: shorter borders are holes.
SHORTEST_OPENING = 0.15


def opening_axis(mesh: TriangleMesh, loop: Int[np.ndarray, " n"]) -> Float[np.ndarray, " 3"]:
    """Return the unit normal of the cap that would close a border loop, out of the mesh; zero for a flat line."""
    points = mesh.vertices[loop] - mesh.vertices[loop].mean(axis=0)
    # The cap's faces run against the loop, which runs along those of the mesh.
    total = -np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    return normalize_rows(total[None])[0]


def loop_length(mesh: TriangleMesh, loop: Int[np.ndarray, " n"]) -> float:
    """Return the length of a border loop, metres."""
    points = mesh.vertices[loop]
    return float(row_lengths(np.roll(points, -1, axis=0) - points).sum())


def geodesics(
    mesh: TriangleMesh, sources: Int[np.ndarray, " S"]
) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Return the length of the shortest path along edges from the nearest source, metres, and that source.

    Vertices without a path have inf and -1.
    """
    distance, _, source = dijkstra(
        edge_graph(mesh), directed=False, indices=sources, min_only=True, return_predecessors=True
    )
    return distance, np.where(source >= 0, source, -1).astype(np.int64)


def edge_graph(mesh: TriangleMesh, lengths: Float[np.ndarray, " E"] | None = None) -> csr_matrix:
    """Make the (N, N) upper half of the graph of edges, weighted by their lengths or by other ones."""
    n, (a, b) = mesh.vertex_count, mesh.edges.T
    if lengths is None:
        lengths = row_lengths(mesh.vertices[a] - mesh.vertices[b])
    return csr_matrix((np.maximum(lengths, 1e-9), (a, b)), shape=(n, n))


def looks_inwards(mesh: TriangleMesh, body: TriangleMesh) -> bool:
    """Whether cloth lies on a body with its faces turned inside out: most of its area looks against the skin's side."""
    # Samples of faces whose orientation is tested.
    looks = 2000
    every = max(1, mesh.face_count // looks)
    face = igl.point_mesh_squared_distance(mesh.face_centers[::every], body.vertices, body.faces)[1]
    alike = np.einsum("mi,mi->m", mesh.face_normals[::every], body.face_normals[face])
    return bool((mesh.face_areas[::every] * alike).sum() < 0)


def turned_over(mesh: TriangleMesh) -> TriangleMesh:
    """Return the same surface looking to the other side."""
    return TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))


def largest_piece(mesh: TriangleMesh, faces: Bool[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """Return those of the chosen faces that hang together with the most area."""
    if not faces.any():
        return faces
    chosen = np.flatnonzero(faces)
    piece = face_components(mesh.faces[chosen])
    area = np.bincount(piece, mesh.face_areas[chosen])
    out = np.zeros_like(faces)
    out[chosen[piece == area.argmax()]] = True
    return out


def coarsen(mesh: TriangleMesh, spacing: float) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, "m 3"]]:
    """Choose vertices about `spacing` metres apart and the triangles between them: the dual of Voronoi cells.

    Cells are geodesic; their seeds start farthest from each other and move to the middle three times (Lloyd). Cells on
    a border keep their seeds there, so that hems keep their length.

    Returns:
        The vertices of `mesh`, and triangles of indices into them, oriented as its faces are.
    """
    used = mesh.referenced
    # In a triangular lattice of spacing s every vertex stands for an area of sqrt(3) / 2 s^2.
    area = float(mesh.face_areas.sum())
    count = int(np.clip(round(area / (0.5 * np.sqrt(3.0) * spacing**2)), min(12, len(used)), len(used)))
    seeds = _farthest(mesh.vertices, used, count)
    border = np.zeros(mesh.vertex_count, dtype=bool)
    border[mesh.border_edges] = True
    # Lloyd's iteration on the surface: assign vertices to the geodesically nearest seed, move each seed to its cell's
    # middle.
    for _ in range(3):
        seeds = _middles(mesh.vertices, used, geodesics(mesh, seeds)[1], border)
    # A face whose corners lie in three different cells becomes a triangle between their seeds; repeated ones are
    # dropped.
    cell = np.full(mesh.vertex_count, -1, dtype=np.int64)
    cell[seeds] = np.arange(len(seeds))
    faces = cell[geodesics(mesh, seeds)[1]][mesh.faces]
    corners = np.sort(faces, axis=1)
    _, first = np.unique(corners, axis=0, return_index=True)
    faces = faces[np.sort(first)]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1) & (faces >= 0).all(axis=1)]
    kept = np.unique(faces)
    place = np.zeros(len(seeds), dtype=np.int64)
    place[kept] = np.arange(len(kept))
    return seeds[kept], place[faces]


def lengths_along(mesh: TriangleMesh, ends: Int[np.ndarray, "E 2"], *, samples: int = 24) -> Float[np.ndarray, " E"]:
    """Return how long the chords between vertices are when they are laid onto the mesh, metres.

    A chord cuts the corners of every fold; cloth that was given its length would shrink.
    """
    a, b = mesh.vertices[ends[:, 0]], mesh.vertices[ends[:, 1]]
    t = np.linspace(0.0, 1.0, samples + 1)[1:-1, None]
    chord = a[:, None] + (b - a)[:, None] * t
    laid = igl.point_mesh_squared_distance(chord.reshape(-1, 3), mesh.vertices, mesh.faces)[2].reshape(chord.shape)
    path = np.concatenate([a[:, None], laid, b[:, None]], axis=1)
    return np.linalg.norm(np.diff(path, axis=1), axis=2).sum(axis=1)


def _farthest(points: Float[np.ndarray, "N 3"], used: Int[np.ndarray, " U"], count: int) -> Int[np.ndarray, " count"]:
    """Farthest-point sampling of the used points, from the first one on."""
    at = points[used]
    chosen, distance = [0], row_lengths(at - at[0])
    for _ in range(count - 1):
        chosen.append(int(distance.argmax()))
        np.minimum(distance, row_lengths(at - at[chosen[-1]]), out=distance)
    return used[np.unique(chosen)]


def _middles(
    points: Float[np.ndarray, "N 3"],
    used: Int[np.ndarray, " U"],
    source: Int[np.ndarray, " N"],
    border: Bool[np.ndarray, " N"],
) -> Int[np.ndarray, " n"]:
    """Return for each cell its vertex that is nearest to the cell's mean, on the border for cells seeded there."""
    used = used[source[used] >= 0]
    order = used[np.argsort(source[used], kind="stable")]
    cells = np.split(order, np.flatnonzero(np.diff(source[order])) + 1)
    out = []
    for cell in cells:
        own = cell[border[cell]] if border[cell].any() else cell
        out.append(own[np.argmin(row_lengths(points[own] - points[own].mean(axis=0)))])
    return np.array(out)
