"""Measure the similarity of a rendered view and its photograph, by named conventions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32, Int, UInt8
from torch import Tensor

from avatar.data.views import View
from avatar.gaussians.sampling import head_faces
from avatar.losses.image_similarity import psnr_from_mse, ssim
from avatar.losses.perceptual import MIN_SIZE, PerceptualDistance
from smplxpp.core import Camera, TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template

OPACITY_THRESHOLD = 0.02
OPAQUE = 0.98
"""Opacity from which a pixel shows the person alone."""
CONVENTION = (
    "Images are composited on the capture's plain background, rendered colours clamped to [0, 1]. "
    "PSNR: over pixels where mask or rendered opacity exceed 0.02. Image: over all pixels. "
    "SSIM: 11x11 Gaussian window, sigma 1.5, zero padding, mean over all pixels. "
    "Detail: RMS of what is finer than 5 pixels in the rendering over that in the photograph, where both show the "
    "person alone; 1: as sharp, less: blurred, more: noisy. Unlike PSNR it does not depend on where a pattern lies. "
    "Head: the box of the head's vertices as the skinned template projects them, 8 % wider on every side; PSNR of the "
    "first kind within it, SSIM of the crop as an image of its own; collar and shoulders are in it. "
    "Head alone: PSNR over the pixels of the first kind where the skinned template shows its head."
)
PERCEPTUAL_CONVENTION = "of the whole image, and of the head's crop where it has at least 32 pixels a side."
Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class ViewQuality:
    """Image quality of one view, by named conventions.

    Attributes:
        psnr: dB over the person: the union of the silhouettes, mask or rendered opacity above 0.02.
        psnr_image: dB over the whole composited image.
        ssim: mean over the whole composited image.
        psnr_head: as `psnr`, within the box of the head; None where the head is not in the image.
        ssim_head: SSIM of the box alone, zero padded as an image is; None as `psnr_head`.
        perceptual: distance of the whole composited images; None without a metric.
        perceptual_head: of the box alone; None too where it is under 32 pixels a side.
        psnr_head_alone: as `psnr`, over the pixels that show the head; None where none does.
        lpips: LPIPS beside another perceptual distance, of the same images; None without.
        lpips_head: as `perceptual_head`.
        detail: how much fine detail there is, as a multiple of the photograph's, see `detail`; None where there is none
            to compare.
    """

    psnr: float
    psnr_image: float
    ssim: float
    psnr_head: float | None = None
    ssim_head: float | None = None
    perceptual: float | None = None
    perceptual_head: float | None = None
    psnr_head_alone: float | None = None
    lpips: float | None = None
    lpips_head: float | None = None
    detail: float | None = None


def view_quality(
    view: View,
    image: Float32[Tensor, "H W 3"],
    alpha: Float32[Tensor, "H W"],
    background: Float32[Tensor, " 3"],
    *,
    head: Box | None,
    head_pixels: Bool[Tensor, "H W"] | None = None,
    metric: PerceptualDistance | None = None,
    lpips: PerceptualDistance | None = None,
) -> ViewQuality:
    """Compare a rendered image with the view's.

    Args:
        view: the photograph.
        image: rendered sRGB, clamped to [0, 1] here as a screen would.
        alpha: rendered opacity.
        background: sRGB behind both.
        head: box x0, y0, x1, y1 of the head, pixels; None: the head is not in the image.
        head_pixels: mask of the pixels that show the head, see `head_shown`.
        metric: perceptual distance; None: not measured.
        lpips: a second one.
    """
    # Both images lie on the same background, so that its pixels differ only where the silhouettes do.
    real = view.composited(background)
    image = image.clamp(0.0, 1.0)
    error = (image - real).square()
    # The person's pixels are the union of both silhouettes: a missing or a surplus limb counts as error.
    person = (view.opacity() > OPACITY_THRESHOLD) | (alpha > OPACITY_THRESHOLD)
    psnr_head = ssim_head = perceptual_head = lpips_head = psnr_head_alone = None
    # The head's figures come from its box: PSNR over the person's pixels, SSIM and perception over the whole crop.
    if head is not None:
        part = (slice(head[1], head[3]), slice(head[0], head[2]))
        if bool(person[part].any()):
            psnr_head = psnr_from_mse(float(error[part][person[part]].mean()))
            ssim_head = float(ssim(image[part].contiguous(), real[part].contiguous()))
            perceptual_head, lpips_head = (_distance(one, image[part], real[part]) for one in (metric, lpips))
    # The stricter figure leaves out hands and shoulders that enter the box.
    if head_pixels is not None and bool((alone := person & head_pixels).any()):
        psnr_head_alone = psnr_from_mse(float(error[alone].mean()))
    return ViewQuality(
        psnr=psnr_from_mse(float(error[person].mean())),
        psnr_image=psnr_from_mse(float(error.mean())),
        ssim=float(ssim(image, real)),
        psnr_head=psnr_head,
        ssim_head=ssim_head,
        perceptual=_distance(metric, image, real),
        perceptual_head=perceptual_head,
        psnr_head_alone=psnr_head_alone,
        lpips=_distance(lpips, image, real),
        lpips_head=lpips_head,
        detail=detail(image, real, (view.opacity() > OPAQUE) & (alpha > OPAQUE)),
    )


def detail(
    image: Float32[Tensor, "H W 3"], reference: Float32[Tensor, "H W 3"], shown: Bool[Tensor, "H W"]
) -> float | None:
    """Return the RMS of an image minus its means over 5x5 pixels, divided by that of another image.

    A picture that hedges between places where a pattern may lie is a blur: it wins decibels, and its detail falls below
    1. Noise lies above. Only pixels whose whole window is shown count, so that silhouettes do not.

    Args:
        image: sRGB.
        reference: what it is compared with.
        shown: pixels that both show.

    Returns:
        The ratio; None where no window is shown, or the reference is flat in all of them.

    Example:
        >>> stripes = torch.arange(32).remainder(4).lt(2).float().expand(32, 32)[..., None].repeat(1, 1, 3)
        >>> round(detail(0.5 + 0.25 * (stripes - 0.5), stripes, torch.ones(32, 32, dtype=torch.bool)), 3)
        0.25
    """
    # A window of five pixels holds a period of what a few hundred pixels show of weaves, stripes and dots.
    side = 5
    if min(shown.shape) < side:
        return None
    inside = F.avg_pool2d(shown.float()[None], side, stride=1)[0] == 1.0
    finest = []
    for one in (image, reference):
        middle = one[side // 2 : -(side // 2), side // 2 : -(side // 2)]
        rest = middle - F.avg_pool2d(one.permute(2, 0, 1), side, stride=1).permute(1, 2, 0)
        finest.append(float(rest[inside].double().square().sum()))
    return math.sqrt(finest[0] / finest[1]) if finest[1] > 0.0 else None


def _distance(metric: PerceptualDistance | None, image: Tensor, real: Tensor) -> float | None:
    # The networks of perceptual metrics need a least size; smaller crops have no distance.
    if metric is None or min(image.shape[:2]) < MIN_SIZE:
        return None
    with torch.no_grad():
        return float(metric(image[None], real[None]))


def mean_quality(views: Mapping[str, ViewQuality]) -> dict[str, float]:
    """Return plain means of each figure over the views that have it; figures that no view has are left out."""
    # Each figure is averaged over the views that have it: heads are out of some images.
    columns = {f.name: [getattr(quality, f.name) for quality in views.values()] for f in fields(ViewQuality)}
    known = {name: [value for value in values if value is not None] for name, values in columns.items()}
    return {name: sum(values) / len(values) for name, values in known.items() if values}


def spread_over_frames(frames: Iterable[Mapping[str, ViewQuality]]) -> dict[str, float]:
    """Return standard deviations over frames, by n - 1, of each figure's mean over a frame's views.

    Figures that fewer than two frames have, and those that are infinite in one, are left out.

    Args:
        frames: the views of each frame by name.
    """
    # Views of a frame are averaged first, because they are not independent samples.
    means = [mean_quality(views) for views in frames]
    columns = {f.name: [mean[f.name] for mean in means if f.name in mean] for f in fields(ViewQuality)}
    return {
        name: float(np.std(values, ddof=1))
        for name, values in columns.items()
        if len(values) > 1 and all(map(math.isfinite, values))
    }


def head_vertices(template: Template) -> Int[np.ndarray, " N"]:
    """Return the vertices of the head's faces; all that faces use on a body without a joint "head"."""
    faces = template.faces[head_faces(template)] if "head" in template.body.joint_names else template.faces
    return np.unique(faces)


def head_box(points: Float[np.ndarray, "N 3"], camera: Camera) -> Box | None:
    """Return x0, y0, x1, y1 in pixels around projected points, a little wider; None where nothing is in the image."""
    head_margin = 0.08  # share of the head's box that is added on every side
    # A point behind the camera has no projection, so that such a view has no box.
    x, y, depth = camera.screen_from_world(points).T[:3]
    if not (depth > 0).all():
        return None
    # Widened on every side, rounded outward to whole pixels, and cut at the image's border.
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    margin = head_margin * (high - low)
    x0, y0 = np.maximum(np.floor(low - margin), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin), (camera.width, camera.height)).astype(int)
    return (int(x0), int(y0), int(x1), int(y1)) if x1 > x0 and y1 > y0 else None


def head_shown(mesh: TriangleMesh, head: Bool[np.ndarray, " F"], camera: Camera) -> Bool[Tensor, "H W"]:
    """Return the pixels whose nearest face of a posed mesh is one of its head's."""
    # A z-buffer gives the nearest face of each pixel; background pixels have -1 and read entry 0 as a placeholder.
    face = rasterize_mesh(mesh, camera).face_id
    return torch.from_numpy((face >= 0) & head[np.maximum(face, 0)])


def eight_bit(image: Float32[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """Return colours in [0, 1] as bytes on the CPU."""
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu()
