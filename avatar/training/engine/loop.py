"""The training loop: steps, metrics, evaluations, checkpoints and a time limit."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from avatar.training.engine.checkpoints import STATE_FILE, Checkpoint, CheckpointWriter, load_checkpoint
from avatar.training.engine.metrics_log import TensorboardLog, append_metrics, truncate_metrics
from avatar.training.engine.optimization_task import DivergedError
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import explain_resource_errors

log = logging.getLogger(__name__)


METRICS_FILE = "metrics.jsonl"
TENSORBOARD_FOLDER = "tensorboard"


class Task(Protocol):
    """A training. Its steps depend on state and step number alone, so that a resumed run gives the same bits.

    Attributes:
        distributed: the processes that train together. All take every step; the first alone evaluates and saves.
    """

    distributed: Distributed

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Take step number `iteration`, counted from 0; return its metrics: JSON values and scalar tensors."""

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return figures of the state after `iteration` steps, as JSON values."""

    def state(self) -> Mapping[str, Tensor]:
        """Return all tensors that the next step depends on, by name."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from tensors that `state` returned."""

    def halve_rates(self) -> None:
        """Halve all learning rates from now on."""

    def leave_out(self, iteration: int) -> None:
        """Count a step that diverged as taken, without a change of what it learns."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Number of steps and intervals of logs, evaluations and checkpoints.

    Attributes:
        iterations: number of all steps.
        log_every: steps between lines of metrics, which also come at the end.
        evaluate_every: steps between evaluations, which also come at the start and at the end.
        checkpoint_seconds: of steps between two checkpoints; None: 30, or longer for writing to take 2 % of the time.
        max_seconds: stop with a checkpoint when this session's steps took this time.
        keep_end: keep a checkpoint of the end too, for stages in which another training follows.
        tensorboard: log for TensorBoard too.
    """

    iterations: int
    log_every: int = 10
    evaluate_every: int = 250
    checkpoint_seconds: float | None = None
    max_seconds: float = float("inf")
    keep_end: bool = False
    tensorboard: bool = False


@dataclass(frozen=True)
class Progress:
    """Progress of a training: finished steps, time and figures.

    Attributes:
        iteration: number of finished steps.
        iterations: number of all steps.
        seconds: spent in steps, over all sessions.
        rate: steps a second of this session.
        metrics: of the last logged step.
        evaluation: figures, when this call follows an evaluation.
        session_seconds: spent in steps of this session.
    """

    iteration: int
    iterations: int
    seconds: float
    rate: float
    metrics: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Mapping[str, Any] | None = None
    session_seconds: float = 0.0

    @property
    def finished(self) -> bool:
        """Whether all steps of the training are done."""
        return self.iteration >= self.iterations


def run_training(
    task: Task, config: LoopConfig, folder: Path, *, key: str, report: Callable[[Progress], None] = lambda p: None
) -> Progress:
    """Train from the checkpoint in `folder` if there is one, else from the start.

    `folder` gets `metrics.jsonl` and, until the last step, `state.safetensors`. The time of evaluations is not counted.
    Of several processes all start from the first one's state and use its clock; it alone reads, evaluates and writes.
    A step whose loss or gradient is not finite is left out with a warning, and the first one halves the learning rates.
    Three in a row, or more than 3 and a hundredth of all steps, end the training.

    Args:
        task: the training.
        config: number of steps and intervals.
        folder: of metrics and checkpoint.
        key: digest of configuration and inputs; a checkpoint of another key is refused.
        report: called by the first process after lines of metrics.

    Returns:
        The progress at the end: before the last step only when `max_seconds` was over.

    Raises:
        InputError: a checkpoint of another key or version, which stays as it is; memory or disk ran out, or too many
            steps diverged (`DivergedError`), and the last checkpoint is kept.
        MissingExtraError: a log for TensorBoard without tensorboard.
    """
    processes = task.distributed
    state, metrics = folder / STATE_FILE, folder / METRICS_FILE
    sinks: list[Callable[[Mapping[str, Any]], None]] = [partial(append_metrics, metrics)]
    logged: Mapping[str, Any] = {}

    def open_events() -> None:
        if config.tensorboard:
            events = TensorboardLog(folder / TENSORBOARD_FOLDER, redone=done + 1 if done else 0)
            sinks.append(stack.enter_context(closing(events)).add)

    def progress(evaluation: Mapping[str, Any] | None = None) -> Progress:
        # Steps of this session by their time; evaluations and checkpoints are not counted.
        rate = (done - first) / spent if spent else 0.0
        return Progress(done, config.iterations, spent_before + spent, rate, logged, evaluation, spent)

    def log(kind: str, values: Mapping[str, Any]) -> None:
        seconds = round(spent_before + spent, 3)
        for sink in sinks:
            sink({"kind": kind, "iteration": done, "seconds": seconds, **values})

    def log_step() -> None:
        log("step", {**logged, "iterations_per_second": round((done - first) / spent, 3)})
        report(progress())

    def evaluate() -> None:
        figures = task.evaluate(done)
        log("evaluation", figures)
        report(progress(figures))

    def save() -> float:
        return writer.write(Checkpoint(done, spent_before + spent, key, task.state(), divergence.count))

    with explain_resource_errors(folder), ExitStack() as stack:
        # Start from the checkpoint, or evaluate the initial state.
        begun = _begin(task, state, metrics, key)
        done, spent_before = begun.iteration, begun.seconds
        divergence = Divergence(task, config.iterations, begun.diverged)
        first, spent, unsaved = done, 0.0, 0.0
        writer = stack.enter_context(closing(CheckpointWriter(state)))
        interval = writer.least_seconds if config.checkpoint_seconds is None else config.checkpoint_seconds
        processes.run_on_rank0(open_events)
        if not done:
            processes.run_on_rank0(evaluate)
        # Steps, with logs, evaluations and checkpoints at their intervals.
        while done < config.iterations and spent < config.max_seconds:
            # The first process's clock counts for all, so that all stop at the same step.
            begin = time.perf_counter()
            values = divergence.step(done)
            took = processes.run_on_rank0(lambda: time.perf_counter() - begin)  # noqa: B023  called at once
            done, spent, unsaved = done + 1, spent + took, unsaved + took
            last = done == config.iterations
            if done % config.log_every == 0 or last:
                logged = _as_numbers(values)
                processes.run_on_rank0(log_step)
            if done % config.evaluate_every == 0 or last:
                processes.run_on_rank0(evaluate)
            if unsaved >= interval and not last:
                due = processes.run_on_rank0(save)
                interval = due if config.checkpoint_seconds is None else config.checkpoint_seconds
                unsaved = 0.0
        # A checkpoint of an unfinished training, and of the end on request.
        if done < config.iterations or (config.keep_end and done > first):
            processes.run_on_rank0(save)
        processes.run_on_rank0(writer.finish)
        return progress()


class Divergence:
    """Takes a task's steps and leaves out those that diverge, as long as they are few.

    Args:
        task: the training.
        iterations: number of all its steps.
        count: of steps that were left out before.
    """

    def __init__(self, task: Task, iterations: int, count: int) -> None:
        self.task, self.count, self._in_a_row = task, count, 0
        self._values: Mapping[str, Any] = {}
        # A hundredth: batches with one damaged view of a hundred.
        self._most = 3 + iterations // 100
        if count:
            task.halve_rates()

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Take a step; one that is left out repeats the metrics of the step before, with the number of those left out.

        Raises:
            DivergedError: of three steps in a row, which no single view explains, or of too many.
        """
        try:
            values = self.task.step(iteration)
        except DivergedError as error:
            self.count, self._in_a_row = self.count + 1, self._in_a_row + 1
            if self._in_a_row == 3 or self.count > self._most:
                raise
            if self.count == 1:
                self.task.halve_rates()
            self.task.leave_out(iteration)
            rates = "; learning rates are halved" if self.count == 1 else ""
            log.warning("%s is left out: its loss or a gradient is %s%s", error.subject, error.received, rates)
            return {**self._values, "diverged": self.count}
        self._in_a_row, self._values = 0, values
        return values


def _as_numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return metrics with all scalar tensors as numbers, in one transfer."""
    names = [name for name, value in values.items() if isinstance(value, Tensor)]
    numbers = torch.stack([values[name].float() for name in names]).tolist() if names else []
    return {**values, **dict(zip(names, numbers, strict=True))}


def _begin(task: Task, state: Path, metrics: Path, key: str) -> Checkpoint:
    """Restore every process to the checkpoint or the first one's state, and return it."""

    def start() -> Checkpoint:
        state.parent.mkdir(parents=True, exist_ok=True)
        for left in (*state.parent.glob(f".{state.stem}.*"), *state.parent.glob(f".{metrics.stem}.*")):
            left.unlink()  # a partial file of a session that was killed while it wrote
        checkpoint = load_checkpoint(state, key=key)
        if checkpoint is not None and checkpoint.iteration:
            truncate_metrics(metrics, checkpoint.iteration)
            return checkpoint
        metrics.unlink(missing_ok=True)  # a training without steps evaluates its start again
        return checkpoint or Checkpoint(
            0, 0.0, key, {name: value.detach().cpu() for name, value in task.state().items()}
        )

    # All processes restore the same tensors, also at a new start, so that they begin with equal bits.
    checkpoint = task.distributed.run_on_rank0(start, kinds=(Checkpoint,))
    task.restore(checkpoint.tensors)
    return checkpoint
