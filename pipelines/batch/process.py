"""Run a command as a process of its own, or as several that work together, and tell what its end means."""

from __future__ import annotations

import errno
import logging
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_object, read_json
from smplxpp.core.files.paths import read_bytes

log = logging.getLogger(__name__)
Meaning = Literal["done", "refused", "failed", "system", "disk", "busy", "again", "stopped", "code"]
"""What an end means. `system`: another attempt may help; `disk`: it is full; `busy`: another process is in the run
folder; `again`: a limit of time stopped the command, which continues when it is given once more; `code`: the installed
code is not that of the batch."""
PATIENCE = ("SIGINT", "SIGTERM", "SIGKILL")
"""How a command is asked to end, from the kindest: on the first it says what it keeps."""

BOUND = ("setpriv", "--pdeathsig", "TERM") if shutil.which("setpriv") else ()
"""Words before a command that end it with this process, where the system can do that."""


@dataclass(frozen=True)
class Ended:
    """How a process ended.

    Attributes:
        exit_status: negative: the signal that ended it.
        seconds: by the clock.
        cpu_seconds: of it and its children.
        peak_mb: largest memory of one of them, 10^6 bytes.
        stopped: whether it was asked to end.
    """

    exit_status: int
    seconds: float
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    stopped: bool = False


def run_process(
    command: Sequence[str],
    *,
    log: Path,
    answer: Path,
    environment: Mapping[str, str],
    folder: Path,
    stop: Callable[[], bool],
    began: Callable[[int], None],
) -> Ended:
    """Run a command to its end, or until it is asked to stop.

    It has a process group of its own, which ends with it, and which the system ends when this process is killed (Linux
    with `setpriv`; elsewhere an orphan is ended by `end_orphan` at the next start).

    Args:
        command: program and arguments.
        log: file that its standard error is appended to.
        answer: file that takes its standard output.
        environment: variables beside those of this process.
        folder: working directory.
        stop: asked about every second whether the command shall end.
        began: takes the number of the process.
    """
    begin = time.perf_counter()
    with open(log, "ab") as errors, open(answer, "wb") as out:
        child = subprocess.Popen(
            [*BOUND, *command],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=errors,
            cwd=folder,
            env={**os.environ, **environment},
            start_new_session=True,
        )
        asked = False
        try:
            began(child.pid)
            asked = _wait(child, stop)
        finally:
            # Whatever ends this block, an interrupt or an error of a record, leaves no process behind.
            if child.returncode is None:
                _end(child)
    used = getattr(child, "used", None)
    return Ended(
        exit_status=child.returncode,
        seconds=time.perf_counter() - begin,
        cpu_seconds=0.0 if used is None else used.ru_utime + used.ru_stime,
        # Linux counts in KiB, macOS in bytes.
        peak_mb=0.0 if used is None else used.ru_maxrss * (1e-6 if sys.platform == "darwin" else 1.024e-3),
        stopped=asked,
    )


def run_together(command: Sequence[str], count: int, *, captured: bool) -> tuple[int, str]:
    """Run a command as processes of this machine that find each other by the variables that torchrun sets.

    When one ends with an error, the others get some seconds to do so themselves, and are ended then; after a signal,
    and by an interrupt, they are ended at once. The first one speaks; of others that fail the last line is shown.

    Args:
        command: program and arguments.
        count: of processes, at least two.
        captured: return the first one's standard output, after the exit status, instead of showing it.

    Raises:
        ChildProcessError: one was ended by a signal.
    """
    from avatar.training.engine.processes import torchrun_variables  # pulls torch in, which others need not wait for

    grace = 10.0  # seconds in which an error is worded everywhere; messages of NCCL would be waited for, for hours
    store, found_by = torchrun_variables()
    variables = {"OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // count)), **os.environ, **found_by}
    children = list[subprocess.Popen]()
    with tempfile.TemporaryDirectory(prefix="smplxpp_processes_") as folder, ExitStack() as files:
        paths = [Path(folder) / str(rank) for rank in range(count)]
        outputs = [files.enter_context(open(path, "wb")) for path in paths]
        try:
            for rank, output in enumerate(outputs):
                child = subprocess.Popen(
                    [*BOUND, *command],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL if rank else output if captured else None,
                    stderr=output if rank else None,
                    env={**variables, "RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(count)},
                    start_new_session=True,
                )
                children.append(child)
            until = math.inf
            while not all([_ended(child) for child in children]) and time.monotonic() < until:
                failed = [child.returncode for child in children if child.returncode]
                if failed and until == math.inf:
                    until = time.monotonic() + (grace if min(failed) > 0 else 0.0)
                time.sleep(0.05)
            ends = [child.returncode for child in children]  # of their own; None: still running
        finally:
            _end(*children)
            del store
        for rank, end in enumerate(ends):
            if end is not None and end < 0:
                raise ChildProcessError(
                    f"process {rank} of {count}: expected to run to its end, received {_signal_name(-end)}. All are "
                    "ended; SIGKILL is the system's where memory is out. The same command continues from the checkpoint"
                )
            if rank and end:
                log.error("process %d of %d: %s", rank, count, _last_lines(paths[rank]) or f"exit status {end}")
        status = ends[0] if ends[0] is not None else max(end or 0 for end in ends)
        return status, read_bytes(paths[0]).decode(errors="replace")


def own_program(module: str = "pipelines.cli") -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the words that start `smplxpp`, or another module, in this Python, and variables for the same code.

    The working directory is left out of Python's path, because captures lie there, and files of any name.
    """
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    installed = Path(root).name in ("site-packages", "dist-packages")
    variables = {} if installed else {"PYTHONPATH": os.pathsep.join(filter(None, dict.fromkeys(paths)))}
    return (sys.executable, "-P", "-m", module), variables


def meaning_of(ended: Ended, *, log: Path, answer: Path, judged: bool) -> tuple[Meaning, dict[str, Any] | None]:
    """Return what the end of a command means, and its error.

    Args:
        ended: how it ended.
        log: its standard error.
        answer: its standard output, JSON where it came to an end of its own.
        judged: whether exit status 1, failed checks, is a failure.
    """
    content, last = _answer(answer), _last_lines(log)
    error = content.get("error") if isinstance(content.get("error"), dict) else None
    if ended.stopped:
        return "stopped", None
    if ended.exit_status < 0:
        name = _signal_name(-ended.exit_status)
        words = f"ended by {name}"
        words += ": probably out of memory, the system's log tells" if name == "SIGKILL" else ""
        return "system", {"message": words, "last": last}
    # An error that the command has worded. A full disk is no fault of the input, and a run in use is free later.
    if error is not None:
        message = str(error.get("message", ""))
        if _names_a_full_disk(message):
            return "disk", error
        if error.get("received") == "a running one":
            return "busy", error
        return ("system" if error.get("type") in ("MemoryError", "OSError", "ChildProcessError") else "refused"), error
    if ended.exit_status == 0 and content:
        return ("again" if content.get("finished") is False else "done"), None
    if ended.exit_status == 1 and content:
        return ("failed", _failed_checks(content)) if judged else ("done", None)
    # What is left came to no answer: an exception that nothing worded, options that tyro refused, a lost disk.
    if _names_a_full_disk(last):
        return "disk", {"message": last}
    worn_out = re.search(r"OutOfMemory|out of memory|Cannot allocate memory|Signal \d+ \(SIG|NCCL|ECC error", last)
    if worn_out or ended.exit_status == 0:
        return "system", {"message": last or "ended without an answer"}
    return "failed", {"message": last or f"exit status {ended.exit_status}"}


def end_orphan(pid: int, mark: str, *, patience: float = 20.0) -> bool:
    """End a process of a driver that was killed, if it still runs; whether it did.

    Args:
        pid: its number, which another process may have by now.
        mark: a path that its command line names.
        patience: seconds that it gets before it is killed.
    """
    try:
        words = read_bytes(f"/proc/{pid}/cmdline").decode(errors="replace") if pid > 0 else ""
    except InputError:
        words = ""
    if mark not in words:
        return False
    for name in PATIENCE[1:]:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, getattr(signal, name))
        until = time.monotonic() + patience
        while time.monotonic() < until:
            if not Path(f"/proc/{pid}").exists():
                return True
            time.sleep(0.1)
    return True


def _wait(child: subprocess.Popen, stop: Callable[[], bool]) -> bool:
    """Wait for a process; whether it was asked to stop."""
    pause, asked_at = 0.02, time.monotonic()
    while not _ended(child):
        time.sleep(pause)
        # Short commands are seen to end at once; long ones cost nothing.
        pause = min(1.2 * pause, 0.25)
        if time.monotonic() - asked_at > 1.0:
            asked_at = time.monotonic()
            if stop():
                _end(child)
                return True
    return False


def _ended(child: subprocess.Popen) -> bool:
    """Return whether a process has ended, and keep what it used."""
    if not hasattr(os, "wait4"):  # Windows
        return child.poll() is not None
    try:
        pid, status, used = os.wait4(child.pid, os.WNOHANG)
    except ChildProcessError:  # another part of this process has waited for it
        return child.poll() is not None
    if pid:
        child.returncode = os.waitstatus_to_exitcode(status)
        child.used = used  # type: ignore[attr-defined]
    return bool(pid)


def _end(*children: subprocess.Popen, patience: float = 10.0) -> None:
    """End processes and their groups, at first kindly; each word gets some seconds."""
    for name in PATIENCE:
        for child in [child for child in children if not _ended(child)]:
            with suppress(ProcessLookupError, PermissionError):
                if hasattr(os, "killpg"):
                    os.killpg(child.pid, getattr(signal, name))
                else:
                    child.terminate()
        until = time.monotonic() + patience
        while time.monotonic() < until:
            if all([_ended(child) for child in children]):
                return
            time.sleep(0.02)


def _answer(path: Path) -> dict[str, Any]:
    try:
        return as_object(read_json(path, subject="answer"), subject="answer")
    except InputError:  # none, or half of one
        return {}


def _last_lines(log: Path, *, most: int = 2000) -> str:
    """Return the last line of a log that says something, and of an exception its message."""
    try:
        size = log.stat().st_size
        with open(log, "rb") as file:
            file.seek(max(size - 16 * most, 0))
            lines = [line.strip(" │╭╰─╮╯") for line in file.read().decode(errors="replace").splitlines()]
    except OSError:
        return ""
    full = [line for line in lines if line]
    found = [line for line in full if re.match(r"[\w.]*(Error|Exception|Interrupt)\b", line)]
    return (found[-1:] or full[-1:] or [""])[0][:most]


def _failed_checks(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the checks of a build, or the findings of a capture's check, that failed, as an error."""
    listed = [one for name in ("checks", "findings") for one in content.get(name) or [] if isinstance(one, dict)]
    failed = [one for one in listed if one.get("status") == "fail"]
    words = [str(one.get("message") or one.get("name") or "a check") for one in failed]
    advice = [str(one["remedy"]) for one in failed if one.get("remedy")]
    shown = "; ".join(words[:4]) + (f"; and {len(words) - 4} more" if len(words) > 4 else "")
    return {
        "message": f"{len(failed)} checks failed: {shown}",
        "expected": "checks that pass",
        "received": shown,
        "remedy": advice[0] if advice else "see its report; `accept` in the job file continues all the same",
        "checks": words,
    }


def _names_a_full_disk(words: str) -> bool:
    return any(os.strerror(number) in words for number in (errno.ENOSPC, errno.EDQUOT))


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
