"""Repair the raw arrays of a scan to a manifold mesh that the next stages can rely on; every change is counted."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Int64, UInt8
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from smplxpp.core import GeometryWarning, InputError, PointsLike, TriangleMesh
from smplxpp.core.errors import one_line
from smplxpp.core.foreign import mesh_arrays
from smplxpp.core.topology import component_labels, half_edges, manifold_corners, paired_half_edges


@dataclass(frozen=True)
class CleanReport:
    """Number of elements that each repair changed.

    Attributes:
        nonfinite_vertices: vertices with NaN or infinity, dropped with their faces.
        stray_vertices: outliers far from all other vertices, dropped with their faces.
        welded_vertices: vertices merged into another one.
        zero_area_faces: dropped faces without area.
        duplicate_faces: dropped faces that repeat another one.
        flipped_faces: faces flipped for consistent, outward winding.
        split_vertices: vertices added where the surface was not manifold.
        unreferenced_vertices: vertices dropped because no face uses them.
    """

    nonfinite_vertices: int = 0
    stray_vertices: int = 0
    welded_vertices: int = 0
    zero_area_faces: int = 0
    duplicate_faces: int = 0
    flipped_faces: int = 0
    split_vertices: int = 0
    unreferenced_vertices: int = 0

    @property
    def is_clean(self) -> bool:
        """Return whether no repair was necessary."""
        return not any(getattr(self, f.name) for f in fields(self))

    def __str__(self) -> str:
        counts = [f"{getattr(self, f.name)} {f.name.replace('_', ' ')}" for f in fields(self) if getattr(self, f.name)]
        return ", ".join(counts) or "nothing to repair"


@dataclass(frozen=True, eq=False)
class Sanitized:
    """A repaired mesh and the raw elements that it came from.

    Attributes:
        mesh: two-manifold (with borders), every vertex referenced, winding consistent in each component.
        source_vertex: (n,) index into the raw vertices.
        source_face: (m,) index into the raw faces.
        report: counts of the changes.
        merged_into: (N,) for every raw vertex the one that it was welded to; its own index for most.
    """

    mesh: TriangleMesh
    source_vertex: Int64[np.ndarray, " n"]
    source_face: Int64[np.ndarray, " m"]
    report: CleanReport
    merged_into: Int64[np.ndarray, " N"]

    __repr__ = one_line

    def mean_colors(self, colors: UInt8[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "n 3"]:
        """Return the colours of the mesh's vertices, each the mean over the raw vertices that were welded to it.

        Files split vertices along the seams of their textures; the two sides' colours differ a little.
        """
        used = self.merged_into[self.source_vertex]
        count = np.bincount(self.merged_into, minlength=len(colors))
        out = colors[used]
        for k in range(3):
            sums = np.bincount(self.merged_into, colors[:, k], minlength=len(colors))
            out[:, k] = np.rint(sums[used] / count[used])
        return out


def sanitize(vertices: PointsLike, faces: ArrayLike | None = None, *, weld_tolerance: float | None = None) -> Sanitized:
    """Repair raw arrays: NaN, duplicates, faces without area, winding, and non-manifold edges and vertices.

    The repairs are done in this order:

    1. drop vertices that are not finite, and few outliers more than 1000 times farther from the median than the median
       vertex, with their faces;
    2. merge vertices closer than `weld_tolerance` into the one of lowest index;
    3. drop faces without area and duplicate faces;
    4. make winding consistent in each component, and outward;
    5. cut the surface at edges with more than two faces and at vertices where fans meet;
    6. drop unreferenced vertices.

    Sanitising the result again changes nothing but the same cuts. A warning lists the changes.

    Args:
        vertices: (N, 3) positions, or a mesh of any library.
        faces: (M, 3) integer vertex indices; None if a mesh is given.
        weld_tolerance: distance below which vertices merge; None is 1e-6 of the bounding box's diagonal.

    Raises:
        InputError: wrong shapes, indices out of range, nothing left, or many vertices in one place.
    """
    points, corners = mesh_arrays(vertices if faces is None else (vertices, faces))
    result = _repaired(np.asarray(points, dtype=np.float64), corners, weld_tolerance)
    if not result.report.is_clean:
        warnings.warn(f"mesh repaired: {result.report}", GeometryWarning, stacklevel=2)
    return result


def _repaired(vertices: np.ndarray, faces: np.ndarray, weld_tolerance: float | None) -> Sanitized:
    """Return the repaired arrays; the steps are numbered as in `sanitize`."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError("mesh vertices", expected="shape (N, 3)", received=f"shape {vertices.shape}")
    # 1. Vertices that are not finite, and outliers. `TriangleMesh` checks shapes and indices.
    finite = np.isfinite(vertices).all(axis=1)
    faces = TriangleMesh(np.where(finite[:, None], vertices, 0.0), faces).faces
    near = finite & ~_outliers(vertices, np.unique(faces[finite[faces].all(axis=1)]))
    kept = np.flatnonzero(near[faces].all(axis=1))
    faces = faces[kept]
    referenced = np.unique(faces)
    if not len(referenced):
        raise InputError(
            "mesh",
            expected="faces with finite corners",
            received=f"{int(finite.sum())} finite vertices and no such face",
        )
    # 2. Weld.
    diagonal = float(np.linalg.norm(np.ptp(vertices[referenced], axis=0)))
    tolerance = 1e-6 * diagonal if weld_tolerance is None else weld_tolerance
    target = _weld(vertices, referenced, tolerance)
    faces = target[faces]

    # 3. Faces below 1e-12 of the squared diagonal have no area (2 um x 2 um on an adult).
    edge = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    solid = 0.5 * np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1) > 1e-12 * diagonal**2
    faces, kept = faces[solid], kept[solid]
    if not len(faces):
        raise InputError(
            "mesh", expected="faces with area", received="only faces without area", remedy="check the units"
        )
    unique = _first_of_each(faces)
    duplicates = len(faces) - len(unique)
    faces, kept = faces[unique], kept[unique]

    # 4. Winding; 5. and 6. cuts, which renumber the vertices that are used.
    flipped = _inconsistent_faces(vertices, faces)
    faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    new_faces, source_vertex = manifold_corners(faces)
    merged = int((target[referenced] != referenced).sum())
    used = len(np.unique(source_vertex))
    report = CleanReport(
        nonfinite_vertices=int((~finite).sum()),
        stray_vertices=int((finite & ~near).sum()),
        welded_vertices=merged,
        zero_area_faces=int((~solid).sum()),
        duplicate_faces=duplicates,
        flipped_faces=int(flipped.sum()),
        split_vertices=len(source_vertex) - used,
        unreferenced_vertices=int(near.sum()) - merged - used,
    )
    return Sanitized(TriangleMesh(vertices[source_vertex], new_faces), source_vertex, kept, report, target)


def _outliers(vertices: np.ndarray, referenced: np.ndarray) -> np.ndarray:
    """Return (N,) the referenced vertices more than 1000 times farther from the median than the median vertex.

    Raises:
        InputError: more outliers than can be told from the mesh, or coordinates whose squares overflow.
    """
    factor, largest = 1e3, 1e100
    stray = np.zeros(len(vertices), dtype=bool)
    if not len(referenced):
        return stray
    # Halved coordinates, so that differences of the largest numbers stay finite.
    half = 0.5 * vertices[referenced]
    distance = np.abs(half - np.median(half, axis=0)).max(axis=1)
    usual = float(np.median(distance))
    if usual > largest:
        raise InputError("mesh vertices", expected="coordinates of a surface", received=f"most above {largest:g}")
    far = distance > factor * usual
    if usual == 0 or not far.any():  # `_weld` reports vertices in one place
        return stray
    # More than three outliers and 1 % of the vertices may be the mesh itself.
    if far.sum() > max(3, 0.01 * len(referenced)):
        raise InputError(
            "mesh vertices",
            expected="a surface",
            received=f"{int(far.sum())} of {len(referenced)} vertices more than {factor:g} times farther from the "
            "middle than most",
            remedy="remove what lies far from the person",
        )
    stray[referenced[far]] = True
    return stray


def _weld(vertices: np.ndarray, referenced: np.ndarray, tolerance: float) -> np.ndarray:
    """Return (N,) for every vertex the one of lowest index that it merges into; chains of near vertices merge as one.

    Raises:
        InputError: more than a hundred vertices in the same place on average, whose pairs would fill the memory.
    """
    most = 100
    target = np.arange(len(vertices))
    tree = cKDTree(vertices[referenced])
    # Counted before the pairs are listed, because only the list needs memory. Each pair counts twice here.
    if tree.count_neighbors(tree, tolerance) > 2 * most * len(referenced):
        raise InputError(
            "mesh vertices",
            expected="a surface",
            received=f"vertices in heaps, each with more than {most} others in the same place",
            remedy="check for vertices without a position, and for stray geometry far from the rest",
        )
    pairs = tree.query_pairs(tolerance, output_type="ndarray")
    if len(pairs):
        # Connected components of the pairs, so that chains merge as one; the lowest index stands for its component.
        group = component_labels(pairs, len(referenced))
        _, first = np.unique(group, return_index=True)
        target[referenced] = referenced[first[group]]
    return target


def _first_of_each(faces: np.ndarray) -> np.ndarray:
    """Return the increasing indices of the first face for every set of three vertices."""
    low, middle, high = np.sort(faces, axis=1).T
    order = np.lexsort((high, middle, low))
    key = np.stack([low, middle, high])[:, order]
    return np.sort(order[np.append(True, (np.diff(key) != 0).any(axis=0))])


def _inconsistent_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the faces to flip for consistent winding in each component, and then for outward orientation.

    Consistency is connectivity in the double cover: every face is two nodes, as given and flipped, and each edge with
    two faces joins the nodes that agree. A component whose two sheets are connected (a Moebius strip) stays as it is.
    """
    # Connected components of the double cover.
    count = len(faces)
    pairs = paired_half_edges(faces)
    ends = half_edges(faces)
    a, b = pairs[:, 0] // 3, pairs[:, 1] // 3
    agree = ends[pairs[:, 0], 0] != ends[pairs[:, 1], 0]
    links = np.concatenate([np.stack([a, b + count * ~agree], 1), np.stack([a + count, b + count * agree], 1)])
    graph = coo_matrix((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(2 * count, 2 * count))
    sheet = connected_components(graph, directed=False)[1]
    given, turned = sheet[:count], sheet[count:]
    orientable = given != turned
    component = np.unique(np.minimum(given, turned), return_inverse=True)[1]
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)

    # Flip the sheet with the smaller area of each component.
    second = given > turned
    area_second = np.bincount(component, area * second)
    total = np.bincount(component, area)
    flip = orientable & np.where(area_second[component] > 0.5 * total[component], ~second, second)

    # Then flip whole components that face inward, by the flux of (x - centroid) through them (three times the volume).
    # An open sheet is flipped only if the flux is below -5 % of area x radius, because its volume is not defined.
    sign = np.where(flip, -1.0, 1.0)
    center = corners.mean(axis=1)
    centroid = np.stack([np.bincount(component, area * center[:, k]) for k in range(3)], 1) / total[:, None]
    arm = center - centroid[component]
    flux = np.bincount(component, 0.5 * sign * np.einsum("ij,ij->i", cross, arm))
    radius = np.sqrt(np.bincount(component, area * np.einsum("ij,ij->i", arm, arm)) / total)
    closed = np.bincount(component, minlength=len(total)) * 3 == 2 * np.bincount(component[a], minlength=len(total))
    inside_out = flux < np.where(closed, 0.0, -0.05 * total * radius)
    return flip ^ (inside_out[component] & orientable)
