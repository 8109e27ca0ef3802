"""Bind Gaussians to the triangles of a mesh: local attributes, their transform to the world, and their penalties."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from avatar.gaussians.frames import TriangleFrames, triangle_frames
from avatar.gaussians.native_kernels import WorldFunction, is_native
from avatar.gaussians.tensor_operations import gather_rows, multiply_quats
from smplxpp.core.errors import InputError, one_line
from smplxpp.core.spherical_harmonics import degree_of

THICKNESS = 0.01
"""Scale of every Gaussian along its normal, in mean edge lengths of its triangle (TaoAvatar's epsilon)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundGaussians:
    """N Gaussians in the frames of their triangles (`TriangleFrames`).

    Attributes:
        face_index: index of the triangle.
        barycentric: weights u of the first corner and v of the second; 1 - u - v is the third's.
        normal_offset: gamma, metres along the triangle's normal.
        offset: metres in the triangle's frame: (normal, median, their cross product).
        log_scales: logarithms of the two tangential standard deviations, in mean edge lengths.
        quats: wxyz, any length but zero: from the Gaussian's axes to the triangle's frame.
        opacity_logits: opacities before the sigmoid.
        dc: view-independent colour, in sRGB as the images.
        sh: real spherical harmonics of degree 1 and up in the triangle's frame; K = 0, 3, 8 or 15.
        face_count: number of triangles of the mesh.
        topology: digest of the mesh's faces, see `topology_digest`.

    Raises:
        InputError: tensors of inconsistent shapes or types, or triangles out of range (checked on the CPU only).
    """

    face_index: Int64[Tensor, " N"]
    barycentric: Float[Tensor, "N 2"]
    normal_offset: Float[Tensor, " N"]
    offset: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 2"]
    quats: Float[Tensor, "N 4"]
    opacity_logits: Float[Tensor, " N"]
    dc: Float[Tensor, "N 3"]
    sh: Float[Tensor, "N K 3"]
    face_count: int
    topology: str

    __repr__ = one_line

    def __post_init__(self) -> None:
        # Shapes, types and devices, then indices; indices on a GPU are not checked, which would wait for it.
        N, K = len(self.face_index), self.sh.shape[1] if self.sh.ndim == 3 else -1
        shapes: dict[str, tuple[int, ...]] = {
            "face_index": (N,),
            "barycentric": (N, 2),
            "normal_offset": (N,),
            "offset": (N, 3),
            "log_scales": (N, 2),
            "quats": (N, 4),
            "opacity_logits": (N,),
            "dc": (N, 3),
            "sh": (N, K, 3),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise _mismatch(name, f"shape {shape}", f"shape {tuple(value.shape)}")
            dtype = torch.int64 if name == "face_index" else self.offset.dtype
            if value.dtype != dtype or value.device != self.offset.device:
                raise _mismatch(name, f"{dtype} on {self.offset.device}", f"{value.dtype} on {value.device}")
        if N and self.face_index.device.type == "cpu":
            low, high = (int(bound) for bound in self.face_index.aminmax())
            if low < 0 or high >= self.face_count:
                raise _mismatch("face_index", f"indices in [0, {self.face_count})", f"[{low}, {high}]")
        if K not in (0, 3, 8, 15):
            raise _mismatch("sh", "0, 3, 8 or 15 coefficients (degrees 0 to 3)", str(K))

    def __len__(self) -> int:
        return len(self.face_index)

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics, 0 to 3."""
        return degree_of(self.sh)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, without face count and topology."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("face_count", "topology")}

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """The opacities of the Gaussians, in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        """The standard deviations in mean edge lengths: `[THICKNESS, exp, exp]`."""
        tangential = torch.exp(self.log_scales)
        return torch.cat([torch.full_like(tangential[:, :1], THICKNESS), tangential], 1)

    def to(self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> BoundGaussians:
        """Return the same Gaussians on another device or with floats of another type."""
        moved = {
            name: value.to(device=device, dtype=dtype if value.is_floating_point() else None)
            for name, value in self.tensors.items()
        }
        return self._with(moved)

    def select(self, index: Bool[Tensor, " N"] | Int[Tensor, " M"]) -> BoundGaussians:
        """Return the Gaussians of a mask or index tensor, in its order."""
        return self._with({name: value[index] for name, value in self.tensors.items()})

    def _with(self, tensors: Mapping[str, Tensor]) -> BoundGaussians:
        """Return Gaussians of the same mesh with other tensors, all of them given."""
        return BoundGaussians(**tensors, face_count=self.face_count, topology=self.topology)

    def check_topology(self, faces: Int[np.ndarray, "F 3"] | Int[Tensor, "F 3"], subject: str = "mesh") -> None:
        """Raise InputError unless `faces` are those that the Gaussians were bound to."""
        if len(faces) != self.face_count or topology_digest(faces) != self.topology:
            raise InputError(
                subject,
                expected=f"the {self.face_count} faces that the Gaussians are bound to",
                received=f"{len(faces)} other faces",
                remedy="use the template that the Gaussians were sampled on, or sample again",
            )


@dataclass(frozen=True, eq=False)
class WorldGaussians:
    """N Gaussians of one or more poses in world coordinates.

    Attributes:
        means: metres.
        quats: wxyz, as long as the local ones: from the Gaussian's axes to the world.
        scales: standard deviations, metres.
        opacities: in (0, 1).
        normals: unit vectors, the first axis of each Gaussian.
    """

    means: Float[Tensor, "*B N 3"]
    quats: Float[Tensor, "*B N 4"]
    scales: Float[Tensor, "*B N 3"]
    opacities: Float[Tensor, " N"]
    normals: Float[Tensor, "*B N 3"]

    __repr__ = one_line


def topology_digest(faces: Int[np.ndarray, "F 3"] | Int[Tensor, "F 3"]) -> str:
    """Return the SHA-256 of the faces as little-endian int64."""
    array = faces.cpu().numpy() if isinstance(faces, Tensor) else np.asarray(faces)
    return hashlib.sha256(np.ascontiguousarray(array, dtype="<i8").tobytes()).hexdigest()


def world_from_local(
    bound: BoundGaussians, vertices: Float[Tensor, "*B V 3"], faces: Int64[Tensor, "F 3"]
) -> WorldGaussians:
    """Transform Gaussians to the world by posed vertices; see `world_from_frames`, which takes computed frames.

    Args:
        bound: the local attributes.
        vertices: of the posed mesh, metres.
        faces: of the mesh that they are bound to.
    """
    return world_from_frames(bound, triangle_frames(vertices, faces))


def world_from_frames(bound: BoundGaussians, frames: TriangleFrames) -> WorldGaussians:
    """Transform Gaussians to the world, with gradients to their attributes and to the vertices.

    `u_w = u v1 + v v2 + (1 - u - v) v3 + R (gamma [1, 0, 0] + du)`, `r_w = R r`, `s_w = e s` with
    `s = [THICKNESS, exp, exp]`, and `normal = R r [1, 0, 0]` (TaoAvatar; offsets are metres, scales are edges).
    float32 on the CPU goes through the native library.

    Raises:
        InputError: frames of another number of faces, type or device.
    """
    if frames.face_count != bound.face_count:
        raise InputError("frames", expected=f"{bound.face_count} triangles", received=str(frames.face_count))
    if frames.lengths.dtype != bound.offset.dtype or frames.lengths.device != bound.offset.device:
        raise InputError(
            "frames",
            expected=f"{bound.offset.dtype} on {bound.offset.device}, as the Gaussians",
            received=f"{frames.lengths.dtype} on {frames.lengths.device}",
        )
    if is_native(bound.offset):
        local = (bound.barycentric, bound.normal_offset, bound.offset, bound.log_scales, bound.quats)
        of_frames = (frames.corners, frames.rotations, frames.quats, frames.lengths)
        means, quats, scales, normals = WorldFunction.apply(THICKNESS, bound.face_index, *local, *of_frames)
        return WorldGaussians(means, quats, scales, bound.opacities, normals)
    return world_from_frames_reference(bound, frames)


def world_from_frames_reference(bound: BoundGaussians, frames: TriangleFrames) -> WorldGaussians:
    """Return `world_from_frames` in plain torch: the oracle of the native kernel, used for other types and devices."""
    # Rows of the frames for each Gaussian: (..., N, 3, 3) rotations R and corners v1, v2, v3.
    rotations = frames.rotations[..., bound.face_index, :, :]
    corners = frames.corners[..., bound.face_index, :, :]
    weights = corner_weights(bound.barycentric)
    # gamma acts along the normal, the first axis of the frame; then u_w = sum of weighted corners + R (gamma n + du).
    normal, median, binormal = bound.offset.unbind(-1)
    local = torch.stack([normal + bound.normal_offset, median, binormal], -1)
    means = (weights[:, :, None] * corners).sum(-2) + (rotations * local[:, None, :]).sum(-1)
    # Compose the Gaussian's rotation in the frame with the frame's own; scales are in edges, so e makes them metres.
    quats = multiply_quats(frames.quats[..., bound.face_index, :], bound.quats)
    scales = frames.lengths[..., bound.face_index, None] * bound.scales
    return WorldGaussians(means, quats, scales, bound.opacities, _first_axes(quats))


def corner_weights(barycentric: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Return the weights of all three corners of a triangle from those of the first two."""
    u, v = barycentric.unbind(-1)
    return torch.stack([u, v, 1.0 - u - v], dim=-1)


def on_triangles(corners: Float[Tensor, "N 3 C"], barycentric: Float[Tensor, "N 2"]) -> Float[Tensor, "N C"]:
    """Interpolate values at the corners of triangles to points in them."""
    return (corner_weights(barycentric)[..., None] * corners).sum(1)


def scale_penalty(bound: BoundGaussians) -> Float[Tensor, ""]:
    """Return the mean of `|relu(s - 0.6)|`, s the tangential scales in mean edge lengths (Qian et al. 2024).

    It keeps Gaussians small: scales up to 0.6 edges are free.
    """
    return torch.relu(torch.exp(bound.log_scales) - 0.6).norm(dim=-1).mean()


def offset_penalty(bound: BoundGaussians, frames: TriangleFrames) -> Float[Tensor, ""]:
    """Return 0.01 times the mean of `relu(|du + gamma [1, 0, 0]| / e - 1)`, e the mean edge length (Qian et al. 2024).

    It keeps Gaussians near their triangles: offsets up to one edge are free. 0.01 weights it against `scale_penalty`.
    """
    # The full offset in the frame, metres: gamma joins the first component, which lies along the normal.
    total = torch.cat([bound.offset[:, :1] + bound.normal_offset[:, None], bound.offset[:, 1:]], 1)
    lengths = gather_rows(frames.lengths, bound.face_index)
    return 0.01 * torch.relu(total.norm(dim=-1) / lengths - 1.0).mean()


def _first_axes(quats: Tensor) -> Tensor:
    """Return the unit x axes rotated by quaternions of any length: (..., 4) -> (..., 3)."""
    # First column of the rotation matrix; division by |q|^2 makes it a unit vector for quaternions of any length.
    w, x, y, z = quats.unbind(-1)
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    axes = torch.stack([ww + xx - yy - zz, 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    return axes / (ww + xx + yy + zz)[..., None]


def _mismatch(name: str, expected: str, received: str) -> InputError:
    return InputError(f"bound Gaussians: {name}", expected=expected, received=received)
