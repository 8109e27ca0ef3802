"""Make the mesh that is simulated: openings and the bridges over them, few particles, lengths along the cloth."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.mesh import normalize_rows, row_lengths
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import border_loops, face_adjacency, face_components
from smplxpp.template.template import BODY_PART, Template

# Metres from an opening's border: a bridge is as wide as the gap between a hem and what it hangs over.
REACH = 0.035
# Cosine to the opening's axis from which a surface closes the opening instead of going on to it.
_VERTEX, _FACE = 0.35, 0.2
# Cosine of its axis to the vertical from which an opening looks up: shoulders lie about a neckline and look up as well.
_UPWARDS = 0.3
# Metres behind a bridge at which there is nothing but the inside of the garment; behind cloth that lies on the body
# there is the body.
_HOLLOW = (0.03, 0.06)


def find_opening_bridges(template: Template) -> Bool[np.ndarray, " F"]:
    """Find the faces of a template's clothes that close an opening, in the T-pose.

    A scan runs from a hem's edge inwards to the leg. Such faces lie within `REACH` of the part's border, or continue
    those as a lid, look along the opening's axis, which cloth that continues to the border does not, and have a hollow
    behind them. Small pieces that only such faces join to the rest are bridges, too. A body without an inside has none.
    The array is read-only.
    """
    if template not in _BRIDGES:
        _BRIDGES[template] = _opening_bridges(template)
        _BRIDGES[template].flags.writeable = False
    return _BRIDGES[template]


# Results by template, because each part that is cut for a simulation asks for those of all parts.
_BRIDGES: WeakKeyDictionary[Template, Bool[np.ndarray, " F"]] = WeakKeyDictionary()


def _opening_bridges(template: Template) -> Bool[np.ndarray, " F"]:
    """Return the mask of `find_opening_bridges`, part by part."""
    out = np.zeros(len(template.faces), dtype=bool)
    parts = template.cloth_parts
    if not parts:
        return out
    skin = template.part_mesh(BODY_PART)
    try:
        body = SignedDistanceField(skin, solid=True)
    except InputError:  # without an inside of the body there are no hollows
        return out
    for part in parts:
        faces = template.part_faces(part)
        cloth = template.mesh.submesh(faces)[0]
        out[faces] = _bridges_of(turned_over(cloth) if looks_inwards(cloth, skin) else cloth, body)
    return out


def find_opening_lids(mesh: TriangleMesh, body: TriangleMesh) -> Bool[np.ndarray, " M"]:
    """Find the faces of bridges over openings that reach farther than `REACH`, as a scan closes a wide skirt below.

    Cameras do not look up into a skirt, and what none sees stays solid: its hem is joined to the calves, and the legs
    to each other. Narrow bridges stay: they hide a gap and are no wider than a hem's fold.

    Args:
        mesh: a piece of clothing in the T-pose, oriented outwards.
        body: the naked body in the T-pose, closed or nearly.
    """
    try:
        field = SignedDistanceField(body, solid=True)
    except InputError:  # without an inside of the body there are no hollows
        return np.zeros(mesh.face_count, dtype=bool)
    bridges = _bridges_of(mesh, field)
    # A lid is a connected bridge from the border to a face that far from every border.
    borders = [loop for loop in border_loops(mesh.faces) if loop_length(mesh, loop) >= SHORTEST_OPENING]
    if not borders or not bridges.any():
        return np.zeros(mesh.face_count, dtype=bool)
    distance = geodesics(mesh, np.concatenate(borders))[0][mesh.faces]
    piece = _level(mesh, bridges)
    far, bordering = piece[(distance > REACH).all(axis=1)], piece[(distance == 0.0).any(axis=1)]
    return np.isin(piece, np.setdiff1d(np.intersect1d(far, bordering), -1))


def _bridges_of(mesh: TriangleMesh, body: SignedDistanceField) -> Bool[np.ndarray, " M"]:
    # A lid continues a bridge evenly under an opening that looks down, a hem: within half of the widest hem's width,
    # its faces look along the axis more than folds of a hem do. Inside of a hood's or a scarf's border there is cloth.
    downwards, lid_reach, lid_cosine = -0.7, 0.3, 0.5
    bridges = np.zeros(mesh.face_count, dtype=bool)
    normals = mesh.vertex_normals
    smooth = normals[mesh.faces].mean(axis=1)
    for loop in border_loops(mesh.faces):
        if loop_length(mesh, loop) < SHORTEST_OPENING:
            continue
        axis = opening_axis(mesh, loop)
        if axis[1] > _UPWARDS:
            continue
        # Faces near such an opening that look along its axis close it like a lid: all corners do, or the face and
        # one corner.
        distance = geodesics(mesh, loop)[0]
        near = distance < REACH
        looks = (near & (normals @ axis > _VERTEX))[mesh.faces]
        along = near[mesh.faces].any(axis=1) & (mesh.face_normals @ axis > _FACE)
        start = _hollow(mesh, looks.all(axis=1) | (looks.any(axis=1) & along), body)
        bridges |= start
        if axis[1] < downwards:
            inner = (distance < lid_reach)[mesh.faces].all(axis=1) & (smooth @ axis > lid_cosine)
            piece = _level(mesh, start | _hollow(mesh, inner, body))
            bridges |= np.isin(piece, np.unique(piece[start & (piece >= 0)]))
    return bridges | _crumbs(mesh, bridges)


def _hollow(mesh: TriangleMesh, faces: Bool[np.ndarray, " M"], body: SignedDistanceField) -> Bool[np.ndarray, " M"]:
    """Return those of some faces behind which there is air; with the body behind them they are the garment itself."""
    found = np.flatnonzero(faces)
    for depth in _HOLLOW:
        behind = mesh.face_centers[found] - depth * mesh.face_normals[found]
        found = found[body.query(behind).distance > 0] if len(found) else found
    out = np.zeros(mesh.face_count, dtype=bool)
    out[found] = True
    return out


def _connected(mesh: TriangleMesh, faces: Bool[np.ndarray, " M"]) -> Int[np.ndarray, " M"]:
    """Return the connected piece, from 0 on, of each of some faces; -1 for the others."""
    piece = np.full(mesh.face_count, -1)
    piece[faces] = face_components(mesh.faces[faces])
    return piece


def _level(mesh: TriangleMesh, faces: Bool[np.ndarray, " M"]) -> Int[np.ndarray, " M"]:
    """Return the connected piece, from 0 on, of each of some faces; -1 for others, and for pieces that are upright.

    A lid is level as a whole, where the back of a rolled scarf is not.
    """
    level = 0.3  # share of a lid's area that is seen from below; lids between the folds of a skirt have 0.38 and more
    piece = _connected(mesh, faces)
    areas = np.bincount(piece[faces], mesh.face_areas[faces], 1)
    below = np.bincount(piece[faces], -(mesh.face_areas * mesh.face_normals[:, 1])[faces], 1)
    return np.where(faces & (below > level * areas)[piece], piece, -1)


def _crumbs(mesh: TriangleMesh, bridges: Bool[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """The pieces that bridges alone join to the rest and that are smaller than these: holes in what was found of a
    bridge.

    As cloth they would be carried by what is nearest, up to a decimetre away, and be torn when that swings.
    """
    left = ~bridges
    piece = _connected(mesh, left)
    pairs = face_adjacency(mesh.faces)[0]
    across = bridges[pairs[:, 0]] != bridges[pairs[:, 1]]
    beside = np.unique(piece[pairs[across]])
    areas = np.bincount(piece[left], weights=mesh.face_areas[left], minlength=1)
    small = (beside >= 0) & (areas[beside] < mesh.face_areas[bridges].sum())
    return np.isin(piece, beside[small])


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
    seed, cell = np.unique(source[used], return_inverse=True)
    # Of a cell with vertices on the border only these count.
    kept = border[used] | ~(np.bincount(cell, border[used], len(seed)) > 0.0)[cell]
    used, cell = used[kept], cell[kept]
    size = np.bincount(cell, minlength=len(seed))
    mean = np.stack([np.bincount(cell, points[used, axis], len(seed)) / size for axis in range(3)], axis=1)
    order = np.lexsort((row_lengths(points[used] - mean[cell]), cell))
    return used[order[np.cumsum(size) - size]]
