"""What a camera sees of one frame: image, antialiased mask, labels, normals; and which skin it never sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8

from pipelines.synth.atlas import Atlas
from pipelines.synth.person import PART_NAMES, Person
from pipelines.synth.soft_light import bounced
from smplxpp.core.camera import Camera
from smplxpp.core.colors import linear_from_srgb, srgb8_from_linear
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import MeshMaps, rasterize_mesh

# How far from a garment's border its cover is taken for lasting (a skirt's hem swings), and how far skin may lie below.
_FROM_BORDER = {"upper": 0.035, "lower": 0.13}
_BELOW = 0.09
_DARKEST = 1e-3


@dataclass(frozen=True, eq=False)
class LitFrame:
    """One frame, ready to be seen.

    Attributes:
        mesh: all layers' vertices with the faces that are shown.
        face: index of each shown face among the person's.
        light: of the outer and the inner side, from `vertex_light`.
        environment: the same from `environment_light`, in whose place it shines; None: `light` does.
    """

    mesh: TriangleMesh
    face: Int[np.ndarray, " M"]
    light: Float[np.ndarray, "2 V"]
    environment: Float[np.ndarray, "2 V 3"] | None = None


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Pixels of one camera, the image on black."""

    image: UInt8[np.ndarray, "H W 3"]
    mask: UInt8[np.ndarray, "H W"]
    labels: UInt8[np.ndarray, "H W"]


def hidden_faces(person: Person, vertices: Float[np.ndarray, "V 3"]) -> Bool[np.ndarray, " M"]:
    """Tell the faces of skin well inside a garment in one frame.

    They are left out of the pictures, so that no thin cloth lets them show through.
    """
    count = person.body.vertex_count
    covered = np.zeros(count, dtype=bool)
    layers = TriangleMesh(vertices, person.tpose.faces)
    for name, margin in _FROM_BORDER.items():
        cloth = layers.submesh(person.face_part == PART_NAMES.index(name))[0]
        squared, face, closest = igl.point_mesh_squared_distance(vertices[:count], cloth.vertices, cloth.faces)
        inside = np.einsum("vi,vi->v", vertices[:count] - closest, cloth.face_normals[face]) < 0
        border = cloth.vertices[np.unique(cloth.border_edges)]
        away = np.sqrt(igl.point_mesh_squared_distance(closest, border, np.arange(len(border))[:, None])[0]) > margin
        covered |= inside & away & (squared < _BELOW**2)
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
    s = supersampling
    K = camera.K.copy()
    K[:2] *= s
    fine = replace(camera, K=K, width=camera.width * s, height=camera.height * s)
    maps = rasterize_mesh(frame.mesh, fine)
    hit = np.flatnonzero(maps.face_id.ravel() >= 0)
    color = np.zeros((fine.height * fine.width, 3), np.float32)
    color[hit] = _shaded(person, frame, fine, maps, hit, atlas) * _other_light(frame, fine, maps, hit)
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
    normal = maps.interpolate(frame.mesh.faces, frame.mesh.vertex_normals)
    hit = maps.mask
    flat = normal[hit]
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    flat[_back_faces(frame.mesh, camera)[maps.face_id[hit]]] *= -1.0
    normal[hit] = flat
    return normal


def _pooled(x: Float32[np.ndarray, "H W D"], s: int) -> Float32[np.ndarray, "h w D"]:
    """Sum over blocks of s x s pixels."""
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
        return _looked_up(frame, camera, maps, pixels, atlas)
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


def _looked_up(
    frame: LitFrame, camera: Camera, maps: MeshMaps, pixels: Int[np.ndarray, " P"], atlas: Atlas
) -> Float32[np.ndarray, "P 3"]:
    """Return the linear colours at flat pixel indices, in single precision, from an atlas."""
    shown = maps.face_id.ravel().take(pixels)
    bary = maps.barycentric.reshape(-1, 3).take(pixels, axis=0)
    albedo = linear_from_srgb(atlas.colors(frame.face.take(shown), bary))
    # The side that the camera sees is one and the same all over a face.
    back = _back_faces(frame.mesh, camera)
    corner_light = np.where(back[:, None], frame.light[1][frame.mesh.faces], frame.light[0][frame.mesh.faces])
    light = np.einsum("pk,pk->p", bary, corner_light.astype(np.float32).take(shown, axis=0))
    return bounced(light, albedo)


def _other_light(
    frame: LitFrame, camera: Camera, maps: MeshMaps, pixels: Int[np.ndarray, " P"]
) -> Float[np.ndarray, "P 3"] | float:
    """Return by what the frame's environment changes the colours; what bounces changes as what comes straight does."""
    if frame.environment is None:
        return 1.0
    shown = maps.face_id.ravel()[pixels]
    bary, corners = maps.barycentric.reshape(-1, 3)[pixels], frame.mesh.faces[shown]
    side = _back_faces(frame.mesh, camera)[shown].astype(np.int64)[:, None]
    light = np.einsum("pk,pk->p", bary, frame.light[side, corners])
    other = np.einsum("pk,pkc->pc", bary, frame.environment[side, corners])
    return other / np.maximum(light, _DARKEST)[:, None]


def _back_faces(mesh: TriangleMesh, camera: Camera) -> Bool[np.ndarray, " M"]:
    """Tell the faces that turn their inner side to a pinhole camera."""
    return np.einsum("mi,mi->m", mesh.face_cross, mesh.face_centers - camera.position) > 0.0
