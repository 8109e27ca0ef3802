"""Where and how a training runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avatar.losses.perceptual import PerceptualDistance
from avatar.training.engine.loop import LoopConfig, Progress, run_training
from avatar.training.engine.optimization_task import OptimizationTask
from avatar.training.engine.photometric_task import PhotometricConfig, Preview, TaskContext
from avatar.training.engine.pretraining import PretrainConfig
from avatar.training.engine.processes import Distributed

TRACK, PRETRAIN = "track", "pretrain"
"""Folders of what comes before a training."""
BACK = "back"
"""Folder, in that of the tracking, of the way back."""


@dataclass(frozen=True, eq=False)
class Session:
    """Where and how a training runs; of all this the perceptual distance alone changes what comes out of its steps.

    Attributes:
        folder: for metrics and the checkpoint. key: names configuration and inputs.
        perceptual: for the perceptual term, None leaves it out.
        distributed: the processes that train together.
        max_seconds: stop with a checkpoint after as much work.
        tensorboard: log for TensorBoard too.
        report: called after logged steps and evaluations. preview: with rendered images at evaluations.
    """

    folder: Path
    key: str = ""
    perceptual: PerceptualDistance | None = None
    distributed: Distributed | None = None
    max_seconds: float = float("inf")
    tensorboard: bool = False
    report: Callable[[Progress], None] = lambda progress: None
    preview: Preview = lambda images: None

    @property
    def context(self) -> TaskContext:
        """What a `PhotometricTask` takes of it."""
        return TaskContext(self.perceptual, self.distributed, self.preview)

    def run(
        self,
        make: Callable[[], OptimizationTask[Any]],
        config: PhotometricConfig | PretrainConfig,
        *,
        keep_end: bool = False,
    ) -> Progress:
        """Train what `make` gives."""
        loop = LoopConfig(
            iterations=config.iterations,
            evaluate_every=config.evaluate_every,
            max_seconds=self.max_seconds,
            keep_end=keep_end,
            tensorboard=self.tensorboard,
        )
        return run_training(make(), loop, self.folder, key=self.key, report=self.report)

    def run_alone(
        self, make: Callable[[], OptimizationTask[Any]], config: PhotometricConfig | PretrainConfig
    ) -> Progress:
        """Train what `make` gives on the first process; the others wait. A checkpoint of the end is kept."""
        processes = self.distributed or Distributed()
        return processes.run_on_rank0(lambda: self.run(make, config, keep_end=True))

    def within(self, name: str) -> Session:
        """Return the same in a folder of its own, without previews."""
        return replace(self, folder=self.folder / name, preview=lambda images: None)

    def after(self, progress: Progress) -> Session:
        """Return the session with what is left of the time after a training that came first."""
        return replace(self, max_seconds=max(self.max_seconds - progress.session_seconds, 0.0))
