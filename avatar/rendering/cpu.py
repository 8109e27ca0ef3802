"""Rasterise on CPUs: autograd around the native kernels, one camera after another."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.rendering.memory import pooled_empty
from avatar.rendering.native import CameraCall, Workspace
from avatar.rendering.settings import RasterMeta, RasterSettings
from smplxpp.core.errors import InputError

MAX_COUNT = 2**31 - 1
"""Largest number of Gaussians, because lists hold 32-bit indices."""


def rasterize_cpu(
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
    """Return images of D-channel Gaussians in single precision, with gradients to all but `Ks`.

    Runs on `torch.get_num_threads()` threads; the picture is the same for any number of them, the gradients bit for bit
    for a fixed number. Image and alpha are exact to about 1e-6, gradients to about 1e-5 of their largest entry.

    Args:
        means: metres, float32 as all the others.
        quats: wxyz, of any length but 0.
        scales: metres.
        opacities: in [0, 1].
        features: channels, the same for all cameras or those of each.
        viewmats: world to camera, OpenCV's axes.
        Ks: intrinsics in pixels, without skew.
        background: None is 0.
        settings: image size and constants; without `camera_gradients` the poses get none.

    Returns:
        Images, their alpha, and the `RasterMeta`.

    Raises:
        InputError: not float32.
        MemoryError: the lists of Gaussians by tile do not fit.
    """
    # Limits of the kernels: single precision and 32-bit indices.
    if means.dtype != torch.float32:
        raise InputError(
            "means", expected="float32", received=str(means.dtype), remedy='use backend="reference" for float64'
        )
    if len(means) > MAX_COUNT:
        raise InputError("means", expected=f"at most {MAX_COUNT} Gaussians", received=f"{len(means)}")
    if not settings.camera_gradients:
        viewmats = viewmats.detach()
    image, alpha, means2d, radii, depths = _Rasterize.apply(
        means, quats, scales, opacities, features, viewmats, Ks, background, settings
    )
    return image, alpha, RasterMeta(means2d=means2d, radii=radii, depths=depths)


_Inputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]
"""Means, quaternions, scales, opacities, features, poses, intrinsics and background."""


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        background: Tensor | None,
        settings: RasterSettings,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        # Outputs are allocated here, since autograd owns them; the kernels overwrite every entry.
        cameras, count, channels = len(viewmats), len(means), features.shape[-1]
        image = pooled_empty(cameras, settings.height, settings.width, channels)
        alpha = pooled_empty(cameras, settings.height, settings.width, 1)
        means2d, radii = means.new_empty(cameras, count, 2), means.new_empty(cameras, count, 2)
        depths = means.new_empty(cameras, count)
        inputs = (means, quats, scales, opacities, features, viewmats, Ks, background)
        # A backward pass needs its camera's own workspace; without gradients one serves all cameras in turn.
        needed = any(ctx.needs_input_grad)
        ctx.workspaces = [Workspace() for _ in range(cameras if needed else 1)]
        for camera, view in enumerate(_views(inputs, settings)):
            outputs = (image[camera], alpha[camera], means2d[camera], radii[camera], depths[camera])
            ctx.workspaces[camera if needed else 0].forward(view, outputs)
        # Radii decide in the backward pass which Gaussians were visible, so that they are saved beside the inputs.
        ctx.settings = settings
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(means2d, radii, depths)
        ctx.save_for_backward(*inputs, radii)
        return image, alpha, means2d, radii, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        *inputs, radii = ctx.saved_tensors
        *gaussians, features, viewmats, _, background = inputs
        # Neither image nor alpha enters the loss: there is nothing to propagate.
        if grad_image is None and grad_alpha is None:
            return (None,) * 9
        grad_image = None if grad_image is None else grad_image.contiguous()
        grad_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        # The first camera writes these gradients, so that they need no zeros; poses are added to, so that theirs do.
        grads = [torch.empty_like(tensor) for tensor in (*gaussians, features)]
        poses = viewmats.new_zeros(len(viewmats), 3, 4, dtype=torch.float64) if ctx.needs_input_grad[5] else None
        grad_background = torch.empty_like(background) if ctx.needs_input_grad[7] else None
        # Cameras after the first add to the gradients that the first one wrote.
        own_features = features.ndim == 3
        for camera, (view, workspace) in enumerate(
            zip(_views(tuple(inputs), ctx.settings), ctx.workspaces, strict=True)
        ):
            workspace.backward(
                view,
                radii[camera],
                *(None if grad is None else grad[camera] for grad in (grad_image, grad_alpha)),
                (
                    *grads[:4],
                    grads[4][camera] if own_features else grads[4],
                    *(None if grad is None else grad[camera] for grad in (poses, grad_background)),
                ),
                (camera > 0, camera > 0 and not own_features),
            )
        # The last row of a pose is constant (0, 0, 0, 1) and gets gradient 0.
        grad_viewmats = None
        if poses is not None:
            grad_viewmats = torch.zeros_like(viewmats)
            grad_viewmats[:, :3] = poses
        return (*grads, grad_viewmats, None, grad_background, None)


def _views(inputs: _Inputs, settings: RasterSettings) -> list[CameraCall]:
    """Return the arguments of the library for each camera."""
    means, quats, scales, opacities, features, viewmats, Ks, background = inputs
    return [
        CameraCall(
            (means, quats, scales, opacities, features if features.ndim == 2 else features[camera]),
            (viewmats[camera], Ks[camera], None if background is None else background[camera]),
            settings,
        )
        for camera in range(len(viewmats))
    ]
