"""Splats as glTF: points with Khronos's extension KHR_gaussian_splatting (release candidate of July 2026)."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import numpy as np
import pygltflib
from jaxtyping import Float32, UInt16

from avatar.formats.harmonics import C0
from avatar.formats.splats import Splats
from smplxpp.core.colors import decode_srgb
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.export.gltf_buffers import BufferBuilder

EXTENSION = "KHR_gaussian_splatting"


def write_splat_glb(path: str | Path, splats: Splats) -> None:
    """Write splats as a GLB, whole or not at all; the same splats give the same bytes.

    Kept: everything in float32 but normals, which the extension has no place for. Scales and opacities are linear,
    rotations xyzw of length 1, harmonics as they stand; colours are sRGB, in which splats are blended. Programs without
    the extension see points in their colours (`COLOR_0`, linear). The axes are ours: metres, +Y up.

    Raises:
        InputError: no splats, which glTF cannot say.
    """
    if not len(splats):
        raise InputError(f"splats for {path}", expected="at least one", received="none")
    gltf = pygltflib.GLTF2(
        asset=pygltflib.Asset(version="2.0", generator=f"smplxpp {metadata.version('smplxpp')}"),
        scene=0,
        extensionsUsed=[EXTENSION],
    )
    buffers = BufferBuilder(gltf)
    attributes = {
        "POSITION": buffers.add(splats.means, target=pygltflib.ARRAY_BUFFER, bounds=True),
        "COLOR_0": buffers.add(_point_colors(splats), target=pygltflib.ARRAY_BUFFER, normalized=True),
    }
    for name, values in _fields(splats).items():
        attributes[f"{EXTENSION}:{name}"] = buffers.add(values, target=pygltflib.ARRAY_BUFFER)
    primitive = pygltflib.Primitive(attributes=pygltflib.Attributes(**attributes), mode=pygltflib.POINTS)
    primitive.extensions = {
        EXTENSION: {
            "kernel": "ellipse",
            "colorSpace": "srgb_rec709_display",
            "projection": "perspective",
            "sortingMethod": "cameraDistance",
        }
    }
    gltf.meshes.append(pygltflib.Mesh(name="splats", primitives=[primitive]))
    gltf.nodes.append(pygltflib.Node(name="splats", mesh=0))
    gltf.scenes = [pygltflib.Scene(name="splats", nodes=[0])]
    atomic_write_bytes(path, buffers.glb())


def _fields(splats: Splats) -> dict[str, Float32[np.ndarray, "N ..."]]:
    """Return what the extension names, in its terms."""
    fields = {
        "ROTATION": np.roll(splats.unit_quats, -1, axis=1),
        "SCALE": np.exp(splats.log_scales),
        "OPACITY": splats.opacities.astype(np.float32),
        "SH_DEGREE_0_COEF_0": splats.f_dc,
    }
    first = 0
    for degree in range(1, splats.degree + 1):
        for k in range(2 * degree + 1):
            fields[f"SH_DEGREE_{degree}_COEF_{k}"] = splats.f_rest[:, first + k]
        first += 2 * degree + 1
    return fields


def _point_colors(splats: Splats) -> UInt16[np.ndarray, "N 4"]:
    """Return linear colours without what depends on the view, and opacities, in 16 bits."""
    srgb = np.clip(0.5 + C0 * splats.f_dc.astype(np.float64), 0.0, 1.0)
    return np.rint(65535.0 * np.hstack([decode_srgb(srgb), splats.opacities[:, None]])).astype(np.uint16)
