"""The loop that every training shares: metrics, evaluations, checkpoints, a limit of time, a stop at the first NaN."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from avatar.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from avatar.training.metrics_log import append_metrics, truncate_metrics

STATE_FILE = "state.safetensors"
METRICS_FILE = "metrics.jsonl"


class Task(Protocol):
    """What is trained. A step depends on nothing but the state and its number: a resumed run is the same run."""

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Step number `iteration`, counted from 0; its metrics."""

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Figures of the state after `iteration` steps, as JSON values."""

    def state(self) -> Mapping[str, Tensor]:
        """All that the next step depends on."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `state` gave."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """How long and how often.

    Attributes:
        iterations: steps in all.
        log_every, evaluate_every: steps between lines of metrics and between evaluations; both also come at the end,
            and an evaluation at the start.
        checkpoint_seconds: a kill loses at most the steps of this time.
        max_seconds: stop with a checkpoint when this session has worked as long.
    """

    iterations: int
    log_every: int = 10
    evaluate_every: int = 250
    checkpoint_seconds: float = 30.0
    max_seconds: float = float("inf")


@dataclass(frozen=True)
class Progress:
    """Where the loop is.

    Attributes:
        iteration, iterations: steps done, steps in all.
        seconds: spent in steps, all sessions together.
        rate: steps a second of this session.
        metrics: of the last logged step. evaluation: figures, when this call follows an evaluation.
    """

    iteration: int
    iterations: int
    seconds: float
    rate: float
    metrics: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Mapping[str, Any] | None = None

    @property
    def finished(self) -> bool:
        return self.iteration >= self.iterations


def run_training(
    task: Task, config: LoopConfig, folder: Path, *, key: str, report: Callable[[Progress], None] = lambda p: None
) -> Progress:
    """Train, from the checkpoint in `folder` if it has this `key`, else from the start.

    `folder` gets `metrics.jsonl` and, until the last step, `state.safetensors`. Evaluations do not count as time spent.

    Returns:
        Where training ended: before the last step only when `max_seconds` was over.

    Raises:
        DivergedError: from the task; the last checkpoint is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    state, metrics = folder / STATE_FILE, folder / METRICS_FILE
    checkpoint = load_checkpoint(state, key=key)
    if checkpoint is None:
        done, spent_before = 0, 0.0
        metrics.unlink(missing_ok=True)
    else:
        done, spent_before = checkpoint.iteration, checkpoint.seconds
        task.restore(checkpoint.tensors)
        truncate_metrics(metrics, done)
    first, spent, unsaved = done, 0.0, 0.0
    logged: Mapping[str, Any] = {}

    def progress(evaluation: Mapping[str, Any] | None = None) -> Progress:
        rate = (done - first) / spent if spent else 0.0
        return Progress(done, config.iterations, spent_before + spent, rate, logged, evaluation)

    def log(kind: str, values: Mapping[str, Any]) -> None:
        seconds = round(spent_before + spent, 3)
        append_metrics(metrics, {"kind": kind, "iteration": done, "seconds": seconds, **values})

    def evaluate() -> None:
        figures = task.evaluate(done)
        log("evaluation", figures)
        report(progress(figures))

    def save() -> None:
        save_checkpoint(state, Checkpoint(done, spent_before + spent, key, task.state()))

    if not done:
        evaluate()
    while done < config.iterations and spent < config.max_seconds:
        begin = time.perf_counter()
        values = task.step(done)
        took = time.perf_counter() - begin
        done, spent, unsaved = done + 1, spent + took, unsaved + took
        last = done == config.iterations
        if done % config.log_every == 0 or last:
            logged = values
            log("step", {**values, "iterations_per_second": round((done - first) / spent, 3)})
            report(progress())
        if done % config.evaluate_every == 0 or last:
            evaluate()
        if unsaved >= config.checkpoint_seconds and not last:
            save()
            unsaved = 0.0
    if done < config.iterations:
        save()
    return progress()
