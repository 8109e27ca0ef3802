"""Paint a template's pictures with the colours of its scan, and with the scan's finer normals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from smplxpp.core import SKIN, TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.mesh_files.raw_mesh import FacePictures
from smplxpp.core.signed_distance import barycentric_coordinates
from smplxpp.template.template import BODY_PART, Template
from smplxpp.template.texture import Texture, corner_tangents, encode_texture
from smplxpp.texture.atlas import Atlas, Texels, can_unwrap, texels_of, unwrap
from smplxpp.texture.painted_scan import LabelledSurface, PaintedScan
from smplxpp.texture.photographs import Painter

# Metres. A template lies within 1 mm of its scan except where holes were filled and layers pushed apart, its body
# within 15 mm where skin shows (`smplxpp.assemble.body_inside` draws the same line).
_FAR = 0.015
# Rounds in which the colours that were carried under clothes become smooth, a vertex's with those of its neighbours.
_ROUNDS = 40
# Texels a side of the squares within which empty texels take colours: 32 mm of the surface at 2048.
_SQUARE = 32


@dataclass(frozen=True)
class BakeReport:
    """What was painted.

    Attributes:
        texels: that lie on the template, of all pictures.
        seen: share of them whose colour is the scan's.
        by_part: the same share, by part.
    """

    texels: int
    seen: float
    by_part: dict[str, float]


def bake(
    template: Template,
    posed: Float64[np.ndarray, "V 3"],
    atlas: Atlas,
    scan: PaintedScan,
    *,
    size: int,
    paint: Painter | None = None,
    fixed: Bool[np.ndarray, " V"] | None = None,
    normals: bool = True,
) -> tuple[Texture, BakeReport]:
    """Paint the pictures of a template.

    A texel takes the colour of the nearest point of the scan that has its part's label (skin for the body), in the
    scan's pose. Texels that the scan does not show take the colours of the nearest ones on the surface that it does:
    skin under clothes that of the nearest bare skin.

    Args:
        template: body and parts in the T-pose.
        posed: its vertices in the scan's pose, metres.
        atlas: where its faces lie.
        scan: in its pose.
        size: texels a side of each picture.
        paint: returns the colours of points of the scan, given as faces and barycentric coordinates. None: the scan's.
        fixed: vertices that keep their own colour, with the faces between them: the inside of the mouth.
        normals: paint normals, too.

    Example:
        >>> texture, report = bake(template, template.pose(params)[0], atlas, scan, size=2048)  # doctest: +SKIP
    """
    fixed = np.zeros(template.vertex_count, dtype=bool) if fixed is None else fixed
    work = _Bake(template, TriangleMesh(posed, template.faces), atlas, scan, paint or scan.colors_at, fixed)
    colors, reliefs = [], []
    for picture in range(int(atlas.picture.max()) + 1):
        color, relief = work.picture(picture, size, normals=normals)
        colors.append(color)
        reliefs.append(relief)
    jpegs, pngs = encode_texture(colors, [relief for relief in reliefs if relief is not None])
    made = Texture(uv=atlas.uv, face_uv=atlas.face_uv, picture=atlas.picture, colors=jpegs, normals=pngs)
    total = np.maximum(work.texels, 1)
    shares = {name: float(share) for name, share in zip(template.part_names, work.seen / total, strict=True)}
    return made, BakeReport(int(work.texels.sum()), float(work.seen.sum() / max(int(work.texels.sum()), 1)), shares)


def repainted(level: Template, source: Template, *, size: int) -> Template:
    """Return a coarser level of a template with a texture of its own, painted from its source's.

    Args:
        level: the level in the T-pose; without a texture.
        source: what it is a level of; without a texture the level stays as it is, and so it does without xatlas.
        size: texels a side.
    """
    texture = source.texture
    if texture is None or not can_unwrap():
        return level
    pictures = FacePictures(
        texture.uv[texture.face_uv].astype(np.float32),
        texture.picture[source.vertex_part[source.faces[:, 0]]],
        tuple(partial(texture.color_image, k) for k in range(len(texture.colors))),
        (("clamp", "clamp"),) * len(texture.colors),
    )
    labels = source.vertex_labels[source.faces[:, 0]]
    scan = PaintedScan(source.mesh, source.vertex_colors, labels, pictures)
    atlas = unwrap(level, None, layout="one" if len(texture.colors) == 1 else "part")
    made, _ = bake(level, level.vertices, atlas, scan, size=size, normals=bool(texture.normals))
    return replace(level, texture=made)


class _Bake:
    """One running bake: the surfaces that colours come from, and how many texels of each part they reached."""

    def __init__(
        self,
        template: Template,
        posed: TriangleMesh,
        atlas: Atlas,
        scan: PaintedScan,
        paint: Painter,
        fixed: Bool[np.ndarray, " V"],
    ) -> None:
        self.template, self.posed, self.atlas = template, posed, atlas
        self.scan, self.paint, self.fixed = scan, paint, fixed
        self.part_of_face = template.vertex_part[template.faces[:, 0]]
        self.surfaces: list[LabelledSurface | None] = []
        for index in range(len(template.part_names)):
            labels = template.vertex_labels[template.vertex_part == index]
            self.surfaces.append(scan.labelled(int(np.bincount(labels).argmax()) if len(labels) else SKIN.id))
        self.corner_normals = posed.vertex_normals[posed.faces]
        # Metres a texel of a picture of one texel: the root of area by flat area.
        flat = TriangleMesh(np.pad(atlas.uv, ((0, 0), (0, 1))), atlas.face_uv)
        self.spread = float(np.sqrt(posed.face_areas.sum() / max(flat.face_areas.sum(), 1e-12)))
        self.texel = np.inf
        self.reached = self._reached()
        self.texels = np.zeros(len(template.part_names), np.int64)
        self.seen = np.zeros(len(template.part_names), np.int64)

    def picture(
        self, picture: int, size: int, *, normals: bool
    ) -> tuple[UInt8[np.ndarray, "S S 3"], UInt8[np.ndarray, "S S 3"] | None]:
        """Paint one picture: its colours, and its normals where they are asked for."""
        faces = (self.atlas.picture == picture)[self.part_of_face]
        self.texel = self.spread / size
        color = np.zeros((size, size, 3), np.uint8)
        known = np.zeros((size, size), dtype=bool)
        relief = np.full((size, size, 3), (128, 128, 255), np.uint8) if normals else None
        tangents = corner_tangents(self.posed, self.atlas.uv, self.atlas.face_uv) if normals else None
        # Sums of what is seen in each face, for the colours of what is not.
        count, sums = np.zeros(len(faces), np.int64), np.zeros((len(faces), 3))
        for texels in texels_of(self.atlas, faces, size):
            for index in np.unique(self.part_of_face[texels.face]):
                mine = texels.select(self.part_of_face[texels.face] == index)
                self.texels[index] += len(mine.row)
                shown, place, barycentric = self._shown(mine, int(index))
                mine = mine.select(shown)
                self.seen[index] += len(mine.row)
                found = self.paint(place, barycentric)
                color[mine.row, mine.column], known[mine.row, mine.column] = found, True
                surface = self.surfaces[index]
                assert surface is not None
                firm = surface.inner[place]
                count += np.bincount(mine.face[firm], minlength=len(count))
                for c in range(3):
                    sums[:, c] += np.bincount(mine.face[firm], found[firm, c], len(count))
                if relief is not None and tangents is not None and index:
                    relief[mine.row, mine.column] = self._relief(mine, tangents, place, barycentric)
        # Second pass: what nothing has shown, between the colours of its face's vertices.
        own = self._vertex_colors(faces, count, sums)
        for texels in texels_of(self.atlas, faces, size):
            hidden = texels.select(~known[texels.row, texels.column])
            color[hidden.row, hidden.column] = np.rint(hidden.interpolate(own[self.template.faces])).astype(np.uint8)
            known[hidden.row, hidden.column] = True
        _pad(color, known)
        return color, relief

    def _shown(self, texels: Texels, part: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the scan's points that texels of a part show: which texels have one, its face and its place there."""
        # Metres beyond the rim of a label up to which its outermost colours are drawn out; farther in they
        # would be streaks.
        beyond_rim = 0.004
        surface = self.surfaces[part]
        shown = self.reached[texels.face]
        if surface is None or not shown.any():
            return np.zeros(len(shown), dtype=bool), np.zeros(0, np.int64), np.zeros((0, 3))
        tried = texels.select(shown)
        distance, face, barycentric, rim = self._nearest(tried, surface)
        near = distance <= np.where(rim, beyond_rim, _FAR)
        if self.template.part_names[part] == BODY_PART:
            # The body closes where the scan's skin has two sides, as between fingers: only what faces alike is meant.
            facing = np.einsum("td,td->t", tried.interpolate(self.corner_normals), self.scan.mesh.face_normals[face])
            near &= facing > 0
        shown[shown] = near
        return shown, face[near], barycentric[near]

    def _nearest(
        self, texels: Texels, surface: LabelledSurface
    ) -> tuple[Float64[np.ndarray, " T"], np.ndarray, Float64[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
        """Find the points of a surface nearest to texels, as `LabelledSurface.nearest`.

        Where texels are fine against the scan's faces, a search for one of four finds the face, onto whose plane the
        other three are projected: they may miss a neighbouring face by half a texel, in half the time.
        """
        fine = 4  # texels along an edge of the scan
        points = texels.interpolate(self.posed.triangles)
        if self.texel * fine > surface.edge:
            return surface.nearest(points)
        # The first texel of each square of two by two is searched for, and those of squares whose first is elsewhere.
        top, left = (texels.row // 2).min(), (texels.column // 2).min()
        square = texels.row // 2 - top, texels.column // 2 - left
        first = np.flatnonzero((texels.row % 2 == 0) & (texels.column % 2 == 0))
        of_square = np.full((square[0].max() + 1, square[1].max() + 1), -1)
        of_square[square[0][first], square[1][first]] = np.arange(len(first))
        found = of_square[square]
        alone = np.flatnonzero(found < 0)
        found[alone] = len(first) + np.arange(len(alone))
        searched = np.concatenate([first, alone])
        _, face, _, rim = (part[found] for part in surface.nearest(points[searched]))
        triangles = self.scan.mesh.triangles[face]
        barycentric = np.clip(barycentric_coordinates(points, triangles), 0.0, None)
        barycentric /= barycentric.sum(axis=1, keepdims=True)
        away = points - np.einsum("tk,tkd->td", barycentric, triangles)
        return row_lengths(away), face, barycentric, rim

    def _reached(self) -> Bool[np.ndarray, " F"]:
        """Tell which faces the scan may show: not those between fixed vertices, nor those far from their label."""
        faces, vertices = self.template.faces, self.posed.vertices
        distance = np.full(len(vertices), np.inf)
        for index, surface in enumerate(self.surfaces):
            rows = self.template.vertex_part == index
            if surface is not None and rows.any():
                distance[rows] = surface.nearest(vertices[rows])[0]
        # No point of a face is nearer to the scan than its nearest corner is by more than the face's longest edge.
        edge = row_lengths((self.posed.triangles - np.roll(self.posed.triangles, 1, axis=1)).reshape(-1, 3))
        near = distance[faces].min(axis=1) <= _FAR + edge.reshape(-1, 3).max(axis=1)
        return near & ~self.fixed[faces].all(axis=1)

    def _relief(
        self, texels: Texels, tangents: np.ndarray, place: np.ndarray, barycentric: np.ndarray
    ) -> UInt8[np.ndarray, "T 3"]:
        """Return the scan's normals in the tangent space that the template's corners span, as bytes."""
        theirs = np.einsum("tk,tkd->td", barycentric, self.scan.mesh.vertex_normals[self.scan.mesh.faces[place]])
        normal = normalize_rows(texels.interpolate(self.corner_normals))
        tangent = texels.interpolate(tangents[..., :3])
        tangent = normalize_rows(tangent - np.einsum("td,td->t", tangent, normal)[:, None] * normal)
        bitangent = np.cross(normal, tangent) * tangents[texels.face, 0, 3:]
        local = np.stack([np.einsum("td,td->t", theirs, axis) for axis in (tangent, bitangent, normal)], axis=1)
        # A scan's normal may point away from a sheet's other side; the relief stays on this one.
        local[local[:, 2] < 0] *= -1
        return np.rint(127.5 * normalize_rows(local) + 127.5).astype(np.uint8)

    def _vertex_colors(self, faces: np.ndarray, count: np.ndarray, sums: np.ndarray) -> Float64[np.ndarray, "V 3"]:
        """Return the mean colour of what is seen about each vertex; the others take those of the nearest that have one.

        Nearest along the edges of the part, so that colours do not cross from one limb to another; then the carried
        colours are averaged with their neighbours until no borders between them are left.
        """
        template, corners = self.template, self.template.faces
        total, own = np.zeros(template.vertex_count), np.zeros((template.vertex_count, 3))
        for k in range(3):
            total += np.bincount(corners[:, k], count, template.vertex_count)
            for c in range(3):
                own[:, c] += np.bincount(corners[:, k], sums[:, c], template.vertex_count)
        seen = (total > 0) & ~self.fixed
        own = np.where(seen[:, None], own / np.maximum(total, 1.0)[:, None], template.vertex_colors)
        edges = template.mesh.edges
        edges = edges[~self.fixed[edges].any(axis=1)]
        if not seen.any() or not len(edges):
            return own
        length = np.linalg.norm(template.vertices[edges[:, 0]] - template.vertices[edges[:, 1]], axis=1)
        shape = (template.vertex_count, template.vertex_count)
        graph = sparse.csr_array((np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), shape=shape)
        distance, _, source = dijkstra(
            graph, directed=False, indices=np.flatnonzero(seen), min_only=True, return_predecessors=True
        )
        # Vertices that no edges join to any that is seen, such as the eyeballs', keep their own colours.
        carried = np.isfinite(distance) & ~seen
        own[carried] = own[source[carried]]
        ones = np.ones(len(edges))
        neighbours = sparse.csr_array((ones, (edges[:, 0], edges[:, 1])), shape=shape)
        neighbours = neighbours + neighbours.T
        degree = np.maximum(neighbours.sum(axis=1), 1.0)[:, None]
        for _ in range(_ROUNDS):
            own[carried] = ((neighbours @ own) / degree)[carried]
        return own


def _pad(color: UInt8[np.ndarray, "S S 3"], known: Bool[np.ndarray, "S S"]) -> None:
    """Fill texels that no face covers with the mean of those nearby, which filtering and smaller pictures blend in.

    Squares of 2, 4, ... `_SQUARE` texels give their mean to what is empty in them, so that charts grow by the texels
    that bilinear filtering and coarser levels of a viewer's pyramid reach.
    """
    size = len(color)
    average = color[known].mean(axis=0) if known.any() else np.zeros(3)
    for top in range(0, size, 4 * _SQUARE):
        rows = slice(top, top + 4 * _SQUARE)
        own, here = color[rows], known[rows]
        sums = own * here[..., None].astype(np.float32)
        weight = here.astype(np.float32)
        levels: list[tuple[np.ndarray, np.ndarray]] = []
        while len(levels) < int(np.log2(_SQUARE)):
            sums, weight = _halved(sums), _halved(weight)
            levels.append((sums, weight))
        # From the coarsest square down, each finer one overwrites where it knows anything.
        filled = np.empty((*weight.shape, 3), np.float32)
        filled[:] = average
        for sums, weight in reversed(levels):
            if sums.shape != filled.shape:
                filled = filled.repeat(2, axis=0).repeat(2, axis=1)
            has = weight > 0
            filled[has] = sums[has] / weight[has][:, None]
        filled = filled.repeat(2, axis=0).repeat(2, axis=1)
        own[~here] = np.rint(filled[~here]).astype(np.uint8)


def _halved(x: np.ndarray) -> np.ndarray:
    return x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]
