"""Write splats into scene files: glTF with Khronos's KHR_gaussian_splatting, and USD particle fields."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import numpy as np
import pygltflib
from jaxtyping import Float32, UInt16

from avatar.formats.splats import Splats
from smplxpp.core.colors import decode_srgb
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.spherical_harmonics import C0
from smplxpp.export.gltf_buffers import BufferBuilder
from smplxpp.export.usd_stage import open_usd, usd_modules

EXTENSION = "KHR_gaussian_splatting"
"""The glTF extension, in its release candidate of July 2026."""


def write_splat_glb(path: str | Path, splats: Splats) -> None:
    """Write splats as a GLB; the same splats give the same bytes, and a failed write leaves no file.

    All attributes are kept in float32 except normals, which the extension does not have. Scales and opacities are
    linear, rotations xyzw of length 1, harmonics unchanged; colours are sRGB, the space in which splats are blended.
    Programs without the extension see points in their colours (`COLOR_0`, linear). The axes are ours: metres, +Y up.

    Raises:
        InputError: no splats, which glTF cannot express.
    """
    if not len(splats):
        raise InputError(f"splats for {path}", expected="at least one", received="none")
    # The file works without the extension: `extensionsUsed` lists it, `extensionsRequired` does not.
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
    # The extension's attributes, then its constants.
    for name, values in _extension_attributes(splats).items():
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
    # A scene with one node and one mesh of points.
    gltf.meshes.append(pygltflib.Mesh(name="splats", primitives=[primitive]))
    gltf.nodes.append(pygltflib.Node(name="splats", mesh=0))
    gltf.scenes = [pygltflib.Scene(name="splats", nodes=[0])]
    atomic_write_bytes(path, buffers.glb())


def _extension_attributes(splats: Splats) -> dict[str, Float32[np.ndarray, "N ..."]]:
    """Return the attributes of the extension by its names."""
    fields = {
        "ROTATION": np.roll(splats.unit_quats, -1, axis=1),
        "SCALE": np.exp(splats.log_scales),
        "OPACITY": splats.opacities.astype(np.float32),
        "SH_DEGREE_0_COEF_0": splats.f_dc,
    }
    # Degree d has 2 d + 1 coefficients, one after the other in `f_rest`.
    first = 0
    for degree in range(1, splats.degree + 1):
        for k in range(2 * degree + 1):
            fields[f"SH_DEGREE_{degree}_COEF_{k}"] = splats.f_rest[:, first + k]
        first += 2 * degree + 1
    return fields


def _point_colors(splats: Splats) -> UInt16[np.ndarray, "N 4"]:
    """Return linear view-independent colours and opacities in 16 bits, for viewers without the extension."""
    srgb = np.clip(0.5 + C0 * splats.f_dc.astype(np.float64), 0.0, 1.0)
    return np.rint(65535.0 * np.hstack([decode_srgb(srgb), splats.opacities[:, None]])).astype(np.uint16)


def write_splat_usd(path: str | Path, frames: Iterable[Splats], *, fps: float | None = None) -> None:
    """Write splats as a stage with one `ParticleField3DGaussianSplat`; a failed write leaves no file.

    All attributes are kept in float32 except normals. Scales and opacities are linear; the coefficient of degree 0
    comes first among a splat's harmonics. Metres, +Y up.

    Args:
        path: .usda, .usdc or .usd.
        frames: of one avatar, in order of time.
        fps: frames a second; None for a single still frame.

    Raises:
        InputError: another suffix, no frames, frames with different numbers of splats.
        MissingExtraError: no usd-core, or one without particle fields (before 26.03).
    """
    pxr = usd_modules("splats as USD")
    if not hasattr(pxr.UsdVol, "ParticleField3DGaussianSplat"):
        raise MissingExtraError("usd-core>=26.3", extra="usd", purpose="splats as USD")
    Vt = pxr.Vt
    with open_usd(path, default="splats", fps=fps) as stage:
        field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")
        field.CreateSortingModeHintAttr("zDepth")
        harmonics = field.GetPrim().GetAttribute
        count, degree, k = -1, -1, -1
        for k, splats in enumerate(frames):
            # Animated attributes of USD keep their length: all frames have the splats and the degree of the first.
            if k == 0:
                count, degree = len(splats), splats.degree
                harmonics("radiance:sphericalHarmonicsDegree").Set(degree)
            if (len(splats), splats.degree) != (count, degree):
                raise InputError(
                    f"frame {k} for {path}",
                    expected=f"{count} splats with harmonics of degree {degree}, as in frame 0",
                    received=f"{len(splats)} of degree {splats.degree}",
                )
            # Values at the default time are constant; a still picture needs no samples in time.
            time = pxr.Usd.TimeCode.Default() if fps is None else pxr.Usd.TimeCode(k)
            scales = np.exp(splats.log_scales)
            xyzw = np.roll(splats.unit_quats, -1, axis=1)
            coefficients = np.concatenate([splats.f_dc[:, None], splats.f_rest], axis=1).reshape(-1, 3)
            # The extent covers three standard deviations of every splat.
            reach = 3.0 * scales.max(axis=1, initial=0.0)[:, None]
            extent = np.stack([(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)])
            for name, value in (
                ("positions", Vt.Vec3fArray.FromNumpy(splats.means)),
                ("orientations", Vt.QuatfArray.FromNumpy(np.ascontiguousarray(xyzw))),
                ("scales", Vt.Vec3fArray.FromNumpy(scales)),
                ("opacities", Vt.FloatArray.FromNumpy(splats.opacities.astype(np.float32))),
                ("radiance:sphericalHarmonicsCoefficients", Vt.Vec3fArray.FromNumpy(coefficients)),
                ("extent", Vt.Vec3fArray.FromNumpy(extent.astype(np.float32))),
            ):
                field.GetPrim().GetAttribute(name).Set(value, time)
        if not count > 0:
            raise InputError(f"splats for {path}", expected="at least one, in at least one frame", received="none")
        if fps is not None:
            stage.SetEndTimeCode(k)
