"""Fit: one frame's views turn a posed template into textured Gaussians bound to its triangles.

Of a person who turns before one camera a frame shows one side; there the views of all frames are fitted together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.data.one_frame import OneFrame, PosedViews, other_sides
from avatar.data.sequence import Item, camera_centers_of
from avatar.data.views import View, read_views
from avatar.export.posed import posed_splats
from avatar.formats.splats import Splats
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.sampling import SamplingConfig
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.metrics.view_quality import Box, ViewQuality, head_box, head_vertices, mean_quality
from avatar.models.student import Student, StudentConfig
from avatar.training.engine.adam import LearningRates
from avatar.training.engine.loop import LoopConfig, Progress, run_training
from avatar.training.engine.photometric_task import ALONE, PhotometricConfig, PhotometricTask, TaskContext
from avatar.training.fit.initial_gaussians import initial_gaussians
from avatar.training.scene import TrainScene
from smplxpp.core.errors import InputError, one_line, require_between
from smplxpp.template.template import Template


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Choices of a fit of Gaussians to one frame.

    Attributes:
        sampling: number and distribution of the Gaussians.
        detail: additional density where the photographs change quickly, see `density_of_detail`; 0, as in the paper:
            one density.
        iterations: number of steps; each renders one view.
        rates: learning rates of the attributes.
        dssim: share of `1 - SSIM` in the loss; the rest is L1.
        alpha: weight of the L1 distance of rendered opacity and mask. Without it dark hair on a black background could
            become holes.
        scale_penalty: weight of GaussianAvatars' penalty of large scales.
        offset_penalty: weight of GaussianAvatars' penalty of large offsets.
        eps2d: blur of every Gaussian by the rasteriser, pixels squared. 1/12 is the variance of a pixel's own square;
            the 0.3 of viewers widens silhouettes by a pixel, so that the surface shrinks to meet the masks.
        margin: pixels kept around the silhouette of a training view.
        evaluations: number of evaluations, evenly spaced.
        seed: of the views' order; `sampling` has the seed of the Gaussians' places.
    """

    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    detail: float = 0.0
    iterations: int = 800
    rates: LearningRates = field(default_factory=LearningRates)
    dssim: float = 0.2
    alpha: float = 0.1
    scale_penalty: float = 1.0
    offset_penalty: float = 1.0
    eps2d: float = 0.1
    margin: int = 12
    evaluations: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least, most in (
            ("detail", 0.0, math.inf),
            ("iterations", 1, math.inf),
            ("dssim", 0.0, 1.0),
            ("alpha", 0.0, math.inf),
            ("scale_penalty", 0.0, math.inf),
            ("offset_penalty", 0.0, math.inf),
            ("eps2d", 0.0, math.inf),
            ("margin", 0, math.inf),
            ("evaluations", 1, math.inf),
            ("seed", 0, math.inf),
        ):
            require_between(f"fit: {name}", getattr(self, name), least, most)

    def photometric(self) -> PhotometricConfig:
        """Return what the fit shares with the other trainings on photographs: everything but the start."""
        # The loss of all trainings, without normals and perceptual term.
        # (1 - s) L1 + s D-SSIM as in 3DGS, with the opacity term that keeps dark hair on a black background.
        return PhotometricConfig(
            iterations=self.iterations,
            scale_penalty=self.scale_penalty,
            offset_penalty=self.offset_penalty,
            schedule="exponential",
            attributes=1.0,
            rates=self.rates,
            weights=ReconstructionWeights(
                l1=1.0 - self.dssim, dssim=self.dssim, perceptual=0.0, normal=0.0, alpha=self.alpha
            ),
            eps2d=self.eps2d,
            betas=(0.9, 0.99),
            evaluations=self.evaluations,
            seed=self.seed,
        )


PRESETS: dict[str, FitConfig] = {
    "quick": FitConfig(sampling=SamplingConfig(count=60_000), iterations=200),
    "default": FitConfig(sampling=SamplingConfig(count=150_000), iterations=800),
    "paper": FitConfig(sampling=SamplingConfig(count=270_000, head_share=70 / 270), iterations=10_000),
}
"""quick shows whether all fits together; default ends where a dozen cameras have no more to give to views held out;
paper has the numbers that TaoAvatar states (270k Gaussians, 10k iterations); docs/training.md lists the others."""


@dataclass(frozen=True, eq=False)
class FitScene:
    """Template, posed vertices and views of one frame, from which Gaussians are fitted.

    Attributes:
        template: the clothed body.
        vertices: of the template in the frame's pose, metres.
        train: whole training views, each with a unique name.
        held_out: whole views for evaluations, each with a unique name.
        background: sRGB in [0, 1] behind the person.
        others: further frames to fit to, of a person who turns before one camera.
    """

    template: Template
    vertices: Float[np.ndarray, "V 3"]
    train: Sequence[View]
    held_out: Sequence[View] = ()
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    others: Sequence[PosedViews] = ()

    @property
    def shown(self) -> tuple[View, ...]:
        """All training views."""
        return (*self.train, *(view for one in self.others for view in one.views))

    __repr__ = one_line

    def __post_init__(self) -> None:
        if not self.train:
            raise InputError("views of the fit", expected="at least one training view", received="none")
        if self.vertices.shape != self.template.vertices.shape:
            raise InputError(
                "posed vertices", expected=f"shape {self.template.vertices.shape}", received=str(self.vertices.shape)
            )


def fit_scene(scene: TrainScene, template: Template) -> FitScene:
    """Return the reference frame's whole views, the template in its pose, and for a turn the other frames' as well.

    Args:
        scene: its capture and reference frame.
        template: the scene's, or one made from it.
    """
    capture, frame = scene.capture, scene.frame
    return FitScene(
        template,
        template.pose(scene.reference_params())[0],
        read_views(capture, frame, capture.splits.train_cameras),
        read_views(capture, frame, capture.splits.novel_view_cameras),
        capture.recording.background or (0.0, 0.0, 0.0),
        other_sides(capture, frame, template),
    )


@dataclass(frozen=True, eq=False)
class FitResult:
    """Fitted Gaussians with their figures and images.

    Attributes:
        gaussians: on the CPU.
        splats: the same in the world, in the frame's pose.
        progress: where the loop ended; not `finished` when its time was over.
        quality: of held-out and training views by camera.
        images: (H, W, 3) uint8 rendered, by camera, and `heads` the box of the head in each.
    """

    gaussians: BoundGaussians
    splats: Splats
    progress: Progress
    quality: dict[str, ViewQuality]
    images: dict[str, UInt8[np.ndarray, "_ _ 3"]]
    heads: dict[str, Box | None]


def fit_gaussians(
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

    A student without field is trained as the others are, on one frame. The mesh stands still; offsets, scales,
    rotations, opacities and colours are learned. Colours start from the photographs. The same seed gives the same bits
    at one number of threads, interrupted or not.

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
    # Fit, from the checkpoint if there is one.
    task = FitTask(scene, config, device, TaskContext(preview=preview))
    loop = LoopConfig(
        iterations=config.iterations,
        evaluate_every=task.config.evaluate_every,
        max_seconds=max_seconds,
    )
    progress = run_training(task, loop, Path(folder), key=key, report=report)
    # Figures and images of all views, and the Gaussians in the world.
    names = [view.name for view in (*scene.held_out, *scene.shown)]
    measured = {name: task.measure(task.sequence.whole_view(name), task.sequence.frame_of(name)) for name in names}
    quality = {name: of_view for name, (of_view, _) in measured.items()}
    images = {name: image for name, (_, image) in measured.items()}
    gaussians = task.student.gaussians.snapshot()
    splats = posed_splats(gaussians, torch.tensor(scene.vertices), torch.tensor(scene.template.faces))
    return FitResult(gaussians, splats, progress, quality, images, task.heads)


class FitTask(PhotometricTask):
    """A fit: a student without field or blend shapes learns its Gaussians' attributes on one frame.

    A step renders one view.
    """

    sequence: OneFrame

    def __init__(self, scene: FitScene, config: FitConfig, device: str = "cpu", context: TaskContext = ALONE) -> None:
        frame = OneFrame(
            scene.template,
            scene.vertices,
            scene.train,
            scene.held_out,
            others=scene.others,
            background=scene.background,
            margin=config.margin,
            device=device,
        )
        # Initial Gaussians with colours from the photographs; the student has no field and no blend shapes.
        start = initial_gaussians(
            frame.rig, scene.vertices, scene.train, config.sampling, others=scene.others, detail=config.detail
        )
        self.fit_config, self.held_out = config, bool(scene.held_out)
        self.student = Student(StudentConfig(field=None), frame.rig, start, ())
        super().__init__(frame, self.student, config.photometric(), [], context)
        # Boxes of the head, for figures of its own.
        head = head_vertices(scene.template)
        posed = (PosedViews(scene.vertices, (*scene.train, *scene.held_out)), *scene.others)
        self.heads = {v.name: head_box(one.vertices[head], v.camera) for one in posed for v in one.views}

    def name_of(self, item: Item) -> str:
        """Return the name of the step's view."""
        return f"view {' '.join(item.cameras)}"

    def loss(self, item: Item) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a view, rendered, and its terms."""
        views = self.views(item)
        total, terms, _ = self.compared(self.student(self.sequence.pose(item.frame), camera_centers_of(views)), views)
        return total, {"loss": total.detach(), **terms}

    def head_box_of(self, view: View) -> Box | None:
        """Return the box of the head in a view."""
        return self.heads[view.name]

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return figures of the held-out views; of the training views where none is held out."""
        measured, images = self.measure_views()
        (quality,) = measured.values()
        self.preview(images)
        views = {name: asdict(of_view) for name, of_view in quality.items()}
        return {"held_out": self.held_out, "mean": mean_quality(quality), "views": views}
