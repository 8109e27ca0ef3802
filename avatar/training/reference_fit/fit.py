"""Reference fit: one frame's views turn a posed template into textured Gaussians bound to its triangles."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avatar.data.views import View
from avatar.export.splats import Splats, posed_splats
from avatar.gaussians.binding import BoundGaussians, WorldGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.regularizers import offset_penalty, scale_penalty
from avatar.gaussians.sampling import sample_on_mesh
from avatar.gaussians.spherical_harmonics import view_colors
from avatar.losses.psnr import psnr_from_mse
from avatar.losses.ssim import ssim
from avatar.metrics.view_quality import (
    Box,
    ViewQuality,
    eight_bit,
    head_box,
    head_vertices,
    mean_quality,
    view_quality,
)
from avatar.models.learned_gaussians import LEARNED
from avatar.render.api import rasterize
from avatar.training.engine.loop import LoopConfig, Progress, run_training
from avatar.training.engine.optimization_task import OptimiserConfig, OptimizationTask, ParameterGroup
from avatar.training.reference_fit.config import FitConfig
from avatar.training.reference_fit.initial_colors import colors_from_views
from smplxpp.core.errors import InputError
from smplxpp.template.template import Template

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FitScene:
    """What a fit is made on.

    Attributes:
        template: the clothed body. vertices: (V, 3) of it in the frame's pose, metres.
        train, held_out: whole views; `held_out` are measured.
        background: (3,) sRGB in [0, 1] behind the person.
    """

    template: Template
    vertices: np.ndarray
    train: Sequence[View]
    held_out: Sequence[View] = ()
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.train:
            raise InputError("views of the fit", expected="at least one training view", received="none")
        if self.vertices.shape != self.template.vertices.shape:
            raise InputError(
                "posed vertices", expected=f"shape {self.template.vertices.shape}", received=str(self.vertices.shape)
            )


@dataclass(frozen=True, eq=False)
class FitResult:
    """What a fit gives.

    Attributes:
        gaussians: on the CPU. splats: the same in the world, in the frame's pose.
        progress: where the loop ended; not `finished` when its time was over.
        quality: of held-out and training views by camera.
        images: (H, W, 3) uint8 rendered, by camera, and `heads` the box of the head in each.
    """

    gaussians: BoundGaussians
    splats: Splats
    progress: Progress
    quality: dict[str, ViewQuality]
    images: dict[str, np.ndarray]
    heads: dict[str, Box | None]


def fit_reference(
    scene: FitScene,
    config: FitConfig,
    folder: Path,
    *,
    key: str = "",
    device: str = "cpu",
    max_seconds: float = float("inf"),
    report: Callable[[Progress], None] = lambda progress: None,
    preview: Callable[[Mapping[str, np.ndarray]], None] = lambda images: None,
) -> FitResult:
    """Fit Gaussians to a frame by gradient descent on `(1 - s) L1 + s (1 - SSIM)` of composited images.

    The mesh stands still; offsets, scales, rotations, opacities and colours are learned. Colours start from the
    photographs. The same seed gives the same bits at one number of threads, interrupted or not.

    Args:
        folder: for `metrics.jsonl` and the checkpoint; a checkpoint with this `key` in it is taken up, one of
            another is refused.
        device: "cpu" or "cuda".
        max_seconds: stop with a checkpoint after as much work.
        report: called after every logged step and evaluation.
        preview: called at every evaluation with the rendered (H, W, 3) uint8 image of each camera that was measured.

    Raises:
        InputError: unusable input; `DivergedError` when the loss is not finite.
    """
    task = FitTask(scene, config, device, preview)
    loop = LoopConfig(
        iterations=config.iterations,
        evaluate_every=max(1, config.iterations // config.evaluations),
        max_seconds=max_seconds,
    )
    progress = run_training(task, loop, Path(folder), key=key, report=report)
    quality, images = task.measure((*scene.held_out, *scene.train))
    gaussians = task.gaussians().to(device="cpu")
    splats = posed_splats(gaussians, torch.tensor(scene.vertices), torch.tensor(scene.template.faces))
    return FitResult(gaussians, splats, progress, quality, images, task.heads)


class FitTask(OptimizationTask):
    """A reference fit, as `run_training` wants it; a step renders one view."""

    def __init__(
        self,
        scene: FitScene,
        config: FitConfig,
        device: str = "cpu",
        preview: Callable[[Mapping[str, np.ndarray]], None] = lambda images: None,
    ) -> None:
        self.scene, self.config, self.preview = scene, config, preview
        template, mesh = scene.template, scene.template.mesh.with_vertices(scene.vertices)
        faces = torch.tensor(template.faces, device=device)
        self.frames = triangle_frames(torch.tensor(scene.vertices, dtype=torch.float32, device=device), faces)
        start = sample_on_mesh(template, config.sampling).to(device=device)
        placed = world_from_frames(start, self.frames)
        dc, seen = colors_from_views(
            placed.means.double().cpu().numpy(),
            placed.normals.double().cpu().numpy(),
            start.dc,
            mesh=mesh,
            views=scene.train,
        )
        self.seen_share = float(seen.mean())
        self.start = replace(start, dc=dc)
        self.parameters = {name: getattr(self.start, name).clone().requires_grad_() for name in LEARNED}
        pixel = pixel_size(scene)
        unit = {"normal_offset": pixel, "offset": pixel}
        groups = [
            ParameterGroup(
                "gaussians",
                {name: value},
                getattr(config.rates, name) * unit.get(name, 1.0),
                config.rates.lr_final_factor,
            )
            for name, value in self.parameters.items()
        ]
        super().__init__(
            groups,
            OptimiserConfig(
                iterations=config.iterations,
                schedule="exponential",
                betas=(0.9, 0.99),
                eps=1e-15,
            ),
        )
        self.train = [view.cropped(config.margin).to(device) for view in scene.train]
        self.held_out = [view.to(device) for view in scene.held_out]
        self.background = torch.tensor(scene.background, dtype=torch.float32, device=device)
        corners = scene.vertices[head_vertices(template)]
        self.heads = {view.name: head_box(corners, view.camera) for view in (*scene.train, *scene.held_out)}

    def gaussians(self) -> BoundGaussians:
        """The Gaussians as they stand, without gradients."""
        return replace(self.start, **{name: value.detach().clone() for name, value in self.parameters.items()})

    def render(self, view: View) -> tuple[Tensor, Tensor]:
        """(H, W, 3) image and (H, W) opacity of a view, with gradients to the parameters."""
        bound = replace(self.start, **self.parameters)
        world = world_from_frames(bound, self.frames)
        return self.draw(world, self.colors(bound, world, view), view)

    def colors(self, bound: BoundGaussians, world: WorldGaussians, view: View) -> Tensor:
        """(1, N, 3) as the camera of a view sees them; directions count as constants."""
        return view_colors(bound, self.frames, world.means.detach(), view.position[None])

    def draw(self, world: WorldGaussians, colors: Tensor, view: View) -> tuple[Tensor, Tensor]:
        """Rasterise; parameters are checked for NaN once a step, not here."""
        image, alpha, _ = rasterize(
            world.means,
            world.quats,
            world.scales,
            world.opacities,
            colors,
            view.viewmat[None],
            view.K[None],
            view.camera.width,
            view.camera.height,
            background=self.background,
            eps2d=self.config.eps2d,
            check=False,
        )
        return image[0], alpha[0, ..., 0]

    def micro_batches(self, iteration: int) -> list[View]:
        """One view."""
        return [self.train[self.view_index(iteration)]]

    def name_of(self, item: View) -> str:
        return f"view {item.name}"

    def loss(self, item: View) -> tuple[Tensor, dict[str, float]]:
        """Of a view, rendered."""
        return self.compare(item, *self.render(item))

    def compare(self, view: View, image: Tensor, alpha: Tensor) -> tuple[Tensor, dict[str, float]]:
        """The loss of a rendered view, and its terms as numbers."""
        config, real = self.config, view.composited(self.background)
        bound = replace(self.start, **self.parameters)
        l1 = (image - real).abs().mean()
        similarity = ssim(image, real)
        total = (1.0 - config.dssim) * l1 + config.dssim * (1.0 - similarity)
        if config.alpha:
            total = total + config.alpha * (alpha - view.opacity()).abs().mean()
        total = total + config.scale_penalty * scale_penalty(bound)
        total = total + config.offset_penalty * offset_penalty(bound, self.frames)
        square = (image.detach().clamp(0.0, 1.0) - real).square().mean()
        psnr = psnr_from_mse(square.item())
        return total, {"loss": total.item(), "l1": l1.item(), "ssim": similarity.item(), "psnr_crop": psnr}

    def view_index(self, iteration: int) -> int:
        """Every view once an epoch, in an order that the seed and the epoch alone decide."""
        epoch, place = divmod(iteration, len(self.train))
        return int(np.random.default_rng([self.config.seed, epoch]).permutation(len(self.train))[place])

    def measure(self, views: Sequence[View]) -> tuple[dict[str, ViewQuality], dict[str, np.ndarray]]:
        """Figures and rendered uint8 images of whole views."""
        quality, images = {}, {}
        with torch.no_grad():
            for view in views:
                view = view.to(self.background.device)
                image, alpha = self.render(view)
                quality[view.name] = view_quality(view, image, alpha, self.background, head=self.heads[view.name])
                images[view.name] = eight_bit(image).numpy()
        return quality, images

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Figures of the held-out views; of the training views where none is held out."""
        quality, images = self.measure(self.held_out or self.scene.train)
        self.preview(images)
        views = {name: asdict(q) for name, q in quality.items()}
        return {"held_out": bool(self.held_out), "mean": mean_quality(quality), "views": views}


def pixel_size(scene: FitScene) -> float:
    """Metres that a pixel covers at the person: median over the training views of `distance / f`."""
    center = scene.vertices.mean(0)
    sizes = [np.linalg.norm(view.camera.position - center) / view.camera.K[0, 0] for view in scene.train]
    return float(np.median(sizes))
