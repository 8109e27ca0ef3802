"""Splats as a PLY in the layout of 3D Gaussian Splatting."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatar.formats.ply_header import PlyLayout, read_ply_layout
from avatar.formats.splats import REST_COUNTS, Splats
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.files.paths import read_bytes

_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_DC = tuple(f"f_dc_{k}" for k in range(3))
_SCALE = tuple(f"scale_{k}" for k in range(3))
_ROTATION = tuple(f"rot_{k}" for k in range(4))
_OPACITY = ("opacity",)


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
    if missing or len(rest) not in REST_COUNTS:
        raise InputError(
            subject,
            expected=f"the properties of 3D Gaussian Splatting, {REST_COUNTS} of them f_rest",
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
