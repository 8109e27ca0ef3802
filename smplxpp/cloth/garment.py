"""A template's loose part as something to simulate: particles, what holds them, what they touch, what they carry."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from scipy.spatial import cKDTree

from smplxpp.cloth.cloth_mesh import (
    SHORTEST_OPENING,
    coarsen,
    find_opening_bridges,
    geodesics,
    largest_piece,
    lengths_along,
    looks_inwards,
    loop_length,
    opening_axis,
    turned_over,
)
from smplxpp.cloth.collider import ColliderMesh, collider_of, head_skin
from smplxpp.cloth.embedding import Embedding, embed
from smplxpp.cloth.model import ClothModel, Fabric, build_model
from smplxpp.core import BodyParams, TriangleMesh, require_at_least, require_choice, require_positive
from smplxpp.core.errors import GeometryWarning, InputError, one_line
from smplxpp.core.labels import HAIR
from smplxpp.core.mesh import normalize_rows, row_lengths
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import border_loops, component_labels
from smplxpp.template.template import BODY_PART, Template

# Metres from the skin up to which cloth is tight; a neckline or a cuff that holds lies within, a wide one does not.
TIGHT = 0.012
# Metres from the skin up to which an opening that looks up is held: under a shirt that falls over it there is the
# waistband that no scan shows.
WORN = 0.05
# Cosine to the vertical from which an opening looks up, and from which cloth that touches the body lies on it.
UP, LIES = 0.5, 0.5


def find_carriers(
    cloth: TriangleMesh, body: TriangleMesh, head: Bool[np.ndarray, " V"] | None = None
) -> Bool[np.ndarray, " N"]:
    """Find the vertices of a garment that hold it, in the pose it was scanned in, +Y up.

    A garment hangs on its upper openings, a waistband or a neckline, on tight ones, and on what it covers from above,
    shoulders and the crown. A hem is an opening too, but looks down and is not tight; the median of an opening's
    distances decides. The single border of a flat piece, a tie or an apron, is no opening: where nothing else holds it,
    its upper half does, as far as it is tight or looks up and is near, and so does that of a garment that is torn from
    one opening to another. Where there is no such border either, the underside of a roll, as of a scarf, holds it on
    skin that looks up.

    Args:
        cloth: N vertices, without bridges.
        body: the naked body in the same pose, closed or nearly.
        head: of hair: which vertices of the body are the head's, where hair grows, scalp and chin. It hangs from what
            is tight there and from nothing else: on shoulders it lies, and slides. None: cloth.
    """
    # Signed distance to the body, metres; unreferenced vertices stay infinitely far.
    distance = np.full(cloth.vertex_count, np.inf)
    used = cloth.referenced
    found = SignedDistanceField(body, solid=True).query(cloth.vertices[used])
    distance[used] = found.distance
    if head is not None:
        skin = body.referenced
        grows = head[skin][cKDTree(body.vertices[skin]).query(cloth.vertices)[1]]
        tight = grows & (distance < TIGHT)
        return tight if tight.any() else grows & (distance < WORN)
    # Cloth that lies on the body from above, with a normal that looks up, is held by it; one vertex is no cloth.
    lies = (distance < TIGHT) & (cloth.vertex_normals[:, 1] > LIES)
    out = np.zeros(cloth.vertex_count, dtype=bool)
    out[cloth.faces[lies[cloth.faces].all(axis=1)]] = True
    loops = [loop for loop in border_loops(cloth.faces) if loop_length(cloth, loop) >= SHORTEST_OPENING]
    # The only border of a flat piece goes about it, a tie's or an apron's, and is no opening.
    for loop in loops if len(loops) > 1 or not _is_sheet(cloth) else []:
        # An opening that looks up is worn and may stand off farther; any other one holds only where it is tight.
        reach = WORN if opening_axis(cloth, loop)[1] > UP else TIGHT
        if float(np.median(distance[loop])) < reach:
            out[loop] = True
    # Nothing holds it and there is a border: what is torn from opening to opening, or tied, hangs on its upper half.
    if not out.any() and len(border := np.unique(cloth.border_edges)):
        height = cloth.vertices[:, 1]
        middle = 0.5 * (height[used].min() + height[used].max())
        near = np.where(_border_looks_up(cloth), WORN, TIGHT)
        out[border] = (distance[border] < near[border]) & (height[border] > middle)
    # A roll about the neck has an underside, which faces the shoulders and lies there; a sheet faces as its skin does.
    if not out.any():
        facing = np.einsum("ni,ni->n", cloth.vertex_normals[used], found.normal)
        lies[used] = (found.distance < TIGHT) & (found.normal[:, 1] > LIES) & (facing < -LIES)
        out[cloth.faces[lies[cloth.faces].all(axis=1)]] = True
    return out


def _is_sheet(cloth: TriangleMesh) -> bool:
    """Return whether cloth is one flat piece without holes: of Euler's characteristic 1, as a disc is."""
    return len(cloth.referenced) - len(cloth.edges) + cloth.face_count == 1


def _border_looks_up(cloth: TriangleMesh) -> Bool[np.ndarray, " N"]:
    """Return the vertices of border edges from which the cloth goes down."""
    faces = cloth.faces
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    _, index, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    at = np.flatnonzero(count[index.ravel()] == 1)
    a, b = (cloth.vertices[edges[at, k]] for k in (0, 1))
    # Away from the third corner, across the edge.
    across = a - cloth.vertices[np.roll(faces, -2, axis=1).ravel()[at]]
    along = normalize_rows(b - a)
    across = normalize_rows(across - np.einsum("ij,ij->i", across, along)[:, None] * along)
    out = np.zeros(cloth.vertex_count, dtype=bool)
    out[edges[at[across[:, 1] > UP]]] = True
    return out


@dataclass(frozen=True, kw_only=True)
class GarmentConfig:
    """Options of cutting a garment from a template.

    Attributes:
        spacing: of its particles, metres.
        collider_spacing: of the collider's vertices, about as fine as a body's own; wider triangles cut into round
            limbs, whose skin shows through drawn cloth.
        pin_depth: metres along the cloth from where the body carries it up to which it follows the body exactly.
        band: width, in metres, of the transition from skinning to simulation next to the pins.
        skin_margin, sheet_margin: metres that cloth keeps from the skin and from other clothes.
        fabric: material.
    """

    spacing: float = 0.03
    collider_spacing: float = 0.02
    pin_depth: float = 0.03
    band: float = 0.03
    skin_margin: float = 0.006
    sheet_margin: float = 0.003
    fabric: Fabric = field(default_factory=Fabric)

    def __post_init__(self) -> None:
        for name in ("spacing", "collider_spacing", "pin_depth", "band"):
            require_positive(f"garment: {name}", getattr(self, name))
        for name in ("skin_margin", "sheet_margin"):
            require_at_least(f"garment: {name}", getattr(self, name), 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Garment:
    """A part of a template over n particles, carrying N of the template's vertices.

    Attributes:
        part: its name in the template.
        config: choices.
        reference: one frame, the pose that it was scanned in; its shape there is its shape at rest.
        particles: vertices of the template that the particles are.
        rest: the simulated mesh in the reference pose, metres.
        lengths: of `rest.edges`, along the cloth, metres.
        depth: of particles along the cloth from what the body carries, metres; inf without a path.
        vertices: of the template that it carries.
        vertex_depth: theirs.
        embedding: theirs.
        collider: what it may touch.
    """

    part: str
    config: GarmentConfig
    reference: BodyParams
    particles: Int64[np.ndarray, " n"]
    rest: TriangleMesh
    lengths: Float[np.ndarray, " e"]
    depth: Float[np.ndarray, " n"]
    vertices: Int64[np.ndarray, " N"]
    vertex_depth: Float[np.ndarray, " N"]
    embedding: Embedding
    collider: ColliderMesh

    __repr__ = one_line

    @property
    def pinned(self) -> Bool[np.ndarray, " n"]:
        """The particles that follow the body exactly: within the pin depth, at least the nearest ones of each piece."""
        piece = _pieces(self.rest)
        least = np.full(piece.max(initial=-1) + 1, np.inf)
        np.minimum.at(least, piece, self.depth)
        return self.depth <= np.maximum(self.config.pin_depth, least[piece])

    def model(self) -> ClothModel:
        """Return the solver's constraints."""
        return build_model(self.rest, self.pinned * 1.0, self.config.fabric, lengths=self.lengths)

    def share(self) -> Float32[np.ndarray, " N"]:
        """Return how much of each vertex's displacement is the simulation's: 0 at the pins, 1 outside of the band."""
        t = np.clip((self.vertex_depth - self.config.pin_depth) / self.config.band, 0.0, 1.0)
        return np.where(np.isfinite(self.vertex_depth), t * t * (3.0 - 2.0 * t), 0.0).astype(np.float32)

    def with_vertices_at(self, place: Int64[np.ndarray, " V"]) -> Garment:
        """Return the garment over other vertices: `place` says where each of the template's is, -1 where it is no more.

        Particles and collider must be there still; of what the garment carries, what is left is.
        """
        kept = np.flatnonzero(place[self.vertices] >= 0)
        own = self.embedding
        return replace(
            self,
            particles=place[self.particles],
            vertices=place[self.vertices[kept]],
            vertex_depth=self.vertex_depth[kept],
            embedding=Embedding(own.corners[kept], own.weights[kept], own.offset[kept]),
            collider=replace(self.collider, vertices=place[self.collider.vertices]),
        )

    def with_config(self, config: GarmentConfig) -> Garment:
        """Return the garment with another material or pin depth; spacings stay what they were cut with."""
        return replace(self, config=config)


def usual_config(template: Template, part: str) -> GarmentConfig:
    """Return the options that a part is cut with where none are given: those of woven cloth, or of hair.

    A hundred thousand hairs of 30 cm at 5.5 mg a metre weigh 160 g, over the 0.15 m^2 of such hair some 1 kg a square
    metre, five times as much as cloth: air slows them less. A layer of strands is centimetres thick and keeps its
    curve, where cloth folds, and strands that rub against each other soon move alike.
    """
    if template.label_of(part).kind != HAIR.name:
        return GarmentConfig()
    return GarmentConfig(
        fabric=Fabric(
            density=1.0,
            compression=0.16,
            bend_stiffness=1e-4,
            drag=1.2,
            normal_drag=0.4,
            inner_friction=4.0,
            friction=0.3,
        )
    )


def cut_garment(template: Template, part: str, reference: BodyParams, config: GarmentConfig | None = None) -> Garment:
    """Make a part of a template ready to be simulated.

    Args:
        part: its name.
        reference: one frame: the pose in which the template's surface is the scan's.
        config: how it is cut and what it is made of; None: `usual_config`.

    Raises:
        InputError: no such part, the body itself, a part without area, or one that nothing carries.
    """
    require_choice("loose part", part, [name for name in template.part_names if name != BODY_PART])
    config = config or usual_config(template, part)
    # The garment at rest is the scan's: the template in the pose of the scan, not in the T-pose.
    posed = TriangleMesh(template.pose(reference)[0], template.faces)
    cloth, index = posed.submesh(template.part_faces(part))
    body = TriangleMesh(posed.vertices, template.faces[template.part_faces(BODY_PART)])
    if cloth.face_count and looks_inwards(cloth, body):
        warnings.warn(f"{part}: its faces look inwards; it is simulated turned over", GeometryWarning, stacklevel=2)
        cloth = turned_over(cloth)
    # The simulated sheet is the largest piece without bridges, which would tie its openings together.
    kept = largest_piece(cloth, ~find_opening_bridges(template)[template.part_faces(part)])
    if not cloth.face_areas[kept].sum() > 0:
        raise InputError(f"loose part {part!r}", expected="a surface with area", received="none beside bridges")
    sheet, of_cloth = cloth.submesh(kept)
    hair = template.label_of(part).kind == HAIR.name
    carriers = np.flatnonzero(find_carriers(sheet, body, head_skin(template) if hair else None))
    if not len(carriers):
        raise InputError(
            f"loose part {part!r}",
            expected="cloth that is tight at an opening or lies on the body, to hang from",
            received="none in the pose of the scan",
            remedy="leave the part to skinning (--cloth field or skin), or name other parts",
        )
    # Geodesic distance to what holds the cloth, metres: the deeper a vertex hangs, the freer it is.
    depth = geodesics(sheet, carriers)[0]
    # Particles are fewer than vertices; every vertex rides on a triangle of particles.
    seeds, faces = coarsen(sheet, config.spacing)
    rest, of_seeds = TriangleMesh(sheet.vertices[seeds], faces).submesh(_held(seeds, faces, depth, config))
    seeds = seeds[of_seeds]
    # Vertices of the bridge ride on the nearest triangle; how deep they hang is what the nearest particle says.
    all_depth = np.full(cloth.vertex_count, np.inf)
    all_depth[of_cloth] = depth
    if not rest.face_count:
        raise InputError(
            f"loose part {part!r}", expected="a piece of cloth that hangs from the body", received="shreds"
        )
    place = np.full(cloth.vertex_count, -1)
    place[of_cloth[seeds]] = np.arange(len(seeds))
    source = geodesics(cloth, of_cloth[seeds])[1]
    embedding = embed(cloth.vertices, rest, cell=np.where(source >= 0, place[source], -1))
    nearest = depth[seeds][embedding.corners[np.arange(cloth.vertex_count), embedding.weights.argmax(axis=1)]]
    all_depth = np.where(np.isfinite(all_depth), all_depth, nearest)
    all_depth[_far_pieces(cloth, embedding, source)] = 0.0
    return Garment(
        part=part,
        config=config,
        reference=reference,
        particles=index[of_cloth[seeds]],
        rest=rest,
        lengths=lengths_along(sheet, seeds[rest.edges]),
        depth=depth[seeds],
        vertices=index,
        vertex_depth=all_depth,
        embedding=embedding,
        collider=collider_of(template, part, posed, config, hangs=float(depth[seeds].max())),
    )


def _held(
    seeds: Int64[np.ndarray, " n"],
    faces: Int64[np.ndarray, "m 3"],
    depth: Float[np.ndarray, " N"],
    config: GarmentConfig,
) -> Bool[np.ndarray, " m"]:
    """The coarse faces of pieces that what carries the cloth reaches.

    Narrow bridges of the fine mesh may have no triangle in the coarse one; what hung on them would fall.
    """
    piece = component_labels(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]), len(seeds))
    least = np.full(piece.max(initial=-1) + 1, np.inf)
    np.minimum.at(least, piece, depth[seeds])
    return least[piece[faces[:, 0]]] <= config.spacing


def _far_pieces(cloth: TriangleMesh, embedding: Embedding, source: Int64[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """The vertices of pieces of their own that reach away from the simulated one: skinning moves them.

    On its nearest triangle such a piece, the end of a scarf beside its roll, would swing like a flag on a pole.
    """
    # Metres from the triangle that carries a vertex: shreds and buttons lie within, and ride along.
    beside = 0.03
    piece = _pieces(cloth)
    off = np.where(source < 0, row_lengths(embedding.offset), 0.0)
    most = np.zeros(piece.max(initial=-1) + 1)
    np.maximum.at(most, piece, off)
    return most[piece] > beside


def _pieces(mesh: TriangleMesh) -> Int64[np.ndarray, " n"]:
    return component_labels(mesh.edges, mesh.vertex_count)
