"""Rasterise in plain torch, for any dtype and device: the oracle of the fast backends.

It defines every rule exactly (what is skipped, where blending stops). It works on blocks of pixels, so that memory
stays bounded and autograd can give all gradients, and is not optimised otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.gaussians.tensor_operations import matrix_from_quat
from avatar.rendering.settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, RasterMeta, RasterSettings

BLOCK = 16
"""Side in pixels of the square blocks that are blended at once."""


def rasterize_reference(
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
    """Return images by alpha blending front to back, with gradients to every tensor, `Ks` included.

    The semantics are those of gsplat's classic mode: EWA splatting (Zwicker et al. 2001) as in 3D Gaussian Splatting
    (Kerbl et al. 2023). See `docs/rendering.md` for the equations.

    Args:
        means: centres in the world, metres.
        quats: rotations, wxyz, of any length but 0.
        scales: standard deviations along the rotated axes, metres.
        opacities: in [0, 1].
        features: channels, the same for all cameras or those of each.
        viewmats: world to camera, OpenCV's axes.
        Ks: intrinsics in pixels, without skew.
        background: None is 0.
        settings: image size and constants.

    Returns:
        Images, their alpha, and the `RasterMeta`.
    """
    # Cameras are independent: each is projected and blended alone, and the results are stacked along the axis C.
    views = [
        _render_view(
            _project(means, quats, scales, opacities, viewmat, K, settings),
            opacities,
            features if features.ndim == 2 else features[camera],
            settings,
        )
        for camera, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True))
    ]
    image, transmittance = (torch.stack(parts) for parts in zip(*(view[:2] for view in views), strict=True))
    # What is left of the light after all Gaussians passes through to the background: image + T B.
    if background is not None:
        image = image + transmittance * background[:, None, None, :]
    means2d, radii, depths = (torch.stack(parts) for parts in zip(*(view[2] for view in views), strict=True))
    return image, 1 - transmittance, RasterMeta(means2d=means2d, radii=radii, depths=depths)


@dataclass(frozen=True)
class _Splats:
    """The M of the N Gaussians that a camera can see, nearest first."""

    index: Tensor  # (M,) indices among the N
    means2d: Tensor  # (M, 2) pixels
    conics: Tensor  # (M, 3) inverse covariance in the image: xx, xy, yy
    radii: Tensor  # (M, 2) half width and height in pixels of the box outside of which alpha < ALPHA_MIN
    depths: Tensor  # (N,) of all Gaussians, culled or not


def camera_depths(means: Float[Tensor, "N 3"], viewmats: Float[Tensor, "C 4 4"]) -> Float[Tensor, "C N"]:
    """Return the metres along each camera's z of points in the world."""
    return viewmats[:, 2, :3] @ means.T + viewmats[:, 2, 3, None]


def _project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    settings: RasterSettings,
) -> _Splats:
    """Take Gaussians to the image of one camera; drops those that cannot reach a pixel, sorts the rest by depth."""
    cam_from_world = viewmat[:3, :3]
    centers = means @ cam_from_world.T + viewmat[:3, 3]
    depths = centers[:, 2]
    # Dropped before anything is divided by their depth: a NaN behind the camera would reach the gradients.
    near_to_far = (depths >= settings.near) & (depths <= settings.far) & (opacities >= ALPHA_MIN)
    index = near_to_far.nonzero()[:, 0]
    index = index[torch.argsort(depths[index], stable=True)]

    # Covariance in the image by EWA splatting: S = J W R diag(s)^2 R^T W^T J^T + eps2d I, computed as half half^T with
    # half = J W R diag(s), so that it is symmetric and positive semi-definite by construction.
    axes = matrix_from_quat(quats[index]) * scales[index, None, :]
    half = _projection_jacobian(centers[index], K, settings) @ cam_from_world @ axes
    covariance = half @ half.mT + settings.eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    # Centres by the pinhole model, in pixels: f x / z + c.
    focal, principal = K.diagonal()[:2], K[:2, 2]
    means2d = focal * centers[index, :2] / depths[index, None] + principal

    # A covariance of rounded determinant 0 or less has no inverse,
    # so such a splat (seen edge-on, without blur) is dropped.
    determinant = xx * yy - xy * xy
    # alpha = o exp(-sigma) reaches ALPHA_MIN where sigma = ln(o / ALPHA_MIN); its box has these half sides.
    reach = (2 * torch.log(opacities[index].detach() / ALPHA_MIN)).sqrt()
    radii = reach[:, None] * torch.stack([xx, yy], -1).detach().sqrt()
    # The box of half sides reach sqrt(xx) and reach sqrt(yy) encloses
    # the ellipse; splats whose box misses the image are dropped.
    size = means2d.new_tensor([settings.width, settings.height])
    seen = (determinant > 0) & ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
    conics = torch.stack([yy[seen], -xy[seen], xx[seen]], -1) / determinant[seen, None]
    return _Splats(index[seen], means2d[seen], conics, radii[seen], depths)


def _projection_jacobian(centers: Tensor, K: Tensor, settings: RasterSettings) -> Tensor:
    """Return the (M, 2, 3) derivative of pixels by points in camera space, at `centers` clamped to a wider frustum."""
    # Clamp of the point at which the projection is linearised: this share of half the image outside of its
    # border.
    frustum_margin = 0.3
    size = centers.new_tensor([settings.width, settings.height])
    focal, principal = K.diagonal()[:2], K[:2, 2]
    # Far outside of the image the affine approximation of the projection grows without
    # bound; the point at which it is taken is therefore clamped in x / z and y / z.
    # Pixels are u = f x / z + c, so du/dx = f / z and du/dz = -(f / z) (x / z).
    margin = frustum_margin * 0.5 * size / focal
    z = centers[:, 2:]
    slope = torch.clamp(centers[:, :2] / z, -principal / focal - margin, (size - principal) / focal + margin)
    return torch.cat([torch.diag_embed(focal / z), (-focal * slope / z)[..., None]], dim=-1)


def _render_view(
    splats: _Splats, opacities: Tensor, features: Tensor, settings: RasterSettings
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Return blended features (H, W, D), what is left of the light (H, W, 1), and (means2d, radii, depths) of all N."""
    # Blocks bound the memory: a block holds 256 pixels times the Gaussians that reach it.
    rows = []
    for top in range(0, settings.height, BLOCK):
        bottom = min(top + BLOCK, settings.height)
        blocks = [
            _blend_block(splats, opacities, features, (left, top, min(left + BLOCK, settings.width), bottom))
            for left in range(0, settings.width, BLOCK)
        ]
        rows.append([torch.cat(parts, dim=1) for parts in zip(*blocks, strict=True)])
    image, transmittance = (torch.cat(parts, dim=0) for parts in zip(*rows, strict=True))

    # Scatter from the M visible Gaussians, sorted by depth, back to the order of the caller; culled ones stay 0.
    means2d = torch.zeros(len(opacities), 2, dtype=features.dtype, device=features.device)
    radii = torch.zeros_like(means2d)
    means2d[splats.index] = splats.means2d.detach()
    radii[splats.index] = splats.radii
    return image, transmittance, (means2d, radii, splats.depths.detach())


def _blend_block(
    splats: _Splats, opacities: Tensor, features: Tensor, box: tuple[int, int, int, int]
) -> tuple[Tensor, Tensor]:
    """Blend a block of pixels (left, top, right, bottom): features (h, w, D) and transmittance (h, w, 1)."""
    # Only Gaussians whose box overlaps the block; their order by depth is kept.
    left, top, right, bottom = box
    low, high = splats.means2d.new_tensor([left, top]), splats.means2d.new_tensor([right, bottom])
    reaching = ((splats.means2d + splats.radii > low) & (splats.means2d - splats.radii < high)).all(-1)
    index = splats.index[reaching]

    # Pixel centres lie at +0.5; sigma = d^T S^-1 d / 2 is half
    # the squared Mahalanobis distance to the projected centre.
    x = torch.arange(left, right, dtype=low.dtype, device=low.device) + 0.5
    y = torch.arange(top, bottom, dtype=low.dtype, device=low.device) + 0.5
    dx = x[None, :, None] - splats.means2d[reaching, 0]
    dy = y[:, None, None] - splats.means2d[reaching, 1]
    xx, xy, yy = splats.conics[reaching].unbind(-1)
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy  # (h, w, M)
    alpha = torch.clamp(opacities[index] * torch.exp(-sigma), max=ALPHA_MAX)
    alpha = torch.where((alpha >= ALPHA_MIN) & (sigma >= 0), alpha, 0.0)

    # A Gaussian that would leave TRANSMITTANCE_MIN or less is not blended, nor is any behind it: the running product
    # over all Gaussians never grows again, so one comparison says both.
    blended = torch.where(torch.cumprod(1 - alpha, dim=-1) > TRANSMITTANCE_MIN, alpha, 0.0)
    # T_i = prod_{j<i} (1 - alpha_j), the light that reaches Gaussian i; the last entry is what passes all of them.
    behind = torch.cumprod(torch.cat([sigma.new_ones(*sigma.shape[:2], 1), 1 - blended], dim=-1), dim=-1)
    weights = blended * behind[..., :-1]
    return weights @ features[index], behind[..., -1:]
