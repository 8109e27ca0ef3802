"""Base of all trainings on photographs: views of frames, the reconstruction loss, figures of held-out views."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.data.sequence import AvatarSequence, FrameSequence, Item, camera_centers_of
from avatar.data.views import View
from avatar.gaussians import offset_penalty, scale_penalty, triangle_frames
from avatar.losses.perceptual import PerceptualDistance
from avatar.losses.reconstruction import ReconstructionWeights, Target, reconstruction_loss
from avatar.metrics.view_quality import Box, ViewQuality, eight_bit, mean_quality, view_quality
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.tracked_surface import SurfaceNormals, Track
from avatar.rendering.avatar_view import Rendering, render_view
from avatar.rig.rig import AvatarModel, PosedAvatar
from avatar.training.engine.adam import LearningRates, OptimiserConfig, ParameterGroup, attribute_groups, pixel_size
from avatar.training.engine.optimization_task import OptimizationTask
from avatar.training.engine.processes import Distributed
from avatar.training.engine.unseen import hold_unseen
from smplxpp.core.errors import require_at_least

Preview = Callable[[Mapping[str, np.ndarray]], None]
Surface = Callable[[View, int], View]
"""Returns a view of a frame with normals that the capture does not have."""


@dataclass(frozen=True, eq=False)
class TaskContext:
    """Services of a task beside data, model and configuration; perceptual distance and surface change its steps.

    Attributes:
        perceptual: for the perceptual term; None leaves it out.
        distributed: the processes that train together; None: this one alone.
        preview: called at every evaluation with rendered (H, W, 3) uint8 images by name.
        surface: for the normal term, normals of views that have no map; None leaves the term out for these.
    """

    perceptual: PerceptualDistance | None = None
    distributed: Distributed | None = None
    preview: Preview = lambda images: None
    surface: Surface | None = None


ALONE = TaskContext()
"""The context of one process without a perceptual term and previews."""


class TrainableAvatar(AvatarModel, Protocol):
    """An avatar whose Gaussians' attributes can be learned."""

    gaussians: LearnedGaussians


@dataclass(frozen=True, kw_only=True)
class PhotometricConfig:
    """Choices of every training on photographs.

    Attributes:
        iterations: number of steps.
        poses_per_step: batch size, in poses.
        views: cameras of each pose.
        lr: learning rate of the networks at the start.
        lr_final_factor: share of it left at the end.
        schedule: of all learning rates, see `OptimiserConfig`.
        attributes: multiple of `rates` for the Gaussians' own attributes; 0 freezes them.
        rates: learning rates of those attributes.
        weights: of the losses.
        surface_normals: use normals of tracked clothes where a capture has no normal maps; otherwise the loss has no
            normal term there.
        perceptual_every: steps between two with the perceptual term, whose weight is multiplied by this number.
        coarse: share of the steps, from the start, on images of half the size, where displacements of many pixels are
            found.
        eps2d: see `rasterize`.
        scale_penalty: weight of GaussianAvatars' penalty of large scales, where the attributes learn.
        offset_penalty: weight of GaussianAvatars' penalty of large offsets, where the attributes learn.
        averaged: share of the last steps whose mean parameters are the result, see `OptimiserConfig`.
        betas: of Adam.
        amp: run networks in bfloat16 on CUDA.
        max_grad_norm: largest norm of the gradient.
        evaluations: number of evaluations on held-out views, evenly spaced.
        evaluated: number of frames of either kind in an evaluation.
        seed: of the order of frames and views and of all noise.
    """

    iterations: int
    poses_per_step: int = 1
    views: int = 1
    lr: float = 5e-4
    lr_final_factor: float = 0.05
    schedule: Literal["cosine", "exponential", "constant"] = "cosine"
    attributes: float = 0.0
    rates: LearningRates = field(default_factory=LearningRates)
    weights: ReconstructionWeights = field(default_factory=ReconstructionWeights)
    surface_normals: bool = False
    perceptual_every: int = 1
    coarse: float = 0.0
    eps2d: float = 0.1
    scale_penalty: float = 0.003
    offset_penalty: float = 0.1
    averaged: float = 0.0
    betas: tuple[float, float] = (0.9, 0.999)
    amp: bool = False
    max_grad_norm: float = float("inf")
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
            ("scale_penalty", 0.0),
            ("offset_penalty", 0.0),
            ("evaluations", 1),
            ("evaluated", 1),
            ("seed", 0),
        ):
            require_at_least(f"training: {name}", getattr(self, name), least)

    def optimiser(self) -> OptimiserConfig:
        """Return the configuration of Adam for these steps."""
        return OptimiserConfig(
            iterations=self.iterations,
            schedule=self.schedule,
            betas=self.betas,
            eps=1e-15,
            averaged=self.averaged,
            amp=self.amp,
            max_grad_norm=self.max_grad_norm,
        )

    @property
    def evaluate_every(self) -> int:
        """Number of steps between two evaluations, rounded up: the last one is that of the end."""
        return -(-self.iterations // self.evaluations)


class PhotometricTask(OptimizationTask[Item]):
    """A training whose micro-batches are frames with some of their cameras.

    Args:
        sequence: frames and views.
        model: the avatar in training.
        config: of steps, losses and rates.
        groups: learned parameters; the Gaussians' attributes are added where the configuration trains them.
        context: perceptual distance, processes, previews.
    """

    def __init__(
        self,
        sequence: FrameSequence,
        model: TrainableAvatar,
        config: PhotometricConfig,
        groups: Sequence[ParameterGroup],
        context: TaskContext = ALONE,
    ) -> None:
        self.sequence, self.model, self.config, self.preview = sequence, model, config, context.preview
        self.perceptual = context.perceptual if config.weights.perceptual else None
        self.iteration = 0
        self.surface = context.surface if config.weights.normal else None
        attributes = attribute_groups(model.gaussians, config.attributes, pixel_size(sequence), config.rates)
        super().__init__((*groups, *attributes), config.optimiser(), context.distributed)
        self.rest_frames = triangle_frames(sequence.rig.vertices, sequence.rig.faces)
        hold_unseen(sequence, model.gaussians, getattr(model, "blend_shapes", None))

    def micro_batches(self, iteration: int) -> Sequence[Item]:
        """Return the step's frames and cameras, and start to read those of the next steps in the background."""
        self.iteration = iteration
        # A GPU's steps are shorter than a photograph takes to decode, so that several are read at a time.
        ahead = min(self.config.iterations - 1 - iteration, 3 if self.device.type == "cuda" else 1)
        now, *soon = (
            self.sequence.items(k, count=self.config.poses_per_step, views=self.config.views, seed=self.config.seed)
            for k in range(iteration, iteration + 1 + max(ahead, 0))
        )
        # Each process reads ahead its own items alone, every world_size-th.
        for items in soon:
            self.sequence.expect(items[self.distributed.rank :: self.distributed.world_size])
        return now

    @abstractmethod
    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the mean loss over the item's views, and its terms."""

    def views(self, item: Item) -> list[View]:
        """Return the item's photographs with all normals; at half their size in the coarse part of the training."""
        views = [self.sequence.view(camera, item.frame) for camera in item.cameras]
        # Half the size makes a displacement half as many pixels, within reach of the image's gradients.
        coarse = self.iteration < self.config.coarse * self.config.iterations
        views = [view.halved() for view in views] if coarse else views
        if self.surface is None:
            return views
        return [self.surface(view, item.frame) if view.normals is None else view for view in views]

    def compared(
        self,
        posed: PosedAvatar,
        views: Sequence[View],
        targets: Sequence[Target] | None = None,
        *,
        extra: Float[Tensor, "N D"] | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor], list[Rendering]]:
        """Return the mean reconstruction loss of a pose over views, its terms, and the renderings.

        Args:
            posed: the avatar in the pose of the views.
            views: of one frame.
            targets: of each view, in place of the photographs.
            extra: more values of the Gaussians to render.
        """
        # The perceptual term comes every n-th step with n times its weight.
        weights = self.config.weights
        turn = self.iteration % self.config.perceptual_every == 0
        if self.config.perceptual_every > 1:
            scaled = weights.perceptual * self.config.perceptual_every
            weights = replace(weights, perceptual=scaled)
        total = posed.vertices.new_zeros(())
        terms: list[dict[str, Tensor]] = []
        renderings: list[Rendering] = []
        # Mean over the views.
        for index, view in enumerate(views):
            target = targets[index] if targets else photograph(view, self.sequence.background)
            normals = bool(weights.normal) and target.normals is not None
            rendering = render_view(
                posed, index, view, self.sequence.background, eps2d=self.config.eps2d, normals=normals, extra=extra
            )
            loss, figures = reconstruction_loss(
                rendering, target, weights, perceptual=self.perceptual if turn else None
            )
            total = total + loss / len(views)
            terms.append(figures)
            renderings.append(rendering)
        total = total + self._attribute_penalties()
        # Each term's mean over the views that have it.
        names = {name: None for figures in terms for name in figures}
        means = {name: torch.stack([f[name] for f in terms if name in f]).mean() for name in names}
        return total, means, renderings

    def _attribute_penalties(self) -> Float[Tensor, ""] | float:
        """Return the penalties of large scales and of large offsets; 0 if attributes are frozen."""
        if not self.config.attributes:
            return 0.0
        bound = self.model.gaussians()
        return self.config.scale_penalty * scale_penalty(bound) + self.config.offset_penalty * offset_penalty(
            bound, self.rest_frames
        )

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return mean figures of the measured views by kind; "mean" repeats those of "novel_view"."""
        quality, images = self.measure_views()
        self.preview(images)
        means = {kind: mean_quality(views) for kind, views in quality.items()}
        return {"mean": means.get("novel_view", {}), **means}

    def measure_views(self) -> tuple[dict[str, dict[str, ViewQuality]], dict[str, np.ndarray]]:
        """Return figures of the measured views by kind and name, and their rendered (H, W, 3) uint8 images by name."""
        quality: dict[str, dict[str, ViewQuality]] = {}
        images: dict[str, np.ndarray] = {}
        for measured in self.sequence.measured_views(self.config.evaluated):
            # Held-out views at full size, without gradients; kinds are new views and new poses.
            of_view, images[measured.name] = self.measure(measured.view, measured.frame)
            quality.setdefault(measured.kind, {})[measured.name] = of_view
        return quality, images

    def measure(self, view: View, frame: int) -> tuple[ViewQuality, UInt8[np.ndarray, "H W 3"]]:
        """Return figures and the rendered image of a whole view."""
        with torch.no_grad():
            posed = self.model(self.sequence.pose(frame), camera_centers_of([view]))
            seen = render_view(posed, 0, view, self.sequence.background, eps2d=self.config.eps2d)
            quality = view_quality(view, seen.image, seen.alpha, self.sequence.background, head=self.head_box_of(view))
        return quality, eight_bit(seen.image).numpy()

    def head_box_of(self, view: View) -> Box | None:
        """Return the box of the head in a measured view, for figures of its own; None: no figures."""
        return None

    def generator(self, *key: int) -> np.random.Generator:
        """Return a random generator that depends on the seed, the step and a key alone."""
        return np.random.default_rng((self.config.seed, 2, self.iteration, *key))


def photograph(view: View, background: Tensor) -> Target:
    """Return the view's own pixels as the target of a rendering."""
    return Target(view.composited(background), view.opacity(), view.normals)


def with_surface_normals(context: TaskContext, sequence: AvatarSequence, track: Track | None) -> TaskContext:
    """Return the context with normals of tracked clothes, if there is a track and the capture has no normal maps."""
    if track is None or sequence.normal_maps:
        return context
    return replace(context, surface=SurfaceNormals(sequence, track))
