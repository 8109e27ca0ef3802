"""Render one frame for a camera: image, antialiased mask, labels and normals; and a texture atlas for speed."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import igl
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8

from smplxpp.core import Camera, TriangleMesh
from smplxpp.core.colors import linear_from_srgb, srgb8_from_linear
from smplxpp.people.fixture_person import PART_NAMES, Person
from smplxpp.raster import MeshMaps, rasterize_mesh
from smplxpp.raster.soft_light import bounced


@dataclass(frozen=True, eq=False)
class Atlas:
    """A texture atlas: M faces, each cut into n^2 congruent triangular cells with the colour at their centres.

    Attributes:
        divisions: n of each face.
        first: index of each face's first cell.
        color: sRGB of all cells.
    """

    divisions: Int[np.ndarray, " M"]
    first: Int[np.ndarray, " M"]
    color: UInt8[np.ndarray, "C 3"]

    def colors(self, face: Int[np.ndarray, " P"], barycentric: Float[np.ndarray, "P 3"]) -> UInt8[np.ndarray, "P 3"]:
        """Return the colours of the cells that hold points on faces."""
        n = self.divisions[face]
        row, column, rest = (np.clip((n * barycentric[:, k]).astype(np.int32), 0, n - 1) for k in range(3))
        # Rounding may put a point behind the end of its row.
        column = np.minimum(column, n - 1 - row)
        inverted = (row + column + rest < n - 1) & (row + column < n - 1)
        # Row i has 2 (n - i) - 1 cells, upright and inverted ones alternating.
        return self.color[self.first[face] + row * (2 * n - row) + 2 * column + inverted]


@dataclass(frozen=True, eq=False)
class LitFrame:
    """One lit frame of the person, ready to be rendered.

    Attributes:
        mesh: vertices of all layers with the faces that are shown.
        face: index of each shown face among the person's.
        light: irradiance of the outer and the inner side, from `vertex_light`.
        environment: irradiance from `environment_light` that replaces `light`; None: `light` stays.
    """

    mesh: TriangleMesh
    face: Int[np.ndarray, " M"]
    light: Float[np.ndarray, "2 V"]
    environment: Float[np.ndarray, "2 V 3"] | None = None


@dataclass(frozen=True, eq=False)
class RenderedView:
    """The rendered pixels of one camera.

    Attributes:
        image: sRGB on black, premultiplied by opacity.
        mask: opacity, 0 to 255.
        labels: index into `LABEL_NAMES` of each pixel.
    """

    image: UInt8[np.ndarray, "H W 3"]
    mask: UInt8[np.ndarray, "H W"]
    labels: UInt8[np.ndarray, "H W"]


def hidden_faces(person: Person, vertices: Float[np.ndarray, "V 3"]) -> Bool[np.ndarray, " M"]:
    """Return which faces of skin lie well inside a garment in one frame.

    They are not rendered, so that none shows through thin cloth.
    """
    # Metres from a garment's border up to which its cover may not last (a skirt's hem swings), and below the cloth.
    margins, deepest = {"upper": 0.035, "lower": 0.13}, 0.09
    count = person.body.vertex_count
    covered = np.zeros(count, dtype=bool)
    layers = TriangleMesh(vertices, person.tpose.faces)
    for name, margin in margins.items():
        cloth = layers.submesh(person.face_part == PART_NAMES.index(name))[0]
        # Skin counts as covered where it is behind the nearest cloth, away from the border and not too deep.
        squared, face, closest = igl.point_mesh_squared_distance(vertices[:count], cloth.vertices, cloth.faces)
        # Behind the cloth: against the normal of its nearest face.
        inside = np.einsum("vi,vi->v", vertices[:count] - closest, cloth.face_normals[face]) < 0
        border = cloth.vertices[np.unique(cloth.border_edges)]
        away = np.sqrt(igl.point_mesh_squared_distance(closest, border, np.arange(len(border))[:, None])[0]) > margin
        covered |= inside & away & (squared < deepest**2)
    outer = person.body.part_labels == person.body.part_label_names.index("body")
    hidden = np.zeros(person.tpose.face_count, dtype=bool)
    body = np.flatnonzero(person.face_part == PART_NAMES.index("body"))
    hidden[body] = (covered & outer)[person.tpose.faces[body]].all(axis=1)
    return hidden


def render_view(
    person: Person, frame: LitFrame, camera: Camera, *, supersampling: int, atlas: Atlas | None = None
) -> RenderedView:
    """Average colours over `supersampling`^2 samples a pixel in linear light; labels are those at its centre.

    Colours are looked up in `atlas`, or computed at every sample.
    """
    # Rasterize at s times the resolution.
    s = supersampling
    # Intrinsics scale with the resolution.
    K = camera.K.copy()
    K[:2] *= s
    fine = replace(camera, K=K, width=camera.width * s, height=camera.height * s)
    maps = rasterize_mesh(frame.mesh, fine)
    hit = np.flatnonzero(maps.face_id.ravel() >= 0)
    color = np.zeros((fine.height * fine.width, 3), np.float32)
    color[hit] = _shaded(person, frame, fine, maps, hit, atlas) * _other_light(frame, fine, maps, hit)
    # Average in linear light over the samples that hit; the share of hits is the opacity.
    count = _pooled(maps.mask[..., None].astype(np.float32), s)
    linear = _pooled(color.reshape(fine.height, fine.width, 3), s) / np.maximum(count, 1)
    alpha = count[..., 0] / s**2
    srgb = srgb8_from_linear(linear).astype(np.float64)
    image = np.round(srgb * alpha[..., None]).astype(np.uint8)
    return RenderedView(image, np.round(255 * alpha).astype(np.uint8), label_map(person, frame, camera))


def label_map(person: Person, frame: LitFrame, camera: Camera) -> UInt8[np.ndarray, "H W"]:
    """Return the label of what is at each pixel's centre; 0 where nothing is."""
    maps = rasterize_mesh(frame.mesh, camera)
    hit = np.flatnonzero(maps.face_id.ravel() >= 0)
    out = np.zeros(camera.height * camera.width, np.uint8)
    out[hit] = _surface(person, frame, maps, hit)[3]
    return out.reshape(camera.height, camera.width)


def normal_map(frame: LitFrame, camera: Camera) -> Float64[np.ndarray, "H W 3"]:
    """Return smooth unit normals in the world, facing the camera, at pixel centres; zero on background."""
    maps = rasterize_mesh(frame.mesh, camera)
    # Interpolate vertex normals, normalise them, and turn those of back faces.
    normal = maps.interpolate(frame.mesh.faces, frame.mesh.vertex_normals)
    hit = maps.mask
    flat = normal[hit]
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    flat[_back_faces(frame.mesh, camera)[maps.face_id[hit]]] *= -1.0
    normal[hit] = flat
    return normal


def _pooled(x: Float32[np.ndarray, "H W D"], s: int) -> Float32[np.ndarray, "h w D"]:
    """Return the sums over blocks of s x s pixels."""
    return sum((x[i::s, j::s] for i in range(s) for j in range(s)), np.zeros((), x.dtype))


def _surface(
    person: Person, frame: LitFrame, maps: MeshMaps, pixels: Int[np.ndarray, " P"]
) -> tuple[Int[np.ndarray, "P 3"], Float64[np.ndarray, "P 3"], UInt8[np.ndarray, " P"], UInt8[np.ndarray, " P"]]:
    """Return corners, barycentric coordinates, part and label at flat pixel indices."""
    shown = maps.face_id.ravel()[pixels]
    bary = maps.barycentric.reshape(-1, 3)[pixels].astype(np.float64)
    corners = frame.mesh.faces[shown]
    nearest = corners[np.arange(len(corners)), np.argmax(bary, axis=1)]
    return corners, bary, person.face_part[frame.face[shown]], person.vertex_label[nearest]


def _shaded(
    person: Person,
    frame: LitFrame,
    camera: Camera,
    maps: MeshMaps,
    pixels: Int[np.ndarray, " P"],
    atlas: Atlas | None,
) -> Float32[np.ndarray, "P 3"] | Float64[np.ndarray, "P 3"]:
    """Return the linear colours at flat pixel indices."""
    if atlas is not None:
        return _from_atlas(frame, camera, maps, pixels, atlas)
    corners, bary, part, label = _surface(person, frame, maps, pixels)
    # Single precision: textures are sums of many sines.
    canonical = np.einsum("pk,pkx->px", bary, person.tpose.vertices[corners]).astype(np.float32)
    albedo = linear_from_srgb(person.colors(canonical, part, label)).astype(np.float64)
    behind = _back_faces(frame.mesh, camera)[maps.face_id.ravel()[pixels]]
    light = np.where(
        behind,
        np.einsum("pk,pk->p", bary, frame.light[1][corners]),
        np.einsum("pk,pk->p", bary, frame.light[0][corners]),
    )
    return bounced(light, albedo)


def _from_atlas(
    frame: LitFrame, camera: Camera, maps: MeshMaps, pixels: Int[np.ndarray, " P"], atlas: Atlas
) -> Float32[np.ndarray, "P 3"]:
    """Return the linear colours at flat pixel indices, in single precision, from an atlas."""
    shown = maps.face_id.ravel().take(pixels)
    bary = maps.barycentric.reshape(-1, 3).take(pixels, axis=0)
    albedo = linear_from_srgb(atlas.colors(frame.face.take(shown), bary))
    # A camera sees one side of a whole face, so the side's light is chosen by face.
    back = _back_faces(frame.mesh, camera)
    corner_light = np.where(back[:, None], frame.light[1][frame.mesh.faces], frame.light[0][frame.mesh.faces])
    light = np.einsum("pk,pk->p", bary, corner_light.astype(np.float32).take(shown, axis=0))
    return bounced(light, albedo)


def _other_light(
    frame: LitFrame, camera: Camera, maps: MeshMaps, pixels: Int[np.ndarray, " P"]
) -> Float[np.ndarray, "P 3"] | float:
    """Return the factor of the environment on the colours: the ratio of its irradiance to the stage's."""
    if frame.environment is None:
        return 1.0
    shown = maps.face_id.ravel()[pixels]
    bary, corners = maps.barycentric.reshape(-1, 3)[pixels], frame.mesh.faces[shown]
    side = _back_faces(frame.mesh, camera)[shown].astype(np.int64)[:, None]
    light = np.einsum("pk,pk->p", bary, frame.light[side, corners])
    other = np.einsum("pk,pkc->pc", bary, frame.environment[side, corners])
    return other / np.maximum(light, 1e-3)[:, None]


def _back_faces(mesh: TriangleMesh, camera: Camera) -> Bool[np.ndarray, " M"]:
    """Return which faces turn their inner side to a pinhole camera."""
    return np.einsum("mi,mi->m", mesh.face_cross, mesh.face_centers - camera.position) > 0.0


def paint_atlas(person: Person, *, cell: float, face_cell: float, shown: Int[np.ndarray, " m"] | None = None) -> Atlas:
    """Paint the person's colours once; a lookup costs less than the procedural colours of every sample.

    Args:
        person: the person, painted in her T-pose.
        cell: side of the square with the area of a cell, metres.
        face_cell: the same above the neck's joint.
        shown: faces that are painted; the others have one black cell. None: all.
    """
    # Cells of every face by its area; hidden faces have one.
    mesh = TriangleMesh(person.tpose.vertices, person.tpose.faces)
    above = mesh.face_centers[:, 1] > person.joints["neck"][1]
    sides = np.where(above, face_cell, cell)
    divisions = np.maximum(np.ceil(np.sqrt(mesh.face_areas) / sides), 1).astype(np.int32)
    painted = np.arange(mesh.face_count) if shown is None else shown
    hidden = np.ones(mesh.face_count, dtype=bool)
    hidden[painted] = False
    divisions[hidden] = 1
    count = divisions.astype(np.int64) ** 2
    first = np.cumsum(count) - count
    color = np.zeros((int(count.sum()), 3), np.uint8)

    def paint(faces: Int[np.ndarray, " F"]) -> None:
        cells = np.repeat(faces, count[faces])
        place = np.arange(len(cells)) - np.repeat(np.cumsum(count[faces]) - count[faces], count[faces])
        bary = _cell_centers(place, divisions[cells])
        corners = mesh.faces[cells]
        points = np.einsum("pk,pkx->px", bary, mesh.vertices[corners]).astype(np.float32)
        nearest = corners[np.arange(len(corners)), np.argmax(bary, axis=1)]
        color[first[cells] + place] = person.colors(points, person.face_part[cells], person.vertex_label[nearest])

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(paint, _chunks(painted, count)))
    return Atlas(divisions, first, color)


def _cell_centers(place: Int[np.ndarray, " P"], n: Int[np.ndarray, " P"]) -> Float[np.ndarray, "P 3"]:
    """Return the barycentric centres of cells by their index among the n^2 of their face."""
    # Row i starts at i (2 n - i): solve that for i, with a margin for rounding.
    # Cells in a row alternate between upright and inverted triangles.
    row = np.floor(n - np.sqrt(np.maximum(n.astype(np.float64) ** 2 - place, 0.0)) + 1e-9).astype(np.int64)
    inside = place - row * (2 * n - row)
    column, inverted = inside // 2, inside % 2
    third = np.where(inverted == 1, 2.0, 1.0) / 3.0
    a, b = (row + third) / n, (column + third) / n
    return np.stack([a, b, 1.0 - a - b], axis=1)


def _chunks(faces: Int[np.ndarray, " F"], count: Int[np.ndarray, " M"]) -> Iterator[Int[np.ndarray, " f"]]:
    """Split a list of faces into parts of about 400,000 cells, which bounds memory."""
    number = np.cumsum(count[faces]) // 400_000
    return iter(np.split(faces, np.flatnonzero(np.diff(number)) + 1))
