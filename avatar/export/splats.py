"""World-space splats and their PLY, in the layout of 3D Gaussian Splatting that other viewers read."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from avatar.export.ply_header import PlyLayout, read_ply_layout
from avatar.gaussians.binding import THICKNESS, BoundGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.spherical_harmonics import C0, rotate_sh
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.files.paths import read_bytes

_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_DC = tuple(f"f_dc_{k}" for k in range(3))
_SCALE = tuple(f"scale_{k}" for k in range(3))
_ROTATION = tuple(f"rot_{k}" for k in range(4))
_OPACITY = ("opacity",)
_REST_COUNTS = (0, 9, 24, 45)


@dataclass(frozen=True, eq=False, kw_only=True)
class Splats:
    """N Gaussians in the world as the file holds them; the arrays are kept as float32.

    Attributes:
        means: metres.
        normals: unit, or 0 where unknown.
        f_dc: coefficients of degree 0: the colour without view dependence is `0.5 + C0 f_dc`.
        f_rest: coefficients of degree 1 and up in the world's axes; K = 0, 3, 8 or 15.
        opacity_logits: before the sigmoid.
        log_scales: logarithms of the standard deviations in metres.
        quats: wxyz, any length but zero.

    Raises:
        InputError: arrays that do not fit each other, NaN or infinity, a quaternion of length 0.
    """

    means: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    f_dc: Float[np.ndarray, "N 3"]
    f_rest: Float[np.ndarray, "N K 3"]
    opacity_logits: Float[np.ndarray, " N"]
    log_scales: Float[np.ndarray, "N 3"]
    quats: Float[np.ndarray, "N 4"]

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, np.ascontiguousarray(getattr(self, f.name), dtype=np.float32))
        N, K = len(self.means), self.f_rest.shape[1] if self.f_rest.ndim == 3 else -1
        shapes: dict[str, tuple[int, ...]] = {
            "means": (N, 3),
            "normals": (N, 3),
            "f_dc": (N, 3),
            "f_rest": (N, K, 3),
            "opacity_logits": (N,),
            "log_scales": (N, 3),
            "quats": (N, 4),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise InputError(f"splats: {name}", expected=f"shape {shape}", received=f"shape {value.shape}")
            if not np.isfinite(value).all():
                bad = int(np.argmin(np.isfinite(value.reshape(N, -1)).all(1)))
                raise InputError(
                    f"splats: {name}", expected="finite float32 values", received=f"others, first in splat {bad}"
                )
        if 3 * K not in _REST_COUNTS:
            raise InputError("splats: f_rest", expected="0, 3, 8 or 15 coefficients", received=str(K))
        if N and not self.quats.any(1).all():
            raise InputError("splats: quats", expected="quaternions of some length", received="zeros")

    def __len__(self) -> int:
        return len(self.means)


def posed_splats(bound: BoundGaussians, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> Splats:
    """Return bound Gaussians as world-space splats of one pose, the colours' harmonics turned into the world.

    Viewers evaluate colours in the world's axes, ours live in the triangles' frames: `rotate_sh` takes each Gaussian's
    coefficients there. `f_dc = (dc - 0.5) / C0`. Computed in float64, kept in float32.

    Args:
        bound: the local attributes.
        vertices: of the posed mesh, metres.
        faces: of the mesh that they are bound to.
    """
    with torch.no_grad():
        bound = bound.to(dtype=torch.float64)
        frames = triangle_frames(vertices.double(), faces)
        world = world_from_frames(bound, frames)
        log_local = torch.cat([torch.full_like(bound.log_scales[:, :1], math.log(THICKNESS)), bound.log_scales], 1)
        arrays = {
            "means": world.means,
            "normals": world.normals,
            "f_dc": (bound.dc - 0.5) / C0,
            "f_rest": rotate_sh(bound.sh, frames.rotations[bound.face_index]),
            "opacity_logits": bound.opacity_logits,
            "log_scales": log_local + torch.log(frames.lengths[bound.face_index, None]),
            "quats": torch.nn.functional.normalize(world.quats, dim=-1),
        }
        return Splats(**{name: value.cpu().numpy() for name, value in arrays.items()})


def write_splat_ply(path: str | Path, splats: Splats) -> None:
    """Write splats as a binary little-endian PLY, whole or not at all.

    Properties, all float, in 3DGS's order: `x y z nx ny nz f_dc_0..2 f_rest_0..3K-1 opacity scale_0..2 rot_0..3`.
    `f_rest` is channel-major: all red coefficients, then green, then blue.
    """
    K = splats.f_rest.shape[1]
    names = (*_POSITION, *_NORMAL, *_DC, *_rest_names(3 * K), *_OPACITY, *_SCALE, *_ROTATION)
    columns = (
        splats.means,
        splats.normals,
        splats.f_dc,
        splats.f_rest.transpose(0, 2, 1).reshape(len(splats), 3 * K),
        splats.opacity_logits[:, None],
        splats.log_scales,
        splats.quats,
    )
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    table = np.concatenate(columns, axis=1, dtype="<f4")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(table.data)


def read_splat_ply(path: str | Path) -> Splats:
    """Read a binary PLY of splats: properties in any order, of any number type, others beside them ignored.

    Normals may be missing (they are 0 then). Values of another type than float are converted to it.

    Raises:
        InputError: a missing, damaged, truncated or text file, properties that lack, values that are not finite.
    """
    path = Path(path)
    subject = f"splats {path}"
    data = read_bytes(path, subject="splats")
    layout = read_ply_layout(data, subject)
    names = layout.dtype.names or ()
    rest = [name for name in names if name.startswith("f_rest_")]
    required = (*_POSITION, *_DC, *_rest_names(len(rest)), *_OPACITY, *_SCALE, *_ROTATION)
    missing = [name for name in required if name not in names]
    if missing or len(rest) not in _REST_COUNTS:
        raise InputError(
            subject,
            expected=f"the properties of 3D Gaussian Splatting, {_REST_COUNTS} of them f_rest",
            received=f"no {', '.join(missing)}" if missing else f"{len(rest)} of f_rest",
            remedy="export it as a splat PLY, not as a point cloud",
        )
    table = _vertex_table(data, layout, subject)

    def columns(wanted: tuple[str, ...]) -> np.ndarray:
        out = np.empty((len(table), len(wanted)), np.float32)
        with np.errstate(over="ignore"):  # what does not fit becomes infinite and is refused below
            for k, name in enumerate(wanted):
                out[:, k] = table[name]
        return out

    K = len(rest) // 3
    try:
        return Splats(
            means=columns(_POSITION),
            normals=columns(_NORMAL) if set(_NORMAL) <= set(names) else np.zeros((len(table), 3), np.float32),
            f_dc=columns(_DC),
            f_rest=columns(_rest_names(len(rest))).reshape(len(table), 3, K).transpose(0, 2, 1),
            opacity_logits=columns(_OPACITY)[:, 0],
            log_scales=columns(_SCALE),
            quats=columns(_ROTATION),
        )
    except InputError as error:
        raise InputError(f"{subject}: {error.subject}", expected=error.expected, received=error.received) from None


def _vertex_table(data: bytes, layout: PlyLayout, subject: str) -> np.ndarray:
    size = layout.count * layout.dtype.itemsize
    if len(data) < layout.start + size:
        raise InputError(
            subject,
            expected=f"{size} bytes of {layout.count} splats",
            received=f"{max(0, len(data) - layout.start)}",
            remedy="the file is truncated: copy it again",
        )
    return np.frombuffer(data, layout.dtype, layout.count, layout.start)


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{k}" for k in range(count))
