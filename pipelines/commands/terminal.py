"""Guard the standard streams of a command, and print errors, notes, checks and paths."""

from __future__ import annotations

import errno
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console
from rich.markup import escape
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
from rich.text import Text

from pipelines.report.model import CheckRow
from smplxpp.core.errors import InputError, ProgressCallback

if TYPE_CHECKING:
    from avatar.training.engine.loop import Progress as TrainingProgress

STDOUT = "standard output"
_FULL = (errno.ENOSPC, errno.EDQUOT)
_REMEDIES = {
    errno.ENOSPC: "free some space or name a place on another disk; nothing half-written was kept",
    errno.EDQUOT: "your quota is used up: delete something or name another place; nothing half-written was kept",
    errno.EFBIG: "files may not grow as large here: see `ulimit -f` and the kind of file system; nothing half-written "
    "was kept",
    errno.EROFS: "name a place that can be written",
    errno.EACCES: "see its permissions and those of its folder, or name another place",
    errno.EPERM: "see its permissions and those of its folder, or name another place",
    errno.ENAMETOOLONG: "shorten the name",
    errno.EIO: "the disk or the network does not answer as it should: see the system's log, try another disk",
    errno.ESTALE: "the network's file system has lost it: open the folder again",
    errno.EMFILE: "raise the number of open files: `ulimit -n 4096`",
    errno.ENFILE: "end other programs: the system has too many files open",
    errno.ELOOP: "a link points to itself: name the file that is meant",
    errno.EEXIST: "name another place",
    errno.ENOTDIR: "a part of the path is a file: name another place",
    errno.EISDIR: "name a file",
}


class OutputError(OSError):
    """Standard output cannot be written; the separate type distinguishes it from errors of files."""


class _Stream:
    """A text stream whose failures raise `OutputError`, or are ignored (standard error has no place to report them)."""

    def __init__(self, stream: TextIO, *, silent: bool) -> None:
        self._stream, self._silent = stream, silent

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with self._named():
            self._stream.write(text)
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        with self._named():
            self._stream.flush()

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            _redirect_to_nothing(self._stream)
            if not self._silent:
                raise OutputError(error.errno, error.strerror, STDOUT) from None


@contextmanager
def standard_streams() -> Iterator[None]:
    """Guard the standard streams of a command.

    Letters that their encoding lacks are written as escapes. A stream that fails is given up: standard output with an
    `OutputError`, standard error silently, as its failing cannot be told. What is not open takes everything.
    """
    with open(os.devnull, "w") as nothing:
        out, err = sys.stdout or nothing, sys.stderr or nothing
        # Letters that the terminal's encoding lacks must not end a command after hours.
        for stream in (out, err):
            with suppress(AttributeError, ValueError, OSError):  # a stream of its own kind, or one already detached
                stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
        with (
            redirect_stdout(_Stream(out, silent=False)),
            redirect_stderr(_Stream(err, silent=True)),
        ):
            yield


def end_of_output(error: OutputError, console: Console) -> int:
    """Print that standard output failed, unless its reader has closed the pipe; return the exit status."""
    # Exit status after the reader of the output has closed its pipe: 128 + SIGPIPE, as a shell reports it.
    closed_pipe = 128 + 13
    if error.errno == errno.EPIPE:
        return closed_pipe
    print_error(error, console)
    return 2


def print_notes(notes: Sequence[str], console: Console, *, title: str = "note", most: int = 8) -> None:
    """Print the first notes and the number of the others, because a long sequence can have hundreds."""
    for note in notes[:most]:
        console.print(f"[yellow]{title}[/]  {escape(note)}", soft_wrap=True, highlight=False)
    if len(notes) > most:
        console.print(f"[dim]and {len(notes) - most} more (--json lists all)[/]")


def print_checks(records: Iterable[Mapping[str, Any]], console: Console) -> None:
    """Print the checks of a manifest that did not pass."""
    for check in map(CheckRow.of, records):
        if check.status != "pass":
            style = "red" if check.status == "fail" else "yellow"
            line = escape(f"{check.name}: {check.shown}, {check.explanation}")
            console.print(f"[{style}]{check.status}[/]  {line}", soft_wrap=True)


def print_paths(paths: Mapping[str, str | Path | None], console: Console) -> None:
    """Print a line with name and path of each file; None is left out."""
    for name, path in paths.items():
        if path is not None:
            console.print(f"{name}  {path}", soft_wrap=True, highlight=False, markup=False)


def print_error(error: Exception, console: Console) -> None:
    """Print an error in words, on one line however long, and what is listed with it on lines of their own."""
    listed = getattr(error, "__notes__", ()) if isinstance(error, InputError) else ()
    words = str(error) if listed else error_in_words(error)
    console.print(Text("error: ", style="red") + Text(" ".join(words.split())), soft_wrap=True)
    for line in listed:
        console.print(Text("  " + " ".join(line.split())), soft_wrap=True)


def error_in_words(error: Exception) -> str:
    """Word an error; what the system refused with the file that it is about, what is free there and what helps."""
    words = str(error)
    if isinstance(error, OSError) and error.strerror:
        place = "" if error.filename is None else os.fsdecode(error.filename)
        # Name the file first, then the cause, the free space of a full disk, and a remedy.
        words = f"{place}: {error.strerror}" if place else error.strerror
        if error.errno in _FULL and place != STDOUT:
            words += _free_space(Path(place))
        remedy = "" if place == STDOUT else _REMEDIES.get(error.errno or 0, "")
        words += f". {remedy[:1].upper()}{remedy[1:]}." if remedy else ""
    return " ".join([words, *getattr(error, "__notes__", ())])


def _free_space(path: Path) -> str:
    folder = next((p for p in (path, *path.parents) if p.is_dir()), Path())
    try:
        return f" ({shutil.disk_usage(folder).free / 1e6:.1f} MB are free there)"
    except OSError:
        return ""


def _redirect_to_nothing(stream: TextIO) -> None:
    """Let the file of a stream take everything: what it still holds would fail again at the interpreter's end."""
    with suppress(OSError, ValueError, AttributeError):  # one without a file has nothing to lose
        descriptor = stream.fileno()
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, descriptor)
        os.close(nothing)


EVERY_SECONDS = 30.0
"""Seconds between two lines of progress where the output is no terminal, as in the log of a job."""


@contextmanager
def _shown(bar: Progress) -> Iterator[Progress]:
    """Show a bar; where the output is no terminal, a line from time to time in its place.

    The line is written by a thread of its own, because a long step reports nothing.
    """
    if bar.disable or bar.console.is_terminal:
        with bar:
            yield bar
        return
    done, began = threading.Event(), time.monotonic()

    def tell() -> None:
        while not done.wait(EVERY_SECONDS):
            for task in bar.tasks:
                share = f"{100 * task.completed / task.total:.0f} %" if task.total else ""
                parts = (task.description, share, task.fields.get("figures", ""), _minutes(time.monotonic() - began))
                bar.console.print("  ".join(filter(None, parts)), soft_wrap=True, highlight=False, markup=False)

    thread = threading.Thread(target=tell, name="progress", daemon=True)
    thread.start()
    try:
        yield bar
    finally:
        done.set()
        thread.join()


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d} min"


@contextmanager
def stage_progress(count: int, *, enabled: bool = True) -> Iterator[Callable[[str, bool], None]]:
    """Show a bar over `count` stages; yields `step(name, done)` to call before (False) and after (True) each."""
    columns = (SpinnerColumn(), TextColumn("{task.description:<14}"), BarColumn(), TimeElapsedColumn())
    with _shown(Progress(*columns, console=Console(stderr=True), disable=not enabled)) as progress:
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
    console = Console(stderr=True)
    bar = Progress(*columns, console=console, disable=not enabled, speed_estimate_period=20.0)
    task = bar.add_task(name, total=total, figures="")

    def show(state: TrainingProgress) -> None:
        nonlocal psnr, psnr_held_out
        if console.is_terminal:
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

    if not console.is_terminal:
        with _shown(bar):
            yield show
        return
    try:
        yield show
    finally:
        bar.stop()


@contextmanager
def shared_progress(*, enabled: bool = True) -> Iterator[ProgressCallback]:
    """Show a bar that fills once for each step of the work; yields the callback that moves it."""
    name = TextColumn("{task.description:<14}")
    columns = (SpinnerColumn(), name, BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with _shown(Progress(*columns, console=Console(stderr=True), disable=not enabled, transient=True)) as progress:
        task = progress.add_task("start", total=1.0)

        def show(step: str, share: float) -> None:
            progress.update(task, description=step, completed=share)

        yield show
