"""What a camera sees of one frame: image, antialiased mask, labels, normals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.figures.colors import linear_from_srgb, srgb8_from_linear
from pipelines.synth.person import Person
from pipelines.synth.soft_light import bounced
from smplxpp.core.camera import Camera
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import MeshMaps, rasterize_mesh


@dataclass(frozen=True, eq=False)
class LitFrame:
    """One frame, ready to be seen.

    Attributes:
        mesh: all layers' vertices with the faces that are shown.
        face: (M,) index of each shown face among the person's.
        light: (2, V) of the outer and the inner side, from `vertex_light`.
    """

    mesh: TriangleMesh
    face: np.ndarray
    light: np.ndarray


@dataclass(frozen=True, eq=False)
class View:
    """Pixels of one camera: image (H, W, 3) on black, mask (H, W), labels (H, W), all uint8."""

    image: np.ndarray
    mask: np.ndarray
    labels: np.ndarray


def render_view(person: Person, frame: LitFrame, camera: Camera, *, supersampling: int) -> View:
    """Colours averaged over `supersampling`^2 samples a pixel in linear light; labels from one sample at its centre."""
    s = supersampling
    K = camera.K.copy()
    K[:2] *= s
    fine = replace(camera, K=K, width=camera.width * s, height=camera.height * s)
    maps = rasterize_mesh(frame.mesh, fine)
    hit = np.flatnonzero(maps.face_id.ravel() >= 0)
    color = np.zeros((fine.height * fine.width, 3), np.float32)
    color[hit] = _shaded(person, frame, fine, maps, hit)
    count = _pooled(maps.mask[..., None].astype(np.float32), s)
    linear = _pooled(color.reshape(fine.height, fine.width, 3), s) / np.maximum(count, 1)
    alpha = count[..., 0] / s**2
    srgb = srgb8_from_linear(linear).astype(np.float64)
    image = np.round(srgb * alpha[..., None]).astype(np.uint8)
    return View(image, np.round(255 * alpha).astype(np.uint8), label_map(person, frame, camera))


def label_map(person: Person, frame: LitFrame, camera: Camera) -> np.ndarray:
    """(H, W) uint8 label of what is at each pixel's centre; 0 where nothing is."""
    maps = rasterize_mesh(frame.mesh, camera)
    hit = np.flatnonzero(maps.face_id.ravel() >= 0)
    out = np.zeros(camera.height * camera.width, np.uint8)
    out[hit] = _surface(person, frame, maps, hit)[3]
    return out.reshape(camera.height, camera.width)


def normal_map(frame: LitFrame, camera: Camera) -> np.ndarray:
    """(H, W, 3) float64 smooth unit normals in the world, facing the camera, at pixel centres; zero on background."""
    maps = rasterize_mesh(frame.mesh, camera)
    normal = maps.interpolate(frame.mesh.faces, frame.mesh.vertex_normals)
    hit = maps.mask
    flat = normal[hit]
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    flat[_back_faces(frame.mesh, camera)[maps.face_id[hit]]] *= -1.0
    normal[hit] = flat
    return normal


def _pooled(x: np.ndarray, s: int) -> np.ndarray:
    """Sums over s x s blocks of (s H, s W, D)."""
    return sum(x[i::s, j::s] for i in range(s) for j in range(s))


def _surface(
    person: Person, frame: LitFrame, maps: MeshMaps, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corners (P, 3), barycentric coordinates (P, 3), part (P,) and label (P,) at flat pixel indices."""
    shown = maps.face_id.ravel()[pixels]
    bary = maps.barycentric.reshape(-1, 3)[pixels].astype(np.float64)
    corners = frame.mesh.faces[shown]
    nearest = corners[np.arange(len(corners)), np.argmax(bary, axis=1)]
    return corners, bary, person.face_part[frame.face[shown]], person.vertex_label[nearest]


def _shaded(person: Person, frame: LitFrame, camera: Camera, maps: MeshMaps, pixels: np.ndarray) -> np.ndarray:
    """(P, 3) linear colours."""
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


def _back_faces(mesh: TriangleMesh, camera: Camera) -> np.ndarray:
    """(M,) bool: faces that turn their inner side to a pinhole camera."""
    return np.einsum("mi,mi->m", mesh.face_cross, mesh.face_centers - camera.position) > 0.0
