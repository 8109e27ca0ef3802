"""What the trainings of teacher and student share: views of frames, the loss on them, held-out figures."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.data.views import View
from avatar.losses.perceptual import PerceptualDistance
from avatar.losses.reconstruction import ReconstructionWeights, Target, reconstruction_loss
from avatar.metrics.view_quality import eight_bit, mean_quality, view_quality
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from avatar.render.avatar_view import Rendering, render_view
from avatar.rig.posed import AvatarModel, PosedAvatar
from avatar.training.engine.learning_rates import LearningRates
from avatar.training.engine.optimization_task import OptimiserConfig, OptimizationTask, ParameterGroup
from avatar.training.engine.processes import Distributed
from smplxpp.core.errors import InputError
from smplxpp.core.spread import spread_inside

Preview = Callable[[Mapping[str, np.ndarray]], None]


@dataclass(frozen=True, kw_only=True)
class PhotometricConfig:
    """What every stage chooses.

    Attributes:
        iterations: steps. poses_per_step: the batch. views: cameras that look at each pose.
        lr: Adam's step of the networks at the start. lr_final_factor: share of every one left at the end (cosine).
        attributes: of the Gaussians' own attributes: multiple of the reference fit's rates; 0 leaves them as they are.
        weights: of the losses.
        perceptual_every: steps between those with the perceptual term, which then counts as many times.
        coarse: share of the steps, from the start, that see images of half the size: a displacement of many pixels is
            found there first.
        eps2d: see `rasterize`.
        betas: Adam's. amp: networks in bfloat16 on CUDA. max_grad_norm: largest norm of the gradient.
        evaluations: how often held-out views are measured, evenly. evaluated: how many frames of either kind then.
        seed: of the order of frames and views and of all noise.
    """

    iterations: int
    poses_per_step: int = 1
    views: int = 1
    lr: float = 5e-4
    lr_final_factor: float = 0.05
    attributes: float = 0.0
    weights: ReconstructionWeights = field(default_factory=ReconstructionWeights)
    perceptual_every: int = 1
    coarse: float = 0.0
    eps2d: float = 0.1
    betas: tuple[float, float] = (0.9, 0.999)
    amp: bool = False
    max_grad_norm: float = math.inf
    evaluations: int = 6
    evaluated: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (
            ("iterations", 1),
            ("poses_per_step", 1),
            ("views", 1),
            ("attributes", 0.0),
            ("perceptual_every", 1),
            ("coarse", 0.0),
            ("eps2d", 0.0),
            ("evaluations", 1),
            ("evaluated", 1),
            ("seed", 0),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= least):
                raise InputError(f"training: {name}", expected=f"a number, at least {least:g}", received=repr(value))

    def optimiser(self) -> OptimiserConfig:
        """Of these steps."""
        return OptimiserConfig(
            iterations=self.iterations, betas=self.betas, eps=1e-15, amp=self.amp, max_grad_norm=self.max_grad_norm
        )

    @property
    def evaluate_every(self) -> int:
        return max(1, self.iterations // self.evaluations)


class PhotometricTask(OptimizationTask):
    """A stage whose micro-batches are frames with some of their cameras.

    Args:
        sequence: what is trained on.
        model: what is trained.
        groups: its learned parameters; the attributes of `gaussians` join them where the configuration moves them.
        gaussians: the model's.
        perceptual: for the perceptual term; None leaves it out.
        preview: called at every evaluation with rendered (H, W, 3) uint8 images by name.
    """

    def __init__(
        self,
        sequence: AvatarSequence,
        model: AvatarModel,
        config: PhotometricConfig,
        groups: Sequence[ParameterGroup],
        *,
        perceptual: PerceptualDistance | None = None,
        distributed: Distributed | None = None,
        preview: Preview = lambda images: None,
    ) -> None:
        self.sequence, self.model, self.config, self.preview = sequence, model, config, preview
        self.perceptual = perceptual if config.weights.perceptual else None
        self.iteration = 0
        attributes = attribute_groups(model.gaussians, config.attributes, pixel_size(sequence))
        super().__init__((*groups, *attributes), config.optimiser(), distributed)

    def micro_batches(self, iteration: int) -> Sequence[Item]:
        """The step's frames and cameras; those of the next are read meanwhile."""
        self.iteration = iteration
        now, soon = (
            self.sequence.items(k, count=self.config.poses_per_step, views=self.config.views, seed=self.config.seed)
            for k in (iteration, iteration + 1)
        )
        self.sequence.expect(soon[self.distributed.rank :: self.distributed.world_size])
        return now

    @abstractmethod
    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, float]]:
        """Mean over the item's views, and its terms."""

    def views(self, item: Item) -> list[View]:
        """The item's photographs, at half their size in the coarse part of the training."""
        views = [self.sequence.view(camera, item.frame) for camera in item.cameras]
        coarse = self.iteration < self.config.coarse * self.config.iterations
        return [view.halved() for view in views] if coarse else views

    def compared(
        self, posed: PosedAvatar, views: Sequence[View], targets: Sequence[Target] | None = None, **options: Any
    ) -> tuple[Tensor, dict[str, float], list[Rendering]]:
        """Mean reconstruction loss of a pose over views, its terms, and the renderings.

        Args:
            targets: in the place of the photographs. options: of `render_view`.
        """
        weights = self.config.weights
        turn = self.iteration % self.config.perceptual_every == 0
        if self.config.perceptual_every > 1:
            scaled = weights.perceptual * self.config.perceptual_every
            weights = ReconstructionWeights(**{**asdict(weights), "perceptual": scaled})
        total, terms, renderings = posed.vertices.new_zeros(()), [], []
        for index, view in enumerate(views):
            target = targets[index] if targets else photograph(view, self.sequence.background)
            normals = bool(weights.normal) and target.normals is not None
            rendering = render_view(
                posed, index, view, self.sequence.background, eps2d=self.config.eps2d, normals=normals, **options
            )
            loss, figures = reconstruction_loss(
                rendering, target, weights, perceptual=self.perceptual if turn else None
            )
            total = total + loss / len(views)
            terms.append(figures)
            renderings.append(rendering)
        names = {name: None for figures in terms for name in figures}
        means = {name: float(np.mean([f[name] for f in terms if name in f])) for name in names}
        return total, means, renderings

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Figures of held-out cameras at training frames, and at held-out frames, where there are any."""
        splits = self.sequence.capture.splits
        cameras = splits.novel_view_cameras or splits.train_cameras[:2]
        out: dict[str, Any] = {"mean": {}}
        images: dict[str, np.ndarray] = {}
        for kind, frames in (("novel_view", self.sequence.train_frames), ("novel_pose", splits.novel_pose_frames)):
            quality = {}
            for frame in spread_inside(frames, self.config.evaluated):
                for camera in cameras:
                    if self.sequence.capture.file(camera, frame) is None:
                        continue
                    view, name = self.sequence.whole_view(camera, frame), f"{camera} {frame}"
                    if view.alpha.any():  # a view of nobody measures nothing
                        quality[name], images[name] = self.measure(view, frame)
            if quality:
                out[kind] = mean_quality(quality)
        out["mean"] = out.get("novel_view", {})
        self.preview(images)
        return out

    def measure(self, view: View, frame: int) -> tuple[Any, np.ndarray]:
        """Figures and the rendered uint8 image of a whole view."""
        with torch.no_grad():
            posed = self.model(self.sequence.motion(frame), camera_centers_of([view]))
            seen = render_view(posed, 0, view, self.sequence.background, eps2d=self.config.eps2d)
            quality = view_quality(view, seen.image, seen.alpha, self.sequence.background, head=None)
        return quality, eight_bit(seen.image).numpy()

    def generator(self, *key: int) -> np.random.Generator:
        """Noise that the seed, the step and a key decide."""
        return np.random.default_rng((self.config.seed, 2, self.iteration, *key))


def photograph(view: View, background: Tensor) -> Target:
    """The view's own pixels."""
    return Target(view.composited(background), view.opacity(), view.normals)


def attribute_groups(gaussians: LearnedGaussians, multiple: float, pixel: float) -> list[ParameterGroup]:
    """Groups of the Gaussians' attributes at `multiple` times the reference fit's rates; none for 0, which freezes.

    Args:
        pixel: metres, the unit of the offsets' rates.
    """
    if not multiple:
        gaussians.requires_grad_(False)
        return []
    rates, unit = LearningRates(), {"normal_offset": pixel, "offset": pixel}
    gaussians.requires_grad_(True)
    return [
        ParameterGroup(
            f"gaussians.{name}",
            {name: getattr(gaussians, name)},
            multiple * getattr(rates, name) * unit.get(name, 1.0),
            rates.lr_final_factor,
        )
        for name in LEARNED
        if getattr(gaussians, name).numel()
    ]


def pixel_size(sequence: AvatarSequence) -> float:
    """Metres that a pixel covers at the person: median over the training cameras of `distance / f`."""
    center = sequence.rig.pose(sequence.motion(sequence.train_frames[0])).mean(0).cpu().numpy()
    cameras = [sequence.capture.cameras[name] for name in sequence.train_cameras]
    return float(np.median([np.linalg.norm(c.position - center) / c.K[0, 0] for c in cameras]))
