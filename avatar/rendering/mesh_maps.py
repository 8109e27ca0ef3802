"""Rasterise maps of a mesh with gradients by a z-buffer, and define the frame of front and back maps.

Gradients reach vertex values, and vertices through the barycentrics and the depth at fixed pixels, as in nvdiffrast's
rasterise and interpolate. Which face a pixel shows is a constant: there is no gradient of silhouettes.

    maps = mesh_maps(vertices, faces, camera, attributes=colors)
    normals = vertex_normal_map(maps, vertices)
    posed = front_back_maps(rest_vertices, faces, MapFrame.of(rest), size=512).interpolate(posed_vertices)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int32, Int64
from torch import Tensor

from avatar.gaussians.native_kernels import is_native
from avatar.gaussians.tensor_operations import gather_rows
from avatar.rendering.barycentrics import (
    BarycentricFunction,
    InterpolateFunction,
    barycentrics_reference,
    interpolate_reference,
)
from smplxpp.core import Camera, InputError
from smplxpp.native import thread_count
from smplxpp.raster import MeshMaps, rasterize_triangles


@dataclass(frozen=True)
class MapFrame:
    """The square that front and back maps cover: `center` +- `half_extent` along x and y of the canonical pose.

    Row 0 is at the top (+y) and column 0 at the left (-x) of *both* maps: the back map is mirrored, so that one pixel
    shows the front and the back of the same place.

    Attributes:
        center: metres, the middle of the canonical box.
        half_extent: metres from the middle of a map to its border.
    """

    center: tuple[float, float, float]
    half_extent: float = 1.0

    @staticmethod
    def of(vertices: Float[np.ndarray, "V 3"], *, half_extent: float = 1.0) -> MapFrame:
        """Make the frame about the middle of the box of canonical vertices, metres."""
        x, y, z = 0.5 * (np.min(vertices, axis=0) + np.max(vertices, axis=0))
        return MapFrame((float(x), float(y), float(z)), half_extent)

    def cameras(self, size: int) -> tuple[Camera, Camera]:
        """Make the orthographic cameras of the front and the mirrored back map, `size` pixels a side."""
        front, back = (
            Camera.orthographic_view(
                center=np.array(self.center), direction=np.array([0.0, 0.0, z]), half_extent=self.half_extent, size=size
            )
            for z in (1.0, -1.0)
        )
        # The back view's x axis is -x of the world: a negative focal length turns its columns round.
        mirrored = back.K * np.array([[-1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
        return replace(front, name="front"), replace(back, K=mirrored, name="back")

    def pixels_from_canonical(self, points: Float[Tensor, "*P 3"], size: int) -> Float[Tensor, "*P 2"]:
        """Return column and row in pixels, pixel centres at +0.5, of canonical points in metres."""
        x, y = points[..., 0] - self.center[0], points[..., 1] - self.center[1]
        return torch.stack([x, -y], dim=-1) * (0.5 * size / self.half_extent) + 0.5 * size


@dataclass(frozen=True)
class MeshMapsTensor:
    """Maps of a mesh from one camera, or from B cameras of one size with a leading axis.

    Attributes:
        faces: of the mesh.
        vertex_count: number of vertices of the mesh, V.
        face_id: visible face, -1 on the background.
        barycentric: weights of the face's corners, perspective-correct; 0 on the background.
        depth: metres along the camera's z axis; inf on the background, so mask it before arithmetic.
        attributes: interpolated vertex values if requested; 0 on the background.
    """

    faces: Int64[Tensor, "F 3"]
    vertex_count: int
    face_id: Int32[Tensor, "*B H W"]
    barycentric: Float[Tensor, "*B H W 3"]
    depth: Float[Tensor, "*B H W"]
    attributes: Float[Tensor, "*B H W D"] | None = None

    @property
    def mask(self) -> Bool[Tensor, "*B H W"]:
        """The pixels that the mesh covers."""
        return self.face_id >= 0

    @cached_property
    def _covered(self) -> Int64[Tensor, " M"]:
        """Flat indices of the covered pixels; a GPU is waited for once, not in every interpolation."""
        return self.mask.flatten().nonzero().squeeze(1)

    def interpolate(self, values: Float[Tensor, "V D"]) -> Float[Tensor, "*B H W D"]:
        """Return vertex values at every pixel, 0 on the background, with gradients to values and barycentrics.

        Vertices themselves give the position map; so a T-pose's maps carry posed coordinates or semantic colours.

        Raises:
            InputError: values of the wrong shape, type or device.
        """
        if values.dim() != 2 or len(values) != self.vertex_count or not values.is_floating_point():
            raise InputError(
                "vertex values",
                expected=f"floating-point ({self.vertex_count}, D)",
                received=f"{tuple(values.shape)} {values.dtype}",
            )
        if values.device != self.face_id.device:
            raise InputError("vertex values", expected=f"device {self.face_id.device}", received=str(values.device))
        # float32 on the CPU takes the native kernel; other dtypes and devices take the same sums in torch.
        if is_native(values, self.barycentric):
            return InterpolateFunction.apply(values, self.barycentric, self.faces.int(), self.face_id)
        return interpolate_reference(values, self.barycentric, self.faces, self.face_id, self._covered)


def mesh_maps(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    camera: Camera | Sequence[Camera],
    attributes: Float[Tensor, "V D"] | None = None,
    *,
    near: float = 1e-3,
) -> MeshMapsTensor:
    """Rasterise a mesh to maps, with both sides of every face drawn.

    float32 on the CPU runs in the native library; other tensors get faces from the same z-buffer on the CPU and the
    rest in torch on their device. The same input gives the same bits at a fixed number of threads.

    Args:
        vertices: world coordinates, metres.
        faces: indices of their corners.
        camera: perspective or orthographic, one or several of one image size.
        attributes: values to interpolate, as `MeshMapsTensor.interpolate`.
        near: metres; a face with a corner nearer than this to a perspective camera is skipped whole.

    Raises:
        InputError: shapes, types, NaN, indices out of range, cameras of several sizes.
    """
    # Visibility is a constant for gradients: the z-buffer runs in float64 on detached vertices, and only barycentrics
    # and depth at the faces that it found are differentiable functions of the vertices.
    cameras = [camera] if isinstance(camera, Camera) else list(camera)
    _check(vertices, faces, cameras)
    points, corners = vertices.detach().double().cpu().numpy(), faces.int().cpu().contiguous()
    views = []
    for c in cameras:
        seen = rasterize_triangles(points, corners.numpy(), c, near=near, threads=thread_count(torch.get_num_threads()))
        views.append(_view(vertices, corners, seen, c))
    # A single camera gives maps without the leading axis of cameras.
    stacked = views[0] if isinstance(camera, Camera) else [torch.stack(maps) for maps in zip(*views, strict=True)]
    maps = MeshMapsTensor(faces.to(vertices.device).long(), len(vertices), *stacked)
    return maps if attributes is None else replace(maps, attributes=maps.interpolate(attributes))


def front_back_maps(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    frame: MapFrame,
    *,
    size: int = 512,
    attributes: Float[Tensor, "V D"] | None = None,
) -> MeshMapsTensor:
    """Rasterise orthographic maps (2, size, size) of a canonical mesh from the front and the back, the back mirrored.

    One pixel has the same canonical x and y in both (see `MapFrame`). Rasterise the canonical mesh once and interpolate
    the values of every frame in it.
    """
    return mesh_maps(vertices, faces, frame.cameras(size), attributes)


def vertex_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Return unit normals, faces weighted by their area; zero at a vertex without any. Differentiable."""
    # The cross product of two edges is the face normal times twice the area; its sum over the faces of a vertex is
    # therefore the mean normal weighted by area.
    a, b, c = gather_rows(vertices, faces).unbind(1)
    cross = torch.cross(b - a, c - a, dim=-1)
    total = torch.zeros_like(vertices).index_add(0, faces.flatten(), cross.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(total, dim=-1, eps=_tiny(vertices))


def vertex_normal_map(maps: MeshMapsTensor, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "*B H W 3"]:
    """Return unit world normals interpolated between the vertices'; 0 on the background."""
    normals = maps.interpolate(vertex_normals(vertices, maps.faces))
    return torch.nn.functional.normalize(normals, dim=-1, eps=_tiny(normals))


def _tiny(values: Tensor) -> float:
    return torch.finfo(values.dtype).tiny


def _view(vertices: Tensor, faces: Tensor, seen: MeshMaps, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Return face ids, barycentrics and depth of one camera, the last two with gradients to the vertices."""
    face_id = torch.from_numpy(seen.face_id).to(vertices.device)
    if is_native(vertices):
        return face_id, *BarycentricFunction.apply(vertices, faces, seen, camera)
    return face_id, *barycentrics_reference(vertices, faces.to(vertices.device).long(), face_id, camera)


def _check(vertices: Tensor, faces: Tensor, cameras: list[Camera]) -> None:
    # Shapes and types first, because the checks of values below index the tensors.
    for name, tensor, kind in (("vertices", vertices, "floating-point"), ("faces", faces, "integer")):
        right = tensor.is_floating_point() if kind != "integer" else tensor.dtype in (torch.int32, torch.int64)
        if tensor.dim() != 2 or tensor.shape[1] != 3 or not right:
            raise InputError(
                f"mesh {name}", expected=f"{kind} (N, 3)", received=f"{tuple(tensor.shape)} {tensor.dtype}"
            )
    if not torch.isfinite(vertices).all():
        raise InputError("mesh vertices", expected="finite coordinates", received="NaN or infinity")
    if faces.numel():
        low, high = (int(v) for v in torch.aminmax(faces))
        if low < 0 or high >= len(vertices):
            raise InputError(
                "mesh faces", expected=f"indices in [0, {len(vertices)})", received=f"indices in [{low}, {high}]"
            )
    # Maps of several cameras are stacked, which needs one image size.
    sizes = {(c.width, c.height) for c in cameras}
    if len(sizes) != 1:
        raise InputError("cameras of mesh maps", expected="one or more of one image size", received=f"sizes {sizes}")
    # Rays need the inverse of K: a focal length of 0 makes it singular.
    for c in cameras:
        if c.K[0, 0] * c.K[1, 1] - c.K[0, 1] * c.K[1, 0] == 0:
            raise InputError(
                f"camera {c.name!r} of mesh maps",
                expected="focal lengths that are not 0",
                received=str(c.K[:2].tolist()),
            )
