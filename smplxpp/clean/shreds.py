"""Find shreds: what cuts of bridges leave of the other limb's surface, which the T-pose carries off the body.

Where a sleeve was fused with the side, the cut follows the edges that stretch most. What lies behind it belongs to the
other limb, hangs on by a ribbon, and its smoothed weights mix both limbs: the T-pose draws it out and leaves it in
the air. A scan in which no two limbs are fused has no cuts, and is not touched.
"""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from smplxpp.core import TriangleMesh, row_lengths
from smplxpp.core.topology import border_loops, face_components

STRETCH = 2.5
"""Ratio of an edge's lengths after and before unposing, from which a face beside a cut is drawn out."""
STANDS_OFF = 0.011
"""Growth of a face's distance from the body by unposing, as a share of the body's extent: 2 cm of a person."""
NARROW = 0.008
"""Half the width up to which cloth beside a cut is a ribbon or a tooth, as a share of the body's extent: 1.4 cm."""
PIECE = 0.005
"""Area of pieces that cuts leave, as a share of the part's, below which they are removed: 60 square cm of a shirt."""


def find_shreds(
    posed: TriangleMesh, rest: TriangleMesh, body: TriangleMesh, body_rest: TriangleMesh, cut: Bool[np.ndarray, " N"]
) -> Bool[np.ndarray, " M"]:
    """Find the faces beside cuts that are no cloth of the limb that they hang on.

    A face is drawn out where unposing lengthens it more than `STRETCH` times, or takes it farther from the body than
    the scan shows it by `STANDS_OFF`. Drawn-out faces that are joined with a cut are shreds. So are ribbons and teeth
    beside a cut (what an opening with a disc of the radius `NARROW` removes), and small pieces.

    Args:
        posed: the part as scanned, without bridges, metres.
        rest: the part in the T-pose.
        body: the body in the pose of the scan.
        body_rest: the body in the T-pose.
        cut: vertices of the part on the borders that cuts have made.
    """
    if not cut.any():
        return np.zeros(posed.face_count, dtype=bool)
    extent = float(np.ptp(body.vertices, axis=0).max())
    # Drawn-out faces count where they are joined with a cut by others.
    lifted = (_distance(rest, body_rest) - _distance(posed, body))[posed.faces].mean(axis=1) > STANDS_OFF * extent
    drawn = drawn_out(posed, rest, STRETCH) | lifted
    shred = _joined(posed, drawn, cut)
    # Remove them first, because a ribbon between two shreds is one only then.
    left = ~shred
    border = cut | np.bincount(posed.faces[shred].ravel(), minlength=posed.vertex_count).astype(bool)
    shred[left] = _narrow(posed.faces[left], posed.vertices, border, NARROW * extent)
    # Pieces that this leaves, where a cut has made them.
    left = np.flatnonzero(~shred)
    piece = face_components(posed.faces[left])
    area = np.bincount(piece, posed.face_areas[left])
    of_cut = np.bincount(piece, border[posed.faces[left]].any(axis=1)) > 0
    small = of_cut & (area < PIECE * area.sum())
    shred[left] = small[piece]
    return shred


def cut_borders(part: TriangleMesh, opened: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Return the vertices on borders of a part that were on none before the cuts (`opened`)."""
    out = np.zeros(part.vertex_count, dtype=bool)
    for loop in border_loops(part.faces):
        out[loop] = True
    return out & ~opened


def _distance(part: TriangleMesh, body: TriangleMesh) -> Float64[np.ndarray, " N"]:
    return np.sqrt(igl.point_mesh_squared_distance(part.vertices, body.vertices, body.faces)[0])


def drawn_out(posed: TriangleMesh, rest: TriangleMesh, factor: float) -> Bool[np.ndarray, " M"]:
    """Return the faces with an edge whose length grows by more than `factor`; edges below 2 mm count as 2 mm long."""
    before, after = (
        row_lengths((mesh.triangles - np.roll(mesh.triangles, 1, axis=1)).reshape(-1, 3)).reshape(-1, 3)
        for mesh in (posed, rest)
    )
    return np.asarray((after > factor * np.maximum(before, 2e-3)).any(axis=1))


def _joined(mesh: TriangleMesh, chosen: Bool[np.ndarray, " M"], cut: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " M"]:
    """Return the chosen faces that are joined with a vertex of a cut by chosen faces."""
    out = np.zeros(mesh.face_count, dtype=bool)
    if chosen.any():
        faces = mesh.faces[chosen]
        component = face_components(faces)
        reached = np.bincount(component, cut[faces].any(axis=1)) > 0
        out[chosen] = reached[component]
    return out


def _narrow(
    faces: Int[np.ndarray, "M 3"], vertices: Float[np.ndarray, "N 3"], cut: Bool[np.ndarray, " N"], radius: float
) -> Bool[np.ndarray, " M"]:
    """Return the faces near a cut that a morphological opening with a disc of this radius removes.

    Distances are those along edges. Vertices farther from a border than the radius are the core; what is no farther
    from the core than the radius, and the edges' length, grows back.
    """
    mesh = TriangleMesh(vertices, faces)
    loops = border_loops(faces)
    if not loops:
        return np.zeros(len(faces), dtype=bool)
    border = np.concatenate(loops)
    ends = mesh.edges
    length = row_lengths(vertices[ends[:, 1]] - vertices[ends[:, 0]])
    graph = coo_matrix((length, ends.T), shape=(len(vertices),) * 2).tocsr()

    def along(sources: np.ndarray, limit: float) -> np.ndarray:
        return dijkstra(graph, directed=False, indices=sources, min_only=True, limit=limit)

    back = radius + 1.5 * float(np.median(length))
    core = np.flatnonzero(~np.isfinite(along(border, radius)))
    core = core[np.isin(core, faces)]
    lost = ~np.isfinite(along(core, back)) if len(core) else np.ones(len(vertices), dtype=bool)
    near = np.isfinite(along(np.flatnonzero(cut), 3.0 * radius))
    return np.asarray((lost & near)[faces].any(axis=1))
