"""Mesh maps: which face, where on it and how deep, at every pixel of a camera's image."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Integer, Num

from smplxpp.core.camera import Camera
from smplxpp.core.mesh import TriangleMesh
from smplxpp.native import native_library


@dataclass(frozen=True)
class MeshMaps:
    """What a camera sees of a mesh.

    Attributes:
        face_id: (H, W) int32, -1 on the background.
        barycentric: (H, W, 3) float32 weights of the face's three corners (perspective-correct).
        depth: (H, W) float32, metres along the camera's z axis, inf on the background.
    """

    face_id: Int32[np.ndarray, "H W"]
    barycentric: Float32[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]

    @property
    def mask(self) -> Bool[np.ndarray, "H W"]:
        """The pixels covered by the mesh."""
        return self.face_id >= 0

    def interpolate(
        self, faces: Integer[np.ndarray, "M 3"], vertex_values: Num[np.ndarray, "N D"], background: float = 0.0
    ) -> Float64[np.ndarray, "H W D"]:
        """Vertex values (N, D) at every pixel: (H, W, D) float64; `background` where nothing is hit."""
        values = np.asarray(vertex_values)
        out = np.full((*self.face_id.shape, values.shape[1]), background, dtype=np.float64)
        hit = self.mask
        corners = faces[self.face_id[hit]]
        out[hit] = np.einsum("pk,pkd->pd", self.barycentric[hit], values[corners])
        return out


def rasterize_mesh(mesh: TriangleMesh, camera: Camera, *, near: float = 1e-3, threads: int | None = None) -> MeshMaps:
    """Rasterise `mesh` through `camera` with a z-buffer; both sides of every face are drawn.

    A face with a corner nearer than `near` metres is skipped whole. The result is the same for any `threads`.
    """
    return rasterize_triangles(mesh.vertices, mesh.faces, camera, near=near, threads=threads)


def rasterize_triangles(
    vertices: Float[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "M 3"],
    camera: Camera,
    *,
    near: float = 1e-3,
    threads: int | None = None,
) -> MeshMaps:
    """`rasterize_mesh` for arrays that the caller has checked: vertices (N, 3) finite, faces (M, 3) within them."""
    screen = np.ascontiguousarray(camera.screen_from_world(vertices), dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    height, width = camera.height, camera.width
    face_id = np.empty((height, width), np.int32)
    barycentric = np.empty((height, width, 3), np.float32)
    depth = np.empty((height, width), np.float32)

    def pointer(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    native_library().smplxpp_zbuffer(
        pointer(screen),
        pointer(faces),
        ctypes.c_int64(len(faces)),
        ctypes.c_double(near if not camera.orthographic else -np.inf),
        width,
        height,
        pointer(face_id),
        pointer(barycentric),
        pointer(depth),
        threads or min(8, os.cpu_count() or 1),
    )
    return MeshMaps(face_id, barycentric, depth)
