"""Rasterise Gaussians with gradients: check arguments, choose the backend by device, add depth on request."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.rendering.reference import camera_depths, rasterize_reference
from avatar.rendering.settings import RasterMeta, RasterSettings, check_layout, check_values, checked_settings
from smplxpp.core.errors import InputError

BACKENDS = ("cpu", "gsplat", "reference")
DEPTHS = ("accumulated", "expected")


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    features: Float[Tensor, "N D"] | Float[Tensor, "C N D"],
    viewmats: Float[Tensor, "C 4 4"],
    Ks: Float[Tensor, "C 3 3"],
    width: int,
    height: int,
    *,
    background: Float[Tensor, " D"] | Float[Tensor, "C D"] | None = None,
    near: float = 0.01,
    far: float = 1e10,
    eps2d: float = 0.3,
    depth: Literal["accumulated", "expected"] | None = None,
    camera_gradients: bool = False,
    backend: Literal["cpu", "gsplat", "reference"] | None = None,
    check: bool = True,
) -> tuple[Float[Tensor, "C H W D"], Float[Tensor, "C H W 1"], RasterMeta]:
    """Return images of 3D Gaussians with any number of channels, with gradients; gsplat's semantics on every backend.

    A Gaussian's opacity at a pixel centre p is `alpha = min(0.999, o exp(-sigma))`,
    `sigma = (p - m)^T S^-1 (p - m) / 2`, with m and S its projected centre and covariance (blurred by `eps2d`).
    Gaussians are blended nearest first, `image = sum_i f_i alpha_i T_i + T background`,
    `T_i = prod_{j<i} (1 - alpha_j)`; alpha below 1/255 is skipped, and blending stops before T would fall to 1e-4
    (Kerbl et al. 2023; `docs/rendering.md` has every rule).

    Gradients reach means, quats, scales, opacities, features and background, and viewmats if `camera_gradients`.
    `backend="reference"` also gives those of Ks.

    Args:
        means: centres in the world, metres. N may be 0.
        quats: rotations, wxyz, of any length but 0.
        scales: standard deviations along the rotated axes, metres, positive.
        opacities: in [0, 1].
        features: D channels, given a camera where they differ from camera to camera (colours that depend on the view).
        viewmats: world to camera: x right, y down, z forward.
        Ks: intrinsics in pixels, without skew; pixel centres at +0.5.
        width: of every image, pixels.
        height: of every image, pixels.
        background: one for all cameras or one for each; None is 0.
        near: metres along z; a Gaussian with a nearer centre is dropped.
        far: metres along z; a Gaussian with a farther centre is dropped.
        eps2d: pixels squared added to the diagonal of the projected covariance.
        depth: also blend z in metres, as `meta.depth`: "accumulated" is `sum alpha_i T_i z_i`, "expected" that over
            alpha, and 0 where alpha is 0. It has gradients to means (and viewmats).
        camera_gradients: gradients to `viewmats`, which are constants otherwise.
        backend: None takes "gsplat" for CUDA tensors and "cpu" for float32 tensors on the CPU. "reference" is the slow
            oracle, in any dtype and on any device.
        check: whether to refuse NaN and invalid values. Without the check they give undefined images.

    Returns:
        Images, their alpha before the background, and the `RasterMeta`.

    Raises:
        InputError: an invalid argument.
        MissingExtraError: CUDA tensors, and gsplat is not installed.

    Example:
        >>> image, alpha, meta = rasterize(means, quats, scales, opacities, colors, viewmats, Ks, 512, 512)
        >>> (image - photograph).abs().mean().backward()
    """
    # Named arguments, so that errors can name the one that is at fault; their order is that of the backends' signature.
    settings = checked_settings(RasterSettings(width, height, near, far, eps2d, camera_gradients))
    tensors = dict(
        zip(
            ("means", "quats", "scales", "opacities", "features", "viewmats", "Ks"),
            (means, quats, scales, opacities, features, viewmats, Ks),
            strict=True,
        )
    )
    # Layout first, then values, because the checks of values assume right shapes.
    check_layout(tensors, background)
    draw = _choose_backend(backend, means, Ks)
    if depth is not None and depth not in DEPTHS:
        raise InputError("depth", expected=f"None or one of {', '.join(DEPTHS)}", received=repr(depth))
    if check:
        check_values(tensors, background)

    # Poses are constants unless asked for, which saves their backward pass.
    if not camera_gradients:
        tensors["viewmats"] = viewmats.detach()
    if background is not None:
        background = background.expand(len(viewmats), -1)
    # Depth is blended as one more channel with the same weights alpha_i T_i, and 0 on the background.
    if depth is not None:
        tensors["features"], background = _with_depth_channel(tensors, background)
    # The kernels need at least one Gaussian and one camera.
    if len(means) == 0 or len(viewmats) == 0:
        image, alpha, meta = _draw_nothing(tensors, background, settings)
    else:
        tensors = {name: tensor.contiguous() for name, tensor in tensors.items()}
        background = None if background is None else background.contiguous()
        image, alpha, meta = draw(*tensors.values(), background, settings)
    if depth is None:
        return image, alpha, meta
    # Take the channel of depth off again; "expected" divides by the sum of the weights, which is alpha.
    image, blended = image[..., :-1], image[..., -1:]
    return image, alpha, dataclasses.replace(meta, depth=blended if depth == "accumulated" else _divide(blended, alpha))


def _choose_backend(name: str | None, means: Tensor, Ks: Tensor) -> Callable[..., tuple[Tensor, Tensor, RasterMeta]]:
    """Return the backend's function, imported when it is first needed."""
    if name is not None and name not in BACKENDS:
        raise InputError("backend", expected=f"None or one of {', '.join(BACKENDS)}", received=repr(name))
    if name == "reference":
        return rasterize_reference
    # CUDA tensors go to gsplat, all others to the CPU's kernels; both take float32 alone.
    chosen = name or ("gsplat" if means.is_cuda else "cpu")
    device = "cuda" if chosen == "gsplat" else "cpu"
    if means.device.type != device or means.dtype != torch.float32:
        raise InputError(
            "means",
            expected=f"float32 on {device} for the backend {chosen}",
            received=f"{means.dtype} on {means.device}",
            remedy="call .float(), or name backend='reference' for float64 (slow)",
        )
    if Ks.requires_grad:
        raise InputError(
            "Ks",
            expected=f"a constant: the backend {chosen} gives it no gradient",
            received="requires_grad=True",
            remedy="detach it, or name backend='reference'",
        )
    if chosen == "gsplat":
        from avatar.rendering.gsplat_backend import rasterize_gsplat

        return rasterize_gsplat
    from avatar.rendering.cpu import rasterize_cpu

    return rasterize_cpu


def _with_depth_channel(tensors: dict[str, Tensor], background: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Return features with the Gaussians' z as one more channel, and the background with 0 there."""
    # Depth differs from camera to camera: features that all cameras share are then repeated for each camera.
    features, depths = tensors["features"], camera_depths(tensors["means"], tensors["viewmats"])
    cameras = len(depths)
    if cameras == 1 and features.ndim == 2:
        features = torch.cat([features, depths[0, :, None]], dim=-1)
    else:
        features = torch.cat([features.expand(cameras, -1, -1), depths[..., None]], dim=-1)
    return features, None if background is None else torch.nn.functional.pad(background, (0, 1))


def _draw_nothing(
    tensors: dict[str, Tensor], background: Tensor | None, settings: RasterSettings
) -> tuple[Tensor, Tensor, RasterMeta]:
    """Return the background alone, for no Gaussians or no cameras; a result with (zero) gradients."""
    # Zero times the sum of all inputs keeps the graph, so that a backward pass gives zeros instead of an error.
    cameras, count, features = len(tensors["viewmats"]), len(tensors["means"]), tensors["features"]
    nothing = torch.stack([tensor.sum() for tensor in tensors.values()]).sum() * 0
    image = nothing.expand(cameras, settings.height, settings.width, features.shape[-1])
    if background is not None:
        image = image + background[:, None, None, :]
    alpha = nothing.expand(cameras, settings.height, settings.width, 1)
    per_gaussian = features.new_zeros(cameras, count, 2)
    return image, alpha, RasterMeta(means2d=per_gaussian, radii=per_gaussian, depths=per_gaussian[..., 0])


def _divide(blended: Tensor, alpha: Tensor) -> Tensor:
    """Return `blended / alpha`, and 0 with gradient 0 where alpha is 0."""
    # The inner `where` keeps a division by 0 out of the graph: its NaN gradient would pass the outer one.
    seen = alpha > 0
    return torch.where(seen, blended / torch.where(seen, alpha, 1.0), 0.0)
