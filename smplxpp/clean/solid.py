"""Unite body and clothes to one solid: sheets are given a thickness, and manifold3d computes the union of all."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import igl
import manifold3d
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from smplxpp.clean.thicken import slab_behind, thickened
from smplxpp.core import (
    GeometryWarning,
    InputError,
    MeshLike,
    TriangleMesh,
    as_mesh,
    require_at_least,
    require_positive,
)
from smplxpp.core.errors import one_line
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.solids import closed_mesh, mesh_of_solid, solid_of_mesh
from smplxpp.core.surface_points import draw_on_surface
from smplxpp.core.topology import component_labels, face_components

# Edges shorter than this fraction of the size are collapsed: 17 um on an adult, 2 um on a figure of 180 mm.
_SHORT = 1e-5


@dataclass(frozen=True)
class SolidConfig:
    """Options of `solid_of_parts`, with lengths in metres.

    Attributes:
        thickness: thickness of the cloth; its outer side keeps its place.
        gap: distance to the body below which cloth is filled down to it.
        cells: least number of grid cells along the body's largest side, for thick cloth.
        seed: seed of the points where walls are measured.
    """

    thickness: float = 0.002
    gap: float = 0.01
    cells: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("thickness", self.thickness)
        require_positive("gap", self.gap)
        require_at_least("cells", self.cells, 10)


@dataclass(frozen=True)
class SolidReport:
    """Measurements of a solid that a printer is given.

    Attributes:
        faces: number of faces of its surface.
        vertices: number of vertices.
        components: number of pieces; 1, otherwise an error was raised.
        genus: number of handles of the surface, such as an arm akimbo or a strap.
        volume_cm3: volume.
        area_cm2: area of the surface.
        size_mm: extents along x, y and z.
        wall_mm_p1: first percentile of the wall thickness over the area (`wall_thickness`).
        wall_mm_p5: fifth percentile.
        wall_mm_median: median.
        thin_share: share of the area where the wall is thinner than 90 % of `SolidConfig.thickness`.
        dropped_pieces: crumbs outside, shells inside, and hollows that were filled.
        gap_mm: by part, the distance to the body below which it was filled.
    """

    faces: int
    vertices: int
    components: int
    genus: int
    volume_cm3: float
    area_cm2: float
    size_mm: tuple[float, float, float]
    wall_mm_p1: float
    wall_mm_p5: float
    wall_mm_median: float
    thin_share: float
    dropped_pieces: int
    gap_mm: dict[str, float]

    def as_dict(self) -> dict:
        """Return the measurements as plain numbers, for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed manifold surface of one piece, metres, with its measurements."""

    mesh: TriangleMesh
    report: SolidReport

    __repr__ = one_line


def solid_of_parts(body: MeshLike, parts: Mapping[str, MeshLike], *, config: SolidConfig | None = None) -> Solid:
    """Return one closed surface of body and parts, as a 3D printer needs it.

    The body's openings are closed. Each part is thickened inward (thin cloth by `thickened`, cloth thicker than a 360th
    of the body by `slab_behind`), and filled down to the body where that lies within the gap. A part that then does not
    touch the rest is filled from farther away, up to eight gaps. Hollows without an opening are filled, crumbs are
    removed.

    Args:
        body: manifold, oriented outward, metres.
        parts: manifold sheets by name, oriented outward.
        config: options.

    Raises:
        InputError: a body of several pieces, or parts that stay separate from it.
    """
    body = as_mesh(body, subject="body")
    config = config or SolidConfig()
    pieces = [_body_solid(body)]
    # Separate pieces below this fraction of a part's volume are crumbs, which are removed.
    crumb = 0.05
    if len(_separate_pieces(pieces[0], least=crumb * pieces[0].volume())) > 1:
        raise InputError("body", expected="a body of one piece", received="pieces that do not touch")
    # Add part after part; the gap is doubled until the union is one piece.
    gaps = {}
    multiples = (1.0, 2.0, 4.0, 8.0)
    for name, given in parts.items():
        part = as_mesh(given, subject=f"part {name}")
        for wider in multiples:
            made = _cloth(part, body, config, wider * config.gap)
            union = manifold3d.Manifold.batch_boolean([*pieces, made], manifold3d.OpType.Add)
            apart = len(_separate_pieces(union, least=crumb * made.volume()))
            if apart == 1:
                break
        else:
            raise InputError(
                f"part {name}",
                expected=f"a part that comes within {multiples[-1] * config.gap * 1e3:g} mm of the body in each piece",
                received=f"{apart} pieces",
                remedy="give a wider --gap-mm, or build again without the piece",
            )
        gaps[name] = wider * config.gap * 1e3
        pieces = [union]
    whole = pieces[0]
    # Files of printers have single precision: edges that it cannot resolve are collapsed.
    largest = _largest(_largest(whole).simplify(_SHORT * _size(whole)))
    others = len(whole.decompose()) - 1
    if others:
        warnings.warn(
            f"solid: {others} crumbs of the union and shells inside it are left out", GeometryWarning, stacklevel=2
        )
    return Solid(separate_touching_vertices(mesh_of_solid(largest)), _measured(largest, config, others, gaps))


def separate_touching_vertices(mesh: TriangleMesh) -> TriangleMesh:
    """Move coincident vertices inward along their normals, so that no two share a position.

    A solid may touch itself in a vertex or an edge; a file of unconnected triangles, as STL is, would join it there.
    Vertices with equal normals still coincide then; they are moved to the centres of their one-rings.
    """
    # Pairs closer than a printer's files resolve: first along the normals, then, if still together, towards one-rings.
    size = _SHORT * float(np.ptp(mesh.vertices, axis=0).max())
    pairs = cKDTree(mesh.vertices).query_pairs(size, output_type="ndarray")
    vertices, moved = mesh.vertices.copy(), np.unique(pairs)
    vertices[moved] -= 2 * size * mesh.vertex_normals[moved]
    still = pairs[np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1) < size]
    for k in np.unique(still):
        inward = mesh.vertices[np.unique(mesh.faces[(mesh.faces == k).any(axis=1)])].mean(axis=0) - mesh.vertices[k]
        vertices[k] += 2 * size * inward / max(float(np.linalg.norm(inward)), 1e-12)
    return mesh.with_vertices(vertices)


def _body_solid(body: TriangleMesh) -> manifold3d.Manifold:
    """Return the union of the body's pieces with openings closed, without pieces that are inside out or empty."""
    component = face_components(body.faces)
    solids = []
    for k in range(int(component.max()) + 1):
        piece = solid_of_mesh(closed_mesh(body.submesh(component == k)[0]), subject="body")
        if piece.volume() > 0:
            solids.append(piece)
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def _cloth(part: TriangleMesh, body: TriangleMesh, config: SolidConfig, gap: float) -> manifold3d.Manifold:
    """Return a part as cloth with a thickness, filled down to the body where that is near."""
    # Depth of the inner side: the thickness, or more where the body is near. It jumps where cloth leaves the body, so
    # that 20 rounds of averaging smooth it; it never becomes less than it was.
    above = SignedDistanceField(body, solid=True).query(part.vertices).distance
    depth = np.where(above < gap, np.maximum(above, 0.0) + config.thickness, config.thickness)
    edges = part.edges
    both = np.concatenate([edges, edges[:, ::-1]])
    neighbours = np.maximum(np.bincount(both[:, 0], minlength=part.vertex_count), 1)
    smooth = depth
    for _ in range(20):
        mean = np.bincount(both[:, 0], smooth[both[:, 1]], minlength=part.vertex_count) / neighbours
        smooth = np.maximum(0.5 * (smooth + mean), depth)
    # Cloth of at least 2.5 cells, at 900 cells along the body at most, is a level set; thinner cloth hardly intersects
    # itself. A part filled down over a wide gap is mostly within the body, where self-intersections do not show.
    size = float(np.ptp(body.vertices, axis=0).max())
    cells_through, most_cells = 2.5, 900
    cell = min(config.thickness / cells_through, size / config.cells)
    thick = config.thickness / cells_through >= size / most_cells and np.ptp(smooth) <= 2 * config.thickness
    component, solids = face_components(part.faces), []
    for k in range(int(component.max()) + 1):
        sheet, source = part.submesh(component == k)
        if thick and len(sheet.border_edges):
            slab = solid_of_mesh(slab_behind(sheet, smooth[source], cell=cell), subject="cloth")
            solids.append(slab.simplify(0.1 * cell))  # flattens the steps of the grid
        else:
            solids.append(solid_of_mesh(thickened(sheet, inward=smooth[source]), subject="cloth"))
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def _separate_pieces(solid: manifold3d.Manifold, *, least: float) -> list[manifold3d.Manifold]:
    """Return the largest piece, and the pieces of at least the volume `least` that lie outside of it.

    Pieces inside are shells of cloth that intersects itself; the volume in them is filled already.
    """
    largest, *others = sorted(solid.decompose(), key=lambda piece: -piece.volume())
    large = [piece for piece in others if piece.volume() > least]
    if not large:
        return [largest]
    surface = mesh_of_solid(largest)
    points = np.array([mesh_of_solid(piece).vertices[0] for piece in large])
    within = igl.winding_number(surface.vertices, surface.faces, points) > 0.5
    return [largest, *(piece for piece, inside in zip(large, within, strict=True) if not inside)]


def _largest(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    return max(solid.decompose(), key=lambda piece: piece.volume())


def _size(solid: manifold3d.Manifold) -> float:
    """Return the longest side of the bounding box."""
    box = solid.bounding_box()
    return max(high - low for low, high in zip(box[:3], box[3:], strict=True))


def _measured(solid: manifold3d.Manifold, config: SolidConfig, dropped: int, gaps: dict[str, float]) -> SolidReport:
    mesh = mesh_of_solid(solid)
    walls = wall_thickness(mesh, solid=solid, seed=config.seed) * 1e3
    # Percentiles in millimetres over sampled points, because a single smallest wall is often a sharp crease.
    p1, p5, median = np.percentile(walls, (1, 5, 50))
    size = np.ptp(mesh.vertices, axis=0) * 1e3
    return SolidReport(
        faces=mesh.face_count,
        vertices=mesh.vertex_count,
        components=int(component_labels(mesh.edges, mesh.vertex_count).max()) + 1,
        genus=int(solid.genus()),
        volume_cm3=solid.volume() * 1e6,
        area_cm2=solid.surface_area() * 1e4,
        size_mm=(float(size[0]), float(size[1]), float(size[2])),
        wall_mm_p1=float(p1),
        wall_mm_p5=float(p5),
        wall_mm_median=float(median),
        thin_share=float((walls < 0.9 * config.thickness * 1e3).mean()),
        dropped_pieces=dropped,
        gap_mm=gaps,
    )


def wall_thickness(
    mesh: MeshLike, *, solid: manifold3d.Manifold | None = None, seed: int = 0
) -> Float[np.ndarray, " n"]:
    """Return the wall thickness at 4,000 random points of a closed surface, metres.

    It is the distance along the inward normal until the ray leaves the solid. Walls inside the solid, where it
    intersects itself, do not count, because a slicer does not see them.
    """
    mesh = as_mesh(mesh, subject="mesh")
    solid = solid_of_mesh(mesh) if solid is None else solid
    rays = 4000
    face, weights = draw_on_surface(mesh, rays, seed=seed, method="unsorted")
    points = np.einsum("nk,nkd->nd", weights, mesh.triangles[face])
    # A ray starts slightly below its surface point, in order not to hit the surface there.
    reach = mesh.bbox_diagonal
    begin = 1e-7 * reach
    starts = points - begin * mesh.face_normals[face]
    ends = points - reach * mesh.face_normals[face]
    # Count the surfaces that the ray is within; at 0 it has left the solid.
    out = np.zeros(rays)
    for k, (start, end) in enumerate(zip(starts, ends, strict=True)):
        depth = 1
        for hit in solid.ray_cast(start, end):
            depth += -1 if np.dot(hit.normal, end - start) > 0 else 1
            if depth == 0:
                out[k] = hit.distance * (reach - begin) + begin
                break
    return out
