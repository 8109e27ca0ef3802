"""Splats as USD: a particle field of Gaussians (UsdVol), still or moving."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from avatar.formats.splats import Splats
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.export.usd_stage import open_usd, usd_modules

_REACH = 3.0  # standard deviations that a splat is drawn to


def write_splat_usd(path: str | Path, frames: Iterable[Splats], *, fps: float | None = None) -> None:
    """Write splats as a stage with one `ParticleField3DGaussianSplat`, whole or not at all.

    Kept: everything in float32 but normals. Scales and opacities are linear; the coefficient of degree 0 comes first
    among a splat's harmonics. Metres, +Y up.

    Args:
        path: .usda, .usdc or .usd.
        frames: of one avatar, one after the other. fps: how many a second; None: there is one, which stands still.

    Raises:
        InputError: another suffix, no frames, frames of other numbers of splats.
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
            if k == 0:
                count, degree = len(splats), splats.degree
                harmonics("radiance:sphericalHarmonicsDegree").Set(degree)
            if (len(splats), splats.degree) != (count, degree):
                raise InputError(
                    f"frame {k} for {path}",
                    expected=f"{count} splats with harmonics of degree {degree}, as in frame 0",
                    received=f"{len(splats)} of degree {splats.degree}",
                )
            time = pxr.Usd.TimeCode.Default() if fps is None else pxr.Usd.TimeCode(k)
            scales = np.exp(splats.log_scales)
            xyzw = np.roll(splats.unit_quats, -1, axis=1)
            coefficients = np.concatenate([splats.f_dc[:, None], splats.f_rest], axis=1).reshape(-1, 3)
            reach = _REACH * scales.max(axis=1, initial=0.0)[:, None]
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
