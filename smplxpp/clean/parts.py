"""Cut a labelled scan into loose parts, remove their specks, close their pinholes, and reduce them to a face budget."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int, Int64, UInt8

from smplxpp.clean.remesh import METHODS, remesh, require_remesher
from smplxpp.clean.simplify import simplify
from smplxpp.core import (
    LABELS,
    SKIN,
    InputError,
    Labels,
    MeshLike,
    TriangleMesh,
    as_array,
    as_mesh,
    require_choice,
    require_known,
    row_lengths,
)
from smplxpp.core.errors import one_line
from smplxpp.core.topology import border_loops, edge_groups, face_components, manifold_corners, split_faces


def drop_specks(mesh: MeshLike, *, area_fraction: float = 1e-3) -> Bool[np.ndarray, " M"]:
    """Return the faces of components with at least `area_fraction` of the mesh's area; the largest is always kept."""
    mesh = as_mesh(mesh, subject="mesh")
    component = face_components(mesh.faces)
    area = np.bincount(component, mesh.face_areas)
    kept = area >= area_fraction * area.sum()
    kept[np.argmax(area)] = True
    return kept[component]


def loop_lengths(mesh: MeshLike, loops: list[Int[np.ndarray, " _"]]) -> Float64[np.ndarray, " L"]:
    """Return the perimeter of each closed loop of vertex indices, metres."""
    mesh = as_mesh(mesh, subject="mesh")
    positions = [mesh.vertices[loop] for loop in loops]
    return np.array([np.linalg.norm(p - np.roll(p, -1, axis=0), axis=1).sum() for p in positions])


def fill_pinholes(mesh: MeshLike, *, max_length: float = 0.04) -> tuple[TriangleMesh, Int64[np.ndarray, " n"]]:
    """Close border loops shorter than `max_length` metres; longer ones are openings (hem, cuffs, neck) and stay.

    A loop of three edges is closed by one triangle, a longer one by a fan around its mean. The border of a component
    that is itself no larger than the hole is not a hole.

    Args:
        mesh: manifold.
        max_length: perimeter from which a loop is an opening.

    Returns:
        The manifold mesh, with new vertices and faces at the end, and for every vertex the vertex of `mesh` that it is,
        or for a fan's centre the loop vertex nearest to it.
    """
    mesh = as_mesh(mesh, subject="mesh")
    loops = border_loops(mesh.faces)
    if not loops:
        return mesh, np.arange(mesh.vertex_count)
    component = face_components(mesh.faces)
    area = np.bincount(component, mesh.face_areas)
    component_of_vertex = np.zeros(mesh.vertex_count, dtype=np.int64)
    component_of_vertex[mesh.faces] = component[:, None]
    lengths = loop_lengths(mesh, loops)
    vertices, faces, source = [mesh.vertices], [mesh.faces], [np.arange(mesh.vertex_count)]
    next_vertex = mesh.vertex_count
    for loop, length in zip(loops, lengths, strict=True):
        # A hole with this perimeter has an area of at most length^2 / (4 pi); a component below length^2 is a speck
        # with an outer border.
        if length > max_length or area[component_of_vertex[loop[0]]] < length**2:
            continue
        # The closing faces traverse the border in the opposite direction.
        if len(loop) == 3:
            faces.append(loop[::-1][None])
            continue
        center = mesh.vertices[loop].mean(axis=0)
        nearest = loop[np.argmin(np.linalg.norm(mesh.vertices[loop] - center, axis=1))]
        faces.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), next_vertex)], axis=1))
        vertices.append(center[None])
        source.append(np.array([nearest]))
        next_vertex += 1
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces)), np.concatenate(source)


def split_long_edges(
    mesh: MeshLike, *, longest: float, most: int
) -> tuple[TriangleMesh, list[Int64[np.ndarray, "_ 2"]]]:
    """Split edges longer than `longest` metres at their middles, round by round, until none is left.

    The faces of both sides of an edge meet at the same new vertex, so that no gap opens. A face is cut into two, three
    or four, as one, two or three of its edges are split. The surface stays where it is.

    Args:
        mesh: manifold.
        longest: length of an edge, metres; made longer by a quarter until the faces are at most `most`.
        most: number of faces; a mesh that has as many is returned as it is.

    Returns:
        The mesh with new vertices at the end, and of each round the two ends of each new vertex. The first
        one is not on a border if only one of them is.
    """
    mesh = as_mesh(mesh, subject="mesh")
    if mesh.face_count >= most:
        return mesh, []
    while True:
        out, rounds = mesh, list[Int64[np.ndarray, "_ 2"]]()
        while out.face_count <= most:
            step, ends = _split_once(out, longest)
            if not len(ends):
                return out, rounds
            out, rounds = step, [*rounds, ends]
        longest *= 1.25


def _split_once(mesh: TriangleMesh, longest: float) -> tuple[TriangleMesh, Int64[np.ndarray, "_ 2"]]:
    """Return the mesh with each edge longer than `longest` split once, and the ends of the new vertices."""
    edges, faces = mesh.edges, mesh.faces
    long = row_lengths(mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]]) > longest
    ends = edges[long]
    if not len(ends):
        return mesh, ends
    on_border = np.zeros(mesh.vertex_count, dtype=bool)
    on_border[mesh.border_edges] = True
    turned = on_border[ends[:, 0]] & ~on_border[ends[:, 1]]
    faces = split_faces(faces, ends, mesh.vertex_count)[0]
    middles = mesh.vertices[ends].mean(axis=1)
    ends = np.where(turned[:, None], ends[:, ::-1], ends)
    return TriangleMesh(np.concatenate([mesh.vertices, middles]), faces), ends


@dataclass(frozen=True)
class PartsConfig:
    """Options of cleaning parts with `clean_parts`.

    Attributes:
        face_budgets: faces of a part by label name; `Label.face_budget` for missing names.
        speck_area: area fraction of the part below which components are removed.
        pinhole_length: perimeter, metres, below which border loops are closed.
        method: "quadric" edge collapse (`simplify`) or "isotropic" remeshing (`remesh`).
        longest_edge: metres; longer edges of a part below its budget are split, because a large face bends with the
            weights of its corners alone, and skin comes through it. 95 % of the skin's edges are below 32 mm.
        labels: what the ids of labels stand for.
    """

    face_budgets: Mapping[str, int] = field(default_factory=dict)
    speck_area: float = 1e-3
    pinhole_length: float = 0.04
    method: str = "quadric"
    longest_edge: float = 0.03
    labels: Labels = LABELS

    def __post_init__(self) -> None:
        require_choice("method", self.method, METHODS)
        require_known("face budgets", sorted(self.face_budgets), self.labels.names)


@dataclass(frozen=True)
class PartReport:
    """Counts and distances of the cleaning of a part.

    Attributes:
        faces_before: faces of the part in the scan.
        faces_after: faces of the cleaned part.
        speck_faces: faces removed as specks.
        filled_pinholes: border loops closed.
        components: connected components.
        opening_lengths: perimeters of the remaining openings, metres, longest first.
        non_manifold_edges: edges with more than two faces.
        flipped_faces: faces opposed to the nearest source face.
        restored_faces: source faces restored by `simplify`.
        distance_mean: mean distance, metres, of the part's vertices before simplification to its faces after.
        distance_p95: its 95th percentile.
    """

    faces_before: int
    faces_after: int
    speck_faces: int
    filled_pinholes: int
    components: int
    opening_lengths: tuple[float, ...]
    non_manifold_edges: int
    flipped_faces: int
    restored_faces: int
    distance_mean: float
    distance_p95: float


@dataclass(frozen=True, eq=False)
class CleanedPart:
    """A loose part, ready for skin weights.

    Attributes:
        mesh: manifold, in the scan's frame.
        label: the id of its label.
        source_vertex: (n,) the scan's vertex that each vertex stands for.
        vertex_colors: (n, 3) uint8 from there, or None.
        report: the changes.
    """

    mesh: TriangleMesh
    label: int
    source_vertex: Int64[np.ndarray, " n"]
    vertex_colors: UInt8[np.ndarray, "n 3"] | None
    report: PartReport

    __repr__ = one_line


def clean_parts(
    mesh: MeshLike,
    face_labels: Int[np.ndarray, " M"],
    *,
    config: PartsConfig | None = None,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
) -> dict[str, CleanedPart]:
    """Cut a labelled scan into its loose parts and clean each.

    Skin is no part, because the body model replaces it, nor is the background (-1). A part may have several components
    (two shoes). A vertex attribute of the scan is transferred as `attribute[part.source_vertex]`.

    Args:
        mesh: the scan, sanitized.
        face_labels: (M,) label ids.
        config: options.
        vertex_colors: (N, 3) uint8 colours of the scan.

    Raises:
        InputError: labels of another length or unknown, or no loose part at all.
        MissingExtraError: parts to remesh without pymeshlab.
    """
    mesh = as_mesh(mesh, subject="mesh")
    config = config or PartsConfig()
    require_remesher(config.method)
    face_labels = as_array(face_labels)
    if face_labels.shape != (mesh.face_count,):
        raise InputError("face labels", expected=f"shape ({mesh.face_count},)", received=f"shape {face_labels.shape}")
    if vertex_colors is not None and len(vertex_colors) != mesh.vertex_count:
        raise InputError("vertex colours", expected=f"{mesh.vertex_count} rows", received=f"{len(vertex_colors)}")
    # Labels must be known; -1 is the background.
    labels = config.labels
    unknown = np.setdiff1d(face_labels, [-1] + [label.id for label in labels])
    if len(unknown):
        raise InputError("face labels", expected=f"label ids -1 to {labels[-1].id}", received=f"{unknown.tolist()}")
    parts = {}
    for label in labels:
        selected = face_labels == label.id
        if label.kind == SKIN.name or not selected.any():
            continue
        # Clean the part; its vertices keep the colours of the scan's vertices that they stand for.
        budget = config.face_budgets.get(label.name, label.face_budget)
        given = None if vertex_colors is None else np.asarray(vertex_colors)
        parts[label.name] = _clean_part(mesh, selected, given, label=label.id, budget=budget, config=config)
    if not parts:
        raise InputError(
            "face labels",
            expected=f"at least one of {', '.join(label.name for label in labels if label.kind != SKIN.name)}",
            received="only skin and background",
            remedy="check that the label set is the right one",
        )
    return parts


def _clean_part(
    scan: TriangleMesh,
    selected: np.ndarray,
    colors: UInt8[np.ndarray, "N 3"] | None,
    *,
    label: int,
    budget: int,
    config: PartsConfig,
) -> CleanedPart:
    """Return the cleaned part of the selected faces of a scan with its colours."""
    # Cut the part out, drop specks, and cut non-manifold vertices apart.
    part, source = scan.submesh(selected)
    kept = drop_specks(part, area_fraction=config.speck_area)
    part, of_part = part.submesh(kept)
    faces, of_kept = manifold_corners(part.faces)
    part = TriangleMesh(part.vertices[of_kept], faces)
    source = source[of_part][of_kept]
    # Close pinholes, reduce to the budget, and measure how far the surface moved.
    loops = len(border_loops(part.faces))
    part, of_cut = fill_pinholes(part, max_length=config.pinhole_length)
    source = source[of_cut]
    colors = None if colors is None else colors[source]
    # Split what is coarser than the skin. New vertices have the mean colour of their two ends, and stand for the end
    # inside the part: those that stand for vertices on borders count as borders.
    part, rounds = split_long_edges(part, longest=config.longest_edge, most=budget)
    for ends in rounds:
        source = np.concatenate([source, source[ends[:, 0]]])
        if colors is not None:
            colors = np.concatenate([colors, np.rint(colors[ends].mean(axis=1)).astype(np.uint8)])
    small = remesh(part, budget) if config.method == "isotropic" else simplify(part, budget)
    tree = igl.AABB()
    tree.init(small.mesh.vertices, small.mesh.faces)
    distance = np.sqrt(tree.squared_distance(small.mesh.vertices, small.mesh.faces, part.vertices)[0])
    openings = border_loops(small.mesh.faces)
    lengths = sorted(loop_lengths(small.mesh, openings).tolist(), reverse=True)
    return CleanedPart(
        small.mesh,
        label,
        source[small.source_vertex],
        None if colors is None else colors[small.source_vertex],
        PartReport(
            faces_before=int(selected.sum()),
            faces_after=small.mesh.face_count,
            speck_faces=int((~kept).sum()),
            filled_pinholes=loops - len(border_loops(part.faces)),
            components=int(face_components(small.mesh.faces).max()) + 1,
            opening_lengths=tuple(lengths),
            non_manifold_edges=int((edge_groups(small.mesh.faces)[2] > 2).sum()),
            flipped_faces=small.flipped_faces,
            restored_faces=small.restored_faces,
            distance_mean=float(distance.mean()),
            distance_p95=float(np.percentile(distance, 95)),
        ),
    )
