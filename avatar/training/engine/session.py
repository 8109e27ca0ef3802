"""Session: folder, time limit, processes and reports of a training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avatar.losses.perceptual import PerceptualDistance
from avatar.training.engine.loop import LoopConfig, Progress, run_training
from avatar.training.engine.optimization_task import OptimizationTask, PretrainConfig
from avatar.training.engine.photometric_task import PhotometricConfig, Preview, TaskContext
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import Compiled

TRACK, JOINT, PRETRAIN = "track", "joint", "pretrain"
"""Folders of tracking, joint correction and pretraining, which precede a training."""
BACK = "back"
"""Folder of the backward pass, inside that of the tracking."""


@dataclass(frozen=True, eq=False)
class Session:
    """Folder, time limit, processes and reports of a training; only the perceptual distance changes its steps.

    Attributes:
        folder: for metrics and the checkpoint.
        key: digest of configuration and inputs; a checkpoint of another key is refused.
        perceptual: distance of the perceptual term; None leaves the term out.
        distributed: the processes that train together.
        max_seconds: stop with a checkpoint after this time.
        tensorboard: log for TensorBoard too.
        checkpoint_seconds: see `LoopConfig`.
        report: called after logged steps and evaluations.
        preview: called at evaluations with rendered images.
        compile: how networks are compiled on a GPU, see `compile_networks`.
    """

    folder: Path
    key: str = ""
    perceptual: PerceptualDistance | None = None
    distributed: Distributed | None = None
    max_seconds: float = float("inf")
    tensorboard: bool = False
    checkpoint_seconds: float | None = None
    report: Callable[[Progress], None] = lambda progress: None
    preview: Preview = lambda images: None
    compile: Compiled = "off"

    @property
    def context(self) -> TaskContext:
        """The parts of the session that a `PhotometricTask` uses."""
        return TaskContext(self.perceptual, self.distributed, self.preview)

    def run(
        self,
        make: Callable[[], OptimizationTask[Any]],
        config: PhotometricConfig | PretrainConfig,
        *,
        keep_end: bool = False,
    ) -> Progress:
        """Run the training of the task that `make` returns, from its checkpoint if there is one."""
        loop = LoopConfig(
            iterations=config.iterations,
            evaluate_every=config.evaluate_every,
            max_seconds=self.max_seconds,
            keep_end=keep_end,
            tensorboard=self.tensorboard,
            checkpoint_seconds=self.checkpoint_seconds,
        )
        return run_training(make(), loop, self.folder, key=self.key, report=self.report)

    def run_alone(
        self, make: Callable[[], OptimizationTask[Any]], config: PhotometricConfig | PretrainConfig
    ) -> Progress:
        """Run a training on the first process while the others wait; a checkpoint of its end is kept."""
        processes = self.distributed or Distributed()
        return processes.run_on_rank0(lambda: self.run(make, config, keep_end=True), kinds=(Progress,))

    def within(self, name: str) -> Session:
        """Return the session in a folder inside this one, without previews."""
        return replace(self, folder=self.folder / name, preview=lambda images: None)

    def after(self, progress: Progress) -> Session:
        """Return the session with the time that an earlier training left."""
        return replace(self, max_seconds=max(self.max_seconds - progress.session_seconds, 0.0))
