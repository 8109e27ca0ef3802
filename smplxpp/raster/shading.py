"""Draw shaded pictures of meshes from the z-buffer's maps: key light, sky and ground, rim, ambient occlusion, lines."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64, UInt8

from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.core.colors import linear_from_srgb, srgb8_from_linear
from smplxpp.raster.zbuffer import MeshMaps, rasterize_mesh

# In camera axes (x right, y down, z forward): from the surface to the light, above and left of the camera.
_KEY_DIRECTION = np.array([-0.42076, -0.62112, -0.66119], dtype=np.float32)
_HALF_DIRECTION = np.array([-0.23084, -0.34076, -0.91137], dtype=np.float32)  # between the key and the viewer
_BACK_SIDE = np.array([0.42, 0.46, 0.54], dtype=np.float32)  # inside of open surfaces: darker and cooler

Paint = Callable[[Int64[np.ndarray, " P"], Float64[np.ndarray, "P 3"]], UInt8[np.ndarray, "P 3"]]


@dataclass(frozen=True)
class ShadeStyle:
    """Options of drawing surfaces with `render_shaded`.

    Attributes:
        base_color: sRGB of surfaces without colours of their own.
        background: sRGB of the background.
        supersampling: number of samples of a pixel along each axis.
        relief: 1 for full light and shadow, 0 for flat colours; lower values keep colours readable.
        occlusion: strength of the ambient occlusion, 0 to 1.
        occlusion_radius: radius of the ambient occlusion, metres.
        smooth: whether vertex normals are interpolated; otherwise each face has one normal.
        wireframe: whether the faces' edges are drawn.
    """

    base_color: tuple[int, int, int] = (206, 200, 192)
    background: tuple[int, int, int] = (255, 255, 255)
    supersampling: int = 2
    relief: float = 1.0
    occlusion: float = 0.85
    occlusion_radius: float = 0.07
    smooth: bool = True
    wireframe: bool = False


@dataclass(frozen=True)
class Layer:
    """A shaded surface before compositing on a background, at the supersampled size.

    Attributes:
        color: linear light, 0 on the background.
        mask: pixels of the surface.
        depth: metres, inf on the background.
        facing: |cos| between normal and view, 1 on the background.
    """

    color: Float32[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "H W"]
    facing: Float32[np.ndarray, "H W"]


def render_shaded(
    mesh: TriangleMesh,
    camera: Camera,
    *,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
    face_colors: UInt8[np.ndarray, "M 3"] | None = None,
    paint: Paint | None = None,
    style: ShadeStyle | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a lit picture of a mesh.

    Args:
        mesh: the mesh.
        camera: the camera.
        vertex_colors: sRGB, interpolated in linear light.
        face_colors: sRGB, one for each face.
        paint: returns the sRGB of points, given as faces and barycentric coordinates, such as those of a texture.
        style: options.
    """
    style = style or ShadeStyle()
    layer = shade_layer(mesh, camera, vertex_colors=vertex_colors, face_colors=face_colors, paint=paint, style=style)
    return resolve(layer.color, layer.mask, style=style)


def shade_layer(
    mesh: TriangleMesh,
    camera: Camera,
    *,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
    face_colors: UInt8[np.ndarray, "M 3"] | None = None,
    paint: Paint | None = None,
    style: ShadeStyle,
) -> Layer:
    """Rasterise and shade a mesh, with colours of either vertices or faces, or of every point."""
    # Colours are bytes of one kind.
    for name, colors, count in (
        ("vertex colours", vertex_colors, mesh.vertex_count),
        ("face colours", face_colors, mesh.face_count),
    ):
        if colors is not None and (np.shape(colors) != (count, 3) or np.asarray(colors).dtype != np.uint8):
            raise InputError(
                name,
                expected=f"uint8 of shape ({count}, 3)",
                received=f"{np.asarray(colors).dtype} of shape {np.shape(colors)}",
            )
    if vertex_colors is not None and face_colors is not None:
        raise InputError("colours", expected="a vertex or a face", received="both")
    # Rasterise at the supersampled size, and gather what shading needs.
    s = style.supersampling
    K = camera.K.copy()
    K[:2] *= s
    fine = replace(camera, K=K, width=camera.width * s, height=camera.height * s)
    maps = rasterize_mesh(mesh, fine)
    hit = np.flatnonzero(maps.face_id.ravel() >= 0)
    base = linear_from_srgb(np.array(style.base_color, np.uint8))
    surface = _Surface(
        mesh=mesh,
        camera=fine,
        maps=maps,
        back=_back_faces(mesh, camera),
        normals=_camera_normals(mesh, camera, smooth=style.smooth),
        vertex_albedo=None if vertex_colors is None else linear_from_srgb(np.asarray(vertex_colors)),
        face_albedo=base[None] if face_colors is None else linear_from_srgb(np.asarray(face_colors)),
        paint=paint,
        edge_heights=_edge_heights(mesh, fine) if style.wireframe else None,
        style=style,
    )
    # Shade the covered pixels in blocks of 32,768, which fit the processor's cache, on up to four threads.
    block = 1 << 15
    open_sky = unoccluded(maps, fine, surface.normals_at, style=style)
    color = np.zeros((fine.height * fine.width, 3), np.float32)
    facing = np.ones(fine.height * fine.width, np.float32)

    def work(begin: int) -> None:
        pixels = hit[begin : begin + block]
        color[pixels], facing[pixels] = surface.shade(pixels, open_sky)

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        list(pool.map(work, range(0, len(hit), block)))
    shape = (fine.height, fine.width)
    return Layer(color.reshape(*shape, 3), maps.face_id >= 0, maps.depth, facing.reshape(shape))


def resolve(
    color: Float[np.ndarray, "sH sW 3"],
    alpha: Float[np.ndarray, "sH sW"] | Bool[np.ndarray, "sH sW"],
    *,
    style: ShadeStyle,
) -> UInt8[np.ndarray, "H W 3"]:
    """Average premultiplied linear colours in linear light, on the style's background."""
    s = style.supersampling

    def average(x: Float[np.ndarray, "sH sW ..."]) -> Float[np.ndarray, "H W ..."]:
        return np.asarray(sum(x[i::s, j::s] for i in range(s) for j in range(s))) * np.float32(1.0 / s**2)

    background = linear_from_srgb(np.array(style.background, np.uint8))
    return srgb8_from_linear(average(color) + (1.0 - average(alpha.astype(np.float32)))[..., None] * background)


@dataclass(frozen=True)
class _Surface:
    """Inputs of the shading of all pixels.

    Attributes:
        mesh: the mesh.
        camera: the supersampled camera.
        maps: maps of the mesh.
        back: faces whose back is visible.
        normals: normals of vertices or faces, in camera axes.
        vertex_albedo: linear colours of vertices.
        face_albedo: linear colours of faces, or one for all.
        paint: colours of points, in the place of both.
        edge_heights: heights of the faces over their edges, pixels.
        style: options.
    """

    mesh: TriangleMesh
    camera: Camera
    maps: MeshMaps
    back: Bool[np.ndarray, " M"]
    normals: Float32[np.ndarray, "K 3"]
    vertex_albedo: Float32[np.ndarray, "N 3"] | None
    face_albedo: Float32[np.ndarray, "L 3"]
    paint: Paint | None
    edge_heights: Float32[np.ndarray, "M 3"] | None
    style: ShadeStyle

    def normals_at(self, pixels: Int[np.ndarray, " P"]) -> Float[np.ndarray, "P 3"]:
        """Return unit normals towards the camera, in camera axes, at flat pixel indices."""
        face, bary, corners = self._gather(pixels)
        return self._normals(face, bary, corners)

    def shade(
        self, pixels: Int[np.ndarray, " P"], open_sky: Float32[np.ndarray, "H W"]
    ) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, " P"]]:
        """Return linear colour and |cos| to the view at flat pixel indices."""
        # Albedo from vertices, one colour, or faces.
        face, bary, corners = self._gather(pixels)
        normal = self._normals(face, bary, corners)
        if self.paint is not None:
            color = linear_from_srgb(self.paint(face.astype(np.int64), bary.astype(np.float64)))
        elif self.vertex_albedo is not None:
            color = _interpolate(self.vertex_albedo, corners, bary)
        elif len(self.face_albedo) == 1:
            color = np.repeat(self.face_albedo, len(pixels), axis=0)
        else:
            color = self.face_albedo.take(face, axis=0)
        # Light, a rim at grazing angles, a darker back side, and lines within a pixel of an edge.
        row, col = np.divmod(pixels, self.camera.width)
        s = self.style.supersampling
        sky = open_sky[row // s, col // s]
        facing = np.clip(-np.einsum("pd,pd->p", normal, _view_directions(self.camera, row, col)), 0.0, 1.0)
        relief = np.float32(self.style.relief)
        color *= _light(normal, facing, sky, relief)[:, None]
        color += (relief * np.float32(0.16) * (1.0 - facing) ** 4 * sky)[:, None]
        color *= np.where(self.back.take(face)[:, None], _BACK_SIDE, np.float32(1.0))
        if self.edge_heights is not None:
            pixels_from_edge = (bary * self.edge_heights.take(face, axis=0)).min(axis=1)
            color *= 1.0 - np.float32(0.7) * np.clip(1.4 - pixels_from_edge, 0.0, 1.0)[:, None]
        return color, facing

    def _gather(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        face = self.maps.face_id.ravel().take(pixels)
        return face, self.maps.barycentric.reshape(-1, 3).take(pixels, axis=0), self.mesh.faces.take(face, axis=0)

    def _normals(self, face: np.ndarray, bary: np.ndarray, corners: np.ndarray) -> np.ndarray:
        normal = _interpolate(self.normals, corners, bary) if self.style.smooth else self.normals.take(face, axis=0)
        length = np.sqrt(np.einsum("pd,pd->p", normal, normal))
        sign = np.where(self.back.take(face), np.float32(-1.0), np.float32(1.0))
        return normal * (sign / np.maximum(length, 1e-6))[:, None]


def _interpolate(values: np.ndarray, corners: np.ndarray, bary: np.ndarray) -> np.ndarray:
    out = values.take(corners[:, 0], axis=0)
    out *= bary[:, :1]
    for k in (1, 2):
        term = values.take(corners[:, k], axis=0)
        term *= bary[:, k : k + 1]
        out += term
    return out


def _view_directions(camera: Camera, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Return (P, 3) float32 unit vectors from the camera to pixel centres, in camera axes."""
    view = np.empty((len(row), 3), np.float32)
    view[:, 2] = 1.0
    if camera.orthographic:
        view[:, :2] = 0.0
        return view
    view[:, 0] = (col + (0.5 - camera.K[0, 2])) / camera.K[0, 0]
    view[:, 1] = (row + (0.5 - camera.K[1, 2])) / camera.K[1, 1]
    return view / np.sqrt(np.einsum("pd,pd->p", view, view))[:, None]


def _back_faces(mesh: TriangleMesh, camera: Camera) -> np.ndarray:
    """Return (M,) whether the camera sees each face from behind."""
    if camera.orthographic:
        return mesh.face_cross @ camera.forward > 0.0
    # The sign of n . (p - eye), with p any corner; n . p is fixed by the mesh.
    offset = np.einsum("md,md->m", mesh.face_cross, mesh.vertices.take(mesh.faces[:, 0], axis=0))
    return offset - mesh.face_cross @ camera.position > 0.0


def _camera_normals(mesh: TriangleMesh, camera: Camera, *, smooth: bool) -> np.ndarray:
    normals = mesh.vertex_normals if smooth else mesh.face_normals
    return normals.astype(np.float32) @ camera.cam_from_world[:3, :3].T.astype(np.float32)


def _light(normal: np.ndarray, facing: np.ndarray, open_sky: np.ndarray, relief: np.float32) -> np.ndarray:
    """Return the (P,) factor of light on the surface's colour; its weights were chosen by eye."""
    key_light, sky_light, ground_light, gloss_light = 0.62, 0.46, 0.24, 0.05
    # Wrapped diffuse light, because the terminator of a plain Lambert term hides half of the form.
    key = np.clip((normal @ _KEY_DIRECTION + 0.30) / 1.30, 0.0, None)
    sky = 0.5 * (1.0 - normal[:, 1])  # y points down
    gloss = np.clip(normal @ _HALF_DIRECTION, 0.0, None) ** 24
    ambient = ground_light + (sky_light - ground_light) * sky + 0.18 * facing
    lit = key_light * key * (0.45 + 0.55 * open_sky) + ambient * open_sky + gloss_light * gloss
    return (1.0 - relief) + relief * lit


def _edge_heights(mesh: TriangleMesh, camera: Camera) -> np.ndarray:
    """Return (M, 3) float32 heights of each corner over its opposite edge, in pixels.

    Barycentric coordinates times these heights are distances to the edges.
    """
    t = camera.screen_from_world(mesh.vertices)[:, :2][mesh.faces]
    u, v = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    twice_area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    opposite = np.stack([np.linalg.norm(t[:, (k + 2) % 3] - t[:, (k + 1) % 3], axis=1) for k in range(3)], axis=1)
    return (twice_area[:, None] / np.maximum(opposite, 1e-9)).astype(np.float32)


def unoccluded(
    maps: MeshMaps, camera: Camera, normals_at: Callable[[np.ndarray], np.ndarray], *, style: ShadeStyle
) -> Float32[np.ndarray, "H W"]:
    """Return the share of the surroundings that each output pixel sees, 1 on the background.

    `maps` and `camera` are supersampled; the first sample of each output pixel stands for all of them.

    With v the vector to a neighbour at distance |v| < r and n the normal,
    `A = 1 - strength * gain * mean(max(0, v.n - bias) / |v| * (1 - |v|^2 / r^2))` over one fixed spiral of
    neighbours: the obscurance of McGuire et al., "The Alchemy Screen-Space Ambient Obscurance Algorithm" (2011),
    with a smooth falloff.
    """
    # 16 neighbours of a pixel; a contrast chosen by eye; a bias of 2 mm, below which lie the depth map's own steps; a
    # background 1e6 m away.
    neighbours, gain = 16, 3.0
    bias, far = np.float32(0.002), np.float32(1e6)
    golden_angle = np.pi * (3.0 - 5.0**0.5)
    s = style.supersampling
    face = maps.face_id[::s, ::s]
    seen = np.ones(face.shape, np.float32)
    pixels = np.flatnonzero(face.ravel() >= 0)
    if style.occlusion <= 0.0 or not len(pixels):
        return seen
    row, col = np.divmod(pixels, face.shape[1])
    normal = normals_at(row * s * camera.width + col * s)
    # Depth padded by the radius in pixels, so that neighbours need no bounds.
    depth = np.where(face >= 0, maps.depth[::s, ::s], far)
    z = depth.ravel()[pixels]
    focal = camera.K[0, 0] / s
    reach = style.occlusion_radius * focal / (1.0 if camera.orthographic else float(np.median(z)))
    pad = int(np.ceil(reach))
    padded = np.pad(depth, pad, constant_values=far)
    center = (row + pad) * padded.shape[1] + col + pad
    flat = padded.ravel()
    x = ((col + 0.5 - camera.K[0, 2] / s) / focal).astype(np.float32)
    y = ((row + 0.5 - camera.K[1, 2] / s) / focal).astype(np.float32)
    nx, ny, nz = np.ascontiguousarray(normal.T)
    inverse_r2 = np.float32(1.0 / style.occlusion_radius**2)
    total = np.zeros(len(pixels), np.float32)
    # Sum the obscurance over a spiral of neighbours of even density, the same for every pixel.
    for k in range(neighbours):
        radius, angle = reach * np.sqrt((k + 0.5) / neighbours), golden_angle * k
        dx, dy = round(radius * np.cos(angle)), round(radius * np.sin(angle))
        step_x, step_y = np.float32(dx / focal), np.float32(dy / focal)
        zk = flat.take(center + (dy * padded.shape[1] + dx))
        vz = zk - z
        if camera.orthographic:
            vx, vy = step_x, step_y
        else:
            vx, vy = x * vz + step_x * zk, y * vz + step_y * zk
        v2 = vx * vx + vy * vy + vz * vz
        along = np.maximum(vx * nx + vy * ny + vz * nz - bias, 0.0)
        total += along * np.maximum(1.0 - v2 * inverse_r2, 0.0) / np.sqrt(v2 + np.float32(1e-6))
    seen.ravel()[pixels] = np.clip(1.0 - style.occlusion * gain / neighbours * total, 0.0, 1.0)
    return seen
