"""Body and clothes as one solid: sheets take a thickness, and the union of all is one closed surface (manifold3d)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import igl
import manifold3d
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from smplxpp.clean.slab import slab_behind
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.solids import closed_mesh, mesh_of_solid, solid_of_mesh
from smplxpp.core.topology import border_loops, component_labels, face_components
from smplxpp.core.validation import require_at_least, require_positive

# Rounds of smoothing of how deep the inner side lies: it changes by leaps where cloth leaves the body.
_SMOOTHING = 20
# A part that hangs free of the body is joined to it where it comes nearer than this many gaps.
_WIDER = (1.0, 2.0, 4.0, 8.0)
# Pieces that stay apart and are below this share of a part's cloth are crumbs and go.
_CRUMB = 0.05
# Edges shorter than this share of the size are nothing: 17 um on an adult, 2 um on a figure of 180 mm.
_SHORT = 1e-5
# Cloth of at least so many cells, of at most so many along the body, is a level set; thinner cloth hardly cuts itself.
_CELLS_THROUGH, _MOST_CELLS = 2.5, 900
# Its steps of the grid are smoothed away within this share of a cell.
_STEPS = 0.1
# Rays that measure the walls.
_RAYS = 4000


@dataclass(frozen=True)
class SolidConfig:
    """Options of `solid_of_parts`; metres.

    Attributes:
        thickness: of the cloth; its outer side stays where it is.
        gap: cloth nearer to the body than this is filled down to it.
        cells: of thick cloth's grid along the body's largest side, at least.
        seed: of the places where walls are measured.
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
    """What a solid is, by measurement.

    Attributes:
        faces, vertices: of its surface.
        components: pieces of it; 1, or an error was raised.
        genus: handles of the surface, such as an arm akimbo or a strap.
        volume_cm3, area_cm2: of the solid.
        size_mm: along x, y and z.
        wall_mm_p1, wall_mm_p5, wall_mm_median: percentiles, over the area, of the way inward to the next wall.
        thin_share: share of the area where that way is shorter than nine tenths of the thickness asked for.
        dropped_pieces: crumbs outside, shells inside, and hollows that were filled.
        gap_mm: within which each part was filled down to the body, by name.
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
        """Plain numbers, for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Solid:
    """One closed, manifold surface of one piece, metres, and what it measures."""

    mesh: TriangleMesh
    report: SolidReport


def thickened(
    sheet: TriangleMesh,
    *,
    inward: float | Float[np.ndarray, " V"],
    outward: float | Float[np.ndarray, " V"] = 0.0,
) -> TriangleMesh:
    """A closed mesh between a sheet moved outward and inward along its vertices' normals; its borders become rims.

    In folds narrower than the thickness it cuts itself. Pieces that are closed already stay as they are.

    Args:
        sheet: manifold, every vertex used.
        inward, outward: metres, for all vertices or each.
    """
    component = face_components(sheet.faces)
    is_open = np.zeros(int(component.max()) + 1, dtype=bool)
    of_vertex = np.zeros(sheet.vertex_count, dtype=np.int64)
    of_vertex[sheet.faces] = component[:, None]
    loops = border_loops(sheet.faces)
    is_open[[of_vertex[loop[0]] for loop in loops]] = True
    moved = is_open[of_vertex]
    normals, count = np.where(moved[:, None], sheet.vertex_normals, 0.0), sheet.vertex_count
    outer = sheet.vertices + normals * np.broadcast_to(outward, count)[:, None]
    inner = sheet.vertices - normals * np.broadcast_to(inward, count)[:, None]
    faces = [sheet.faces, sheet.faces[is_open[component]][:, ::-1] + count]
    for loop in loops:
        following = np.roll(loop, -1)
        faces += [
            np.stack([following, loop, loop + count], axis=1),
            np.stack([following, loop + count, following + count], axis=1),
        ]
    whole = TriangleMesh(np.concatenate([outer, inner]), np.concatenate(faces))
    return whole.submesh(np.ones(whole.face_count, dtype=bool))[0]


def solid_of_parts(
    body: TriangleMesh, parts: Mapping[str, TriangleMesh], *, config: SolidConfig | None = None
) -> Solid:
    """One closed surface of body and parts, as a printer takes it.

    The body's openings are closed, each part becomes cloth of the thickness asked for, inward from where it is (thin
    cloth by `thickened`, cloth thicker than a 360th of the body by `slab_behind`); where the body lies within the gap
    below, the cloth is filled down to it. A part of which nothing touches the rest is filled from farther off, up to
    eight gaps. Hollows without an opening are filled, crumbs go.

    Args:
        body: manifold, outward; metres.
        parts: manifold sheets by name, outward.
        config: options.

    Raises:
        InputError: a body of several pieces, or parts that stay apart from it.
    """
    config = config or SolidConfig()
    pieces = [_body_solid(body)]
    if len(_apart(pieces[0], least=_CRUMB * pieces[0].volume())) > 1:
        raise InputError("body", expected="a body of one piece", received="pieces that do not touch")
    gaps = {}
    for name, part in parts.items():
        for wider in _WIDER:
            made = _cloth(part, body, config, wider * config.gap)
            union = manifold3d.Manifold.batch_boolean([*pieces, made], manifold3d.OpType.Add)
            apart = len(_apart(union, least=_CRUMB * made.volume()))
            if apart == 1:
                break
        else:
            raise InputError(
                f"part {name}",
                expected=f"a part that comes within {_WIDER[-1] * config.gap * 1e3:g} mm of the body in each piece",
                received=f"{apart} pieces",
                remedy="give a wider --gap-mm, or build again without the piece",
            )
        gaps[name] = wider * config.gap * 1e3
        pieces = [union]
    whole = pieces[0]
    # Files of printers have single precision: edges shorter than it tells apart go.
    largest = _largest(_largest(whole).simplify(_SHORT * _size(whole)))
    others = len(whole.decompose()) - 1
    if others:
        warnings.warn(
            f"solid: {others} crumbs of the union and shells inside it are left out", GeometryWarning, stacklevel=2
        )
    return Solid(touching_apart(mesh_of_solid(largest)), _measured(largest, config, others, gaps))


def touching_apart(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with vertices that lie together drawn inward, each to its own side.

    A solid may touch itself in a vertex or an edge; a file of triangles alone, as STL is, would join it there. Those
    that look the same way stay together then, and are drawn to the middles of their own fans.
    """
    size = _SHORT * float(np.ptp(mesh.vertices, axis=0).max())
    pairs = cKDTree(mesh.vertices).query_pairs(size, output_type="ndarray")
    vertices, moved = mesh.vertices.copy(), np.unique(pairs)
    vertices[moved] -= 2 * size * mesh.vertex_normals[moved]
    still = pairs[np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1) < size]
    for k in np.unique(still):
        way = mesh.vertices[np.unique(mesh.faces[(mesh.faces == k).any(axis=1)])].mean(axis=0) - mesh.vertices[k]
        vertices[k] += 2 * size * way / max(float(np.linalg.norm(way)), 1e-12)
    return mesh.with_vertices(vertices)


def _body_solid(body: TriangleMesh) -> manifold3d.Manifold:
    """The union of the body's pieces, openings closed; those that are inside out or enclose nothing are left out."""
    component = face_components(body.faces)
    solids = []
    for k in range(int(component.max()) + 1):
        piece = solid_of_mesh(closed_mesh(body.submesh(component == k)[0]), subject="body")
        if piece.volume() > 0:
            solids.append(piece)
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def _cloth(part: TriangleMesh, body: TriangleMesh, config: SolidConfig, gap: float) -> manifold3d.Manifold:
    """A part as cloth, filled down to the body where that is near."""
    above = SignedDistanceField(body, solid=True).query(part.vertices).distance
    depth = np.where(above < gap, np.maximum(above, 0.0) + config.thickness, config.thickness)
    edges = part.edges
    both = np.concatenate([edges, edges[:, ::-1]])
    neighbours = np.maximum(np.bincount(both[:, 0], minlength=part.vertex_count), 1)
    smooth = depth
    for _ in range(_SMOOTHING):
        mean = np.bincount(both[:, 0], smooth[both[:, 1]], minlength=part.vertex_count) / neighbours
        smooth = np.maximum(0.5 * (smooth + mean), depth)
    size = float(np.ptp(body.vertices, axis=0).max())
    cell = min(config.thickness / _CELLS_THROUGH, size / config.cells)
    # A part filled down over a wide gap is mostly within the body: nobody sees that it cuts itself there.
    thick = config.thickness / _CELLS_THROUGH >= size / _MOST_CELLS and np.ptp(smooth) <= 2 * config.thickness
    component, solids = face_components(part.faces), []
    for k in range(int(component.max()) + 1):
        sheet, source = part.submesh(component == k)
        if thick and len(sheet.border_edges):
            slab = solid_of_mesh(slab_behind(sheet, smooth[source], cell=cell), subject="cloth")
            solids.append(slab.simplify(_STEPS * cell))
        else:
            solids.append(solid_of_mesh(thickened(sheet, inward=smooth[source]), subject="cloth"))
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def _apart(solid: manifold3d.Manifold, *, least: float) -> list[manifold3d.Manifold]:
    """The pieces of at least a volume that lie outside the largest, which comes first.

    Cloth that cuts itself leaves shells inside the solid, which enclose what is full already.
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
    """The longest side of the bounding box."""
    box = solid.bounding_box()
    return max(high - low for low, high in zip(box[:3], box[3:], strict=True))


def _measured(solid: manifold3d.Manifold, config: SolidConfig, dropped: int, gaps: dict[str, float]) -> SolidReport:
    mesh = mesh_of_solid(solid)
    walls = wall_thickness(mesh, solid=solid, seed=config.seed) * 1e3
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
    mesh: TriangleMesh, *, solid: manifold3d.Manifold | None = None, seed: int = 0
) -> Float[np.ndarray, " n"]:
    """The way from places on a closed surface, drawn by area, straight inward to the outside; metres.

    Walls within the solid, where it cuts itself, do not count: a slicer does not see them.
    """
    solid = solid_of_mesh(mesh) if solid is None else solid
    rng = np.random.default_rng(seed)
    face = rng.choice(mesh.face_count, _RAYS, p=mesh.face_areas / mesh.face_areas.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), _RAYS)
    points = np.einsum("nk,nkd->nd", weights, mesh.triangles[face])
    reach = mesh.bbox_diagonal
    begin = 1e-7 * reach  # off the surface
    starts = points - begin * mesh.face_normals[face]
    ends = points - reach * mesh.face_normals[face]
    out = np.zeros(_RAYS)
    for k, (start, end) in enumerate(zip(starts, ends, strict=True)):
        depth = 1  # surfaces that the ray is within
        for hit in solid.ray_cast(start, end):
            depth += -1 if np.dot(hit.normal, end - start) > 0 else 1
            if depth == 0:
                out[k] = hit.distance * (reach - begin) + begin
                break
    return out
