"""The training loop: steps, metrics, evaluations, checkpoints and a time limit."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from safetensors.torch import save
from torch import Tensor

from avatar.gaussians.tensor_file import open_tensor_file
from avatar.training.engine.metrics_log import TensorboardLog, append_metrics, truncate_metrics
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import explain_resource_errors
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.json_file import as_integer, as_number, shown

SCHEMA = 1
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of a training after `iteration` steps.

    Attributes:
        iteration: number of finished steps.
        seconds: their time over all sessions.
        key: digest of configuration and inputs; a training continues only from a checkpoint of its own key.
        tensors: parameters and the optimiser's state by name.
    """

    iteration: int
    seconds: float
    key: str
    tensors: Mapping[str, Tensor]


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint as safetensors, atomically: a kill or a full disk leaves the one before."""
    # One metadata entry, because safetensors writes several in an order that differs from run to run.
    about = {"iteration": checkpoint.iteration, "seconds": checkpoint.seconds, "key": checkpoint.key}
    tensors = {name: value.detach().cpu().contiguous() for name, value in checkpoint.tensors.items()}
    atomic_write_bytes(path, save(tensors, metadata={"training": json.dumps({"schema": SCHEMA, **about})}))


def load_checkpoint(path: str | Path, *, key: str) -> Checkpoint | None:
    """Return the checkpoint in a file; None where there is none or it cannot be read, which is logged.

    Raises:
        InputError: one of another training or of another version of the format. It may hold hours of work, so that
            only the user may delete it.
    """
    path = Path(path)
    if not path.exists():
        return None
    try:
        # A checkpoint of this key and version is read with checks of its header.
        file = open_tensor_file(path, subject=f"checkpoint {path}", header="training")
        schema, found = file.about["schema"], file.about.get("key")
        if schema == SCHEMA and found == key:
            iteration = as_integer(file.about.get("iteration"), subject="iteration", least=0)
            seconds = as_number(file.about.get("seconds"), subject="seconds", least=0.0)
            return Checkpoint(iteration, seconds, key, file.tensors())
    except (InputError, KeyError) as error:
        log.warning("%s cannot be read (%s): the training starts over", path, error)
        return None
    # A readable checkpoint that does not fit is never overwritten silently.
    if schema != SCHEMA:
        raise InputError(
            f"checkpoint {path}",
            expected=f"version {SCHEMA} of the format",
            received=f"version {shown(schema)}",
            remedy="continue with the smplxpp that wrote it; to start again, delete it (--force does)",
        )
    raise InputError(
        f"checkpoint {path}",
        expected="one of these options, inputs and code",
        received=f"one of others, at iteration {shown(file.about.get('iteration'))}",
        remedy="give the options that it was made with, or take another run folder; to start again, delete it "
        "(--force does)",
    )


STATE_FILE = "state.safetensors"
METRICS_FILE = "metrics.jsonl"
TENSORBOARD_FOLDER = "tensorboard"


class Task(Protocol):
    """A training. Its steps depend on state and step number alone, so that a resumed run gives the same bits.

    Attributes:
        distributed: the processes that train together. All take every step; the first alone evaluates and saves.
    """

    distributed: Distributed

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Take step number `iteration`, counted from 0; return its metrics."""

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return figures of the state after `iteration` steps, as JSON values."""

    def state(self) -> Mapping[str, Tensor]:
        """Return all tensors that the next step depends on, by name."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from tensors that `state` returned."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Number of steps and intervals of logs, evaluations and checkpoints.

    Attributes:
        iterations: number of all steps.
        log_every: steps between lines of metrics, which also come at the end.
        evaluate_every: steps between evaluations, which also come at the start and at the end.
        checkpoint_seconds: a kill loses at most the steps of this time.
        max_seconds: stop with a checkpoint when this session's steps took this time.
        keep_end: keep a checkpoint of the end too, for stages in which another training follows.
        tensorboard: log for TensorBoard too.
    """

    iterations: int
    log_every: int = 10
    evaluate_every: int = 250
    checkpoint_seconds: float = 30.0
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

    Args:
        task: the training.
        config: number of steps and intervals.
        folder: of metrics and checkpoint.
        key: digest of configuration and inputs; a checkpoint of another key is refused.
        report: called by the first process after lines of metrics.

    Returns:
        The progress at the end: before the last step only when `max_seconds` was over.

    Raises:
        InputError: a checkpoint of another key or version, which stays as it is; memory or disk ran out, or the task
            diverged (`DivergedError`), and the last checkpoint is kept.
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

    def save() -> None:
        save_checkpoint(state, Checkpoint(done, spent_before + spent, key, task.state()))

    with explain_resource_errors(folder), ExitStack() as stack:
        # Start from the checkpoint, or evaluate the initial state.
        done, spent_before = _begin(task, state, metrics, key)
        first, spent, unsaved = done, 0.0, 0.0
        processes.run_on_rank0(open_events)
        if not done:
            processes.run_on_rank0(evaluate)
        # Steps, with logs, evaluations and checkpoints at their intervals.
        while done < config.iterations and spent < config.max_seconds:
            # The first process's clock counts for all, so that all stop at the same step.
            begin = time.perf_counter()
            values = task.step(done)
            took = processes.run_on_rank0(lambda: time.perf_counter() - begin)  # noqa: B023  called at once
            done, spent, unsaved = done + 1, spent + took, unsaved + took
            last = done == config.iterations
            if done % config.log_every == 0 or last:
                logged = values
                processes.run_on_rank0(log_step)
            if done % config.evaluate_every == 0 or last:
                processes.run_on_rank0(evaluate)
            if unsaved >= config.checkpoint_seconds and not last:
                processes.run_on_rank0(save)
                unsaved = 0.0
        # A checkpoint of an unfinished training, and of the end on request.
        if done < config.iterations or (config.keep_end and done > first):
            processes.run_on_rank0(save)
        return progress()


def _begin(task: Task, state: Path, metrics: Path, key: str) -> tuple[int, float]:
    """Restore every process to the checkpoint or the first one's state; return finished steps and their seconds."""

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
    checkpoint = task.distributed.run_on_rank0(start)
    task.restore(checkpoint.tensors)
    return checkpoint.iteration, checkpoint.seconds
