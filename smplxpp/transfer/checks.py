"""Check and repair the meshes and weights that a transfer takes: sizes, axes, winding, restricted sources."""

from __future__ import annotations

import warnings

import igl
import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy.spatial import cKDTree

from smplxpp.core import GeometryWarning, InputError, TriangleMesh, row_lengths
from smplxpp.core.topology import component_labels

_SAME_PLACE = 1e-6
"""Share of a mesh's extent within which vertices are copies: round-off of files in float32 is a tenth of it."""

# Other choices of axes: their name, and the permutation and signs that bring them to +Y up.
_AXES = (
    ("+Z up", [0, 2, 1], (1, 1, -1)),
    ("-Z up", [0, 2, 1], (1, -1, 1)),
    ("+X up", [1, 0, 2], (-1, 1, 1)),
    ("-X up", [1, 0, 2], (1, -1, 1)),
    ("-Y up", [0, 1, 2], (-1, -1, 1)),
)


def check_target(target: TriangleMesh) -> None:
    """Raise InputError for a mesh without faces."""
    if not target.face_count:
        raise InputError("target mesh", expected="at least one face", received="none")


def check_source(source: TriangleMesh, weights: Float[np.ndarray, "V J"]) -> Float64[np.ndarray, "V J"]:
    """Return the weights in float64, rows summing to 1 (zero where no face uses the vertex), after checking them.

    Raises:
        InputError: no faces; wrong shape; NaN; negative; a row that does not sum to 1 within 1e-4.
    """
    if not source.face_count or not source.face_areas.any():
        raise InputError(
            "source mesh", expected="faces with area", received=f"{source.face_count} faces without any area"
        )
    weights = np.asarray(weights, dtype=np.float64)
    if weights.ndim != 2 or len(weights) != source.vertex_count or not weights.shape[1]:
        raise InputError(
            "source weights", expected=f"shape ({source.vertex_count}, J)", received=f"shape {weights.shape}"
        )
    # Check the rows that a face uses: finite, not negative, a sum of 1.
    used = source.referenced
    rows = weights[used]
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise InputError(
            "source weights",
            expected="finite values",
            received=f"NaN or infinity, first at vertex {used[np.argmax(bad)]}",
        )
    total = rows.sum(axis=1)
    bad = (rows < 0).any(axis=1) | (np.abs(total - 1.0) > 1e-4)
    if bad.any():
        first = np.argmax(bad)
        raise InputError(
            "source weights",
            expected="rows without negative values that sum to 1",
            received=f"{int(bad.sum())} other rows, first at vertex {used[first]} with sum {total[first]:.6g}",
            remedy="normalise the body model's weights",
        )
    # Divide by the sum, so that rows sum to one in double precision and not only within the tolerance.
    out = np.zeros_like(weights)
    out[used] = rows / total[:, None]
    return out


def extent(mesh: TriangleMesh) -> float:
    """Return the size of a mesh: twice the largest distance from the area's centroid.

    For a box it equals the diagonal of the bounding box, but it does not change when the mesh is rotated.
    """
    centroid = (mesh.face_areas @ mesh.face_centers) / max(mesh.face_areas.sum(), np.finfo(float).tiny)
    return 2.0 * float(row_lengths(mesh.vertices[mesh.referenced] - centroid).max())


def check_placement(source: TriangleMesh, target: TriangleMesh, distance: Float[np.ndarray, " N"]) -> None:
    """Refuse a target that clearly does not lie on the source: other units, other axes, another place.

    Args:
        source: the body.
        target: the part.
        distance: of each target vertex to the source.

    Raises:
        InputError: names the likely cause.
    """
    # Sizes and the median distance, as multiples of the source's size.
    size = extent(source)
    ratio = extent(target) / size
    far = float(np.median(distance)) / size
    remedy = ""
    # No part is 3 times as large as the body, or 50 times smaller.
    if ratio > 3.0 or ratio < 0.02:
        # The power of ten that makes the part at most a little larger than the body.
        power = int(np.ceil(np.log10(ratio / 1.5)))
        remedy = f"the units differ: multiply the target's coordinates by {10.0**-power:g}"
    # From 5 % on other axes may fit better; above 25 % the part is somewhere else even if none do.
    elif far > 0.05:
        remedy = _axes_remedy(source, target.vertices[target.referenced], 0.5 * float(np.median(distance)))
        if not remedy and far > 0.25:
            remedy = "check units, axes (+Y up) and translation of both meshes"
    if remedy:
        points = target.vertices[target.referenced]
        low, high = (np.array2string(f(points, axis=0), precision=3) for f in (np.min, np.max))
        raise InputError(
            "target mesh placement",
            expected="a part worn by the source, in its pose, unit and axes",
            received=f"box {low} to {high}, {ratio:.2g} of the source's size, {far:.2g} of it away (median)",
            remedy=remedy,
        )


def _axes_remedy(source: TriangleMesh, points: np.ndarray, better: float) -> str:
    """Return a remedy if other axes bring the points nearer than `better` (median distance), else an empty string.

    Other axes that put more of the points into the body are not those of what is worn: a tutu, which stands off the
    hips all round, would be nearer to a body that it cuts from head to foot.
    """
    sample = points[:: max(1, len(points) // 500)]
    turned = [np.ascontiguousarray(sample[:, axes] * sign) for _, axes, sign in _AXES]
    squared = igl.point_mesh_squared_distance(np.concatenate(turned), source.vertices, source.faces)[0]
    nearer = np.sqrt(np.median(squared.reshape(len(_AXES), -1), axis=1)) < better
    if not nearer.any():
        return ""
    inside = _share_inside(source, sample) + 0.15
    for k in np.flatnonzero(nearer):
        if _share_inside(source, turned[k]) <= inside:
            name = _AXES[k][0]
            return f"the axes differ: the target seems to have {name}; both need +Y up"
    return ""


def _share_inside(source: TriangleMesh, points: np.ndarray) -> float:
    """Return the share of points inside a surface, by generalised winding numbers."""
    winding = igl.fast_winding_number(source.vertices, source.faces, np.ascontiguousarray(points))
    return float((winding > 0.5).mean())


def consistent_winding(mesh: TriangleMesh, *, subject: str) -> TriangleMesh:
    """Wind neighbouring faces alike, flipping the fewer faces of each component; warns with their number.

    Two faces agree when they run along their common edge in opposite directions.
    """
    # Winding is consistent where no directed edge occurs twice.
    f = mesh.faces
    directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    _, counts = np.unique(directed[:, 0] * mesh.vertex_count + directed[:, 1], return_counts=True)
    if counts.max(initial=1) == 1:
        return mesh
    # Orient each component by breadth-first search, then keep the orientation that most of its faces had.
    oriented, patch = igl.bfs_orient(f)
    flipped = _cyclic(oriented) != _cyclic(f)
    size = np.bincount(patch)
    turned = np.bincount(patch, flipped) > 0.5 * size
    flipped ^= turned[patch]
    if not flipped.any():
        return mesh
    warnings.warn(
        f"{subject}: {int(flipped.sum())} of {len(f)} faces were wound against their neighbours; flipped",
        GeometryWarning,
        stacklevel=4,
    )
    faces = f.copy()
    faces[flipped] = faces[flipped][:, ::-1]
    return TriangleMesh(mesh.vertices, faces)


def welded(mesh: TriangleMesh) -> tuple[TriangleMesh, Int64[np.ndarray, " N"]]:
    """Make vertices at the same place one, and faces with the same corners; files cut meshes along texture seams.

    Weights depend on the surface, not on how a file lists it: without this every seam is a border, and opens in motion.

    Returns:
        The mesh; it keeps unreferenced vertices, and a mesh whose faces would all vanish is returned as it is.
        For each of the N vertices of `mesh` its vertex in it.
    """
    count = mesh.vertex_count
    pairs = cKDTree(mesh.vertices).query_pairs(_SAME_PLACE * extent(mesh), output_type="ndarray")
    index = component_labels(pairs, count).astype(np.int64) if len(pairs) else np.arange(count)
    # Keep the order of first occurrence, so that a mesh without copies stays as it is.
    _, first, index = np.unique(index, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    first, index = np.sort(first), rank[index.reshape(-1)]
    faces = index[mesh.faces]
    corners = np.sort(faces, axis=1)
    whole = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])
    # Of faces with the same corners, as of sheets with two sides, the first one stays.
    once = np.zeros(len(faces), dtype=bool)
    once[np.unique(corners, axis=0, return_index=True)[1]] = True
    if not (whole & once).any() or ((whole & once).all() and len(first) == count):
        return mesh, np.arange(count)
    return TriangleMesh(mesh.vertices[first], faces[whole & once]), index


def surface_components(mesh: TriangleMesh) -> Int32[np.ndarray, " N"]:
    """Return the connected component of every vertex as `SkinWeights` numbers it: copies at one place are joined."""
    once, copies = welded(mesh)
    return component_labels(once.edges, once.vertex_count).astype(np.int32)[copies]


def restrict_source(
    source: TriangleMesh, weights: Float[np.ndarray, "V J"], allowed: Bool[np.ndarray, " J"]
) -> tuple[TriangleMesh, Float64[np.ndarray, "n J"]]:
    """Restrict the source to faces that the allowed joints own (at least half of the weight at each corner).

    Returns:
        The submesh, and its weights with other joints' shares removed and rows normalised.

    Raises:
        InputError: no face is left.
    """
    share = weights @ allowed.astype(np.float64)
    keep = (share >= 0.5)[source.faces].all(axis=1)
    if not keep.any():
        raise InputError(
            "config allowed_joints",
            expected="joints that own some faces of the source",
            received=f"joints {np.flatnonzero(allowed).tolist()}, which own none",
            remedy="check the joint names and their order",
        )
    mesh, used = source.submesh(keep)
    return mesh, weights[used] * allowed / share[used, None]


def _cyclic(faces: np.ndarray) -> np.ndarray:
    """Return the parity of each face: whether its corners increase, starting from the lowest index."""
    start = faces.argmin(axis=1)
    rows = np.arange(len(faces))
    return faces[rows, (start + 1) % 3] < faces[rows, (start + 2) % 3]
