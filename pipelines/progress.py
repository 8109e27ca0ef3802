"""Progress of a run of stages in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


@contextmanager
def stage_progress(count: int, *, enabled: bool = True) -> Iterator[Callable[[str, bool], None]]:
    """A bar over `count` stages; yields `step(name, done)` to call before (False) and after (True) each."""
    columns = (SpinnerColumn(), TextColumn("{task.description:<14}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not enabled) as progress:
        task = progress.add_task("start", total=count)

        def step(name: str, done: bool) -> None:
            progress.update(task, description=name, advance=1 if done else 0)

        yield step


@contextmanager
def counted_progress(what: str, *, enabled: bool = True) -> Iterator[Callable[[int, int], None]]:
    """A bar over things that are counted; yields `show(done, count)`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not enabled, transient=True) as progress:
        task = progress.add_task(what, total=None)

        def show(done: int, count: int) -> None:
            progress.update(task, completed=done, total=count)

        yield show
