"""Progress of a run of stages in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from smplxpp.core.errors import ProgressCallback

if TYPE_CHECKING:
    from avatar.training.engine.loop import Progress as TrainingProgress


@contextmanager
def stage_progress(count: int, *, enabled: bool = True) -> Iterator[Callable[[str, bool], None]]:
    """Show a bar over `count` stages; yields `step(name, done)` to call before (False) and after (True) each."""
    columns = (SpinnerColumn(), TextColumn("{task.description:<14}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not enabled) as progress:
        task = progress.add_task("start", total=count)

        def step(name: str, done: bool) -> None:
            progress.update(task, description=name, advance=1 if done else 0)

        yield step


@contextmanager
def training_progress(
    name: str, total: int, *, held_out: bool = True, enabled: bool = True
) -> Iterator[Callable[[TrainingProgress], None]]:
    """Show a bar with loss, PSNR, speed and the time that is left; yields what a training reports to.

    Args:
        held_out: whether views are measured that training does not see, where an evaluation does not say so itself.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=10),
        MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    psnr: float | None = None  # of the last evaluation that measured it
    psnr_held_out = held_out
    bar = Progress(*columns, console=Console(stderr=True), disable=not enabled, speed_estimate_period=20.0)
    task = bar.add_task(name, total=total, figures="")

    def show(state: TrainingProgress) -> None:
        nonlocal psnr, psnr_held_out
        bar.start()  # not before: a training that stands reports nothing
        if state.evaluation is not None:
            psnr = state.evaluation["mean"].get("psnr", psnr)
            psnr_held_out = state.evaluation.get("held_out", held_out)
        figures = []
        if "loss" in state.metrics:
            figures.append(f"loss {state.metrics['loss']:.4f}")
        if state.rate:
            figures.append(f"{state.rate:.1f} it/s")
        if psnr is not None:  # a training taken up again has none before its next evaluation
            figures.append(f"PSNR {psnr:.2f} dB {'held out' if psnr_held_out else 'in training'}")
        bar.update(task, completed=state.iteration, total=state.iterations, figures="  ".join(figures))

    try:
        yield show
    finally:
        bar.stop()


@contextmanager
def shared_progress(*, enabled: bool = True) -> Iterator[ProgressCallback]:
    """Show a bar that fills once for each step of the work; yields the callback that moves it."""
    name = TextColumn("{task.description:<14}")
    columns = (SpinnerColumn(), name, BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not enabled, transient=True) as progress:
        task = progress.add_task("start", total=1.0)

        def show(step: str, share: float) -> None:
            progress.update(task, description=step, completed=share)

        yield show
