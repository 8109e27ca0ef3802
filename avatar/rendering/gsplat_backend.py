"""Rasterise on CUDA by gsplat's kernels, with the signature of all backends.

gsplat compiles its kernels at import, and fails without a GPU, so it is imported only for CUDA tensors.
"""

from __future__ import annotations

from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.rendering.reference import camera_depths
from avatar.rendering.settings import RasterMeta, RasterSettings
from smplxpp.core.errors import InputError, MissingExtraError

SUPPORTED = "1.5."
"""Releases of gsplat with these semantics; from 1.6 on alpha is clamped to 0.99 rather than 0.999."""


def rasterize_gsplat(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    features: Float[Tensor, "N D"] | Float[Tensor, "C N D"],
    viewmats: Float[Tensor, "C 4 4"],
    Ks: Float[Tensor, "C 3 3"],
    background: Float[Tensor, "C D"] | None,
    settings: RasterSettings,
) -> tuple[Float[Tensor, "C H W D"], Float[Tensor, "C H W 1"], RasterMeta]:
    """Return the result of `rasterize_reference` on a GPU in float32, without a gradient to `Ks`.

    Its gradients are summed by atomic additions: two runs differ in the last digits.

    Raises:
        MissingExtraError: gsplat is not installed.
        InputError: the machine has no GPU that torch can use, or gsplat's version or its compiled kernels do not fit.
    """
    # Options that make gsplat follow the common rules: all Gaussians kept whatever their radius, no packing, colours as
    # they are (no harmonics), and no compensation of the blur in the opacity ("classic").
    gsplat = _load_gsplat()
    image, alpha, found = gsplat.rasterization(
        means,
        quats,
        scales,
        opacities,
        features,
        viewmats,
        Ks,
        settings.width,
        settings.height,
        near_plane=settings.near,
        far_plane=settings.far,
        radius_clip=0.0,
        eps2d=settings.eps2d,
        sh_degree=None,
        packed=False,
        backgrounds=background,
        render_mode="RGB",
        rasterize_mode="classic",
        camera_model="pinhole",
    )
    radii = found["radii"].to(means.dtype)
    # gsplat leaves culled Gaussians uninitialised.
    means2d = torch.where((radii > 0).all(-1, keepdim=True), found["means2d"].detach(), 0.0)
    depths = camera_depths(means.detach(), viewmats.detach())
    return image, alpha, RasterMeta(means2d=means2d, radii=radii, depths=depths)


def _load_gsplat() -> ModuleType:
    # Device, package, version and compiled kernels are checked in this order, each with its own remedy.
    if not torch.cuda.is_available():
        raise InputError(
            "backend gsplat",
            expected="a CUDA device that torch can use",
            received="none",
            remedy="leave the tensors on the CPU, which has a backend of its own",
        )
    try:
        import gsplat
    except ModuleNotFoundError as error:
        if error.name != "gsplat":
            raise
        raise MissingExtraError("gsplat", extra="cuda", purpose="rasterising CUDA tensors") from error
    # Another release may draw other pictures: the rules of clamping are part of the results.
    if not gsplat.__version__.startswith(SUPPORTED):
        raise InputError(
            "gsplat",
            expected=f"version {SUPPORTED}x, whose alpha is clamped to 0.999",
            received=gsplat.__version__,
            remedy="run pip install 'gsplat>=1.5.3,<1.6'",
        )
    from gsplat.cuda import _backend

    if _backend._C is None:
        raise InputError(
            "gsplat",
            expected="compiled kernels",
            received="none: no CUDA toolkit was found to compile them with",
            remedy="install nvcc of the CUDA version that torch was built for, and set CUDA_HOME",
        )
    return gsplat
