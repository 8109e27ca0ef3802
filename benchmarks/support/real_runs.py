"""Run a user's command on a recording of a real person, and say in words what came of it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.layout import METRICS_FILE, REGISTRATION, TEMPLATE
from smplxpp.core.files import atomic_write_text

CAPTURE = "capture/capture.json"
_POLL = 0.2  # seconds between two looks at a command: short against minutes, rare enough to cost nothing
_WORDS = 300  # characters of an error or a transcript: a row of a table
_TAIL = 4_000  # characters of output that are kept: an error with its remedy, and the table of checks


@dataclass(frozen=True)
class Ran:
    """A command that has ended.

    Attributes:
        words: the command, without the program.
        status: exit status; negative: the signal that ended it.
        minutes: by the clock.
        cpu_minutes: of the process and its children.
        memory_gib: largest resident memory.
        tail: the end of what it printed.
    """

    words: tuple[str, ...]
    status: int
    minutes: float
    cpu_minutes: float
    memory_gib: float
    tail: str

    def save(self, path: Path) -> None:
        """Write the record, for measuring again without running again."""
        atomic_write_text(path, json.dumps(asdict(self), indent=1))

    @staticmethod
    def load(path: Path) -> Ran:
        """Read what `save` wrote."""
        record = json.loads(path.read_text())
        return Ran(**{**record, "words": tuple(record["words"])})


def run_command(words: Sequence[str], log: Path) -> Ran:
    """Run `smplxpp WORDS` to its end and measure time and memory.

    Args:
        words: arguments of the command.
        log: file for everything that it prints.
    """
    begin = time.monotonic()
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "pipelines.cli", *words], stdout=stream, stderr=subprocess.STDOUT
        )
        # The kernel tells time and memory of a child only to the call that collects it, which `Popen.wait` would be.
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            time.sleep(_POLL)
    _, code, usage = ended
    process.returncode = os.waitstatus_to_exitcode(code)
    # Linux counts resident memory in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    return Ran(
        words=tuple(words),
        status=process.returncode,
        minutes=(time.monotonic() - begin) / 60.0,
        cpu_minutes=(usage.ru_utime + usage.ru_stime) / 60.0,
        memory_gib=usage.ru_maxrss * unit / 2**30,
        tail=log.read_text(errors="replace")[-_TAIL:],
    )


def outcome(ran: Ran, run: Path) -> dict[str, Any]:
    """Say what a command has made of a recording.

    Args:
        ran: the command.
        run: folder of the run that it wrote, if it wrote one.

    Returns:
        `outcome` in words, `status`, and for a build the counts of its checks and the names of those that failed.
    """
    found: dict[str, Any] = {"status": ran.status}
    metrics = run / METRICS_FILE
    checks = json.loads(metrics.read_text())["checks"] if metrics.is_file() else []
    failed = [check["name"] for check in checks if check["status"] == "fail"]
    counts = {word: sum(check["status"] == word for check in checks) for word in ("pass", "warn", "fail")}
    if checks:
        found |= {"checks": counts, "failed": failed}
    confidence = [check["value"] for check in checks if check["name"].startswith("confidence of the body")]
    if confidence:
        found["confidence"] = round(float(confidence[0]), 3)
    if (run / TEMPLATE).is_file():
        words = f"a template, {counts['pass']} checks pass, {counts['warn']} warn, {counts['fail']} fail"
    elif (run / REGISTRATION).is_file():
        after = json.loads((run / REGISTRATION).read_text())["residuals"]["after"].get("keypoints_px", [])
        pixels = float(np.median(after)) if after else float("nan")
        words = f"registered in {len(after)} frames, keypoints {pixels:.1f} px off"
        found["keypoints_px"] = round(pixels, 1)
    elif ran.status == 0 and (run.parent / CAPTURE).is_file():
        turn = json.loads((run.parent / CAPTURE).read_text())["found"]
        words = "a capture of {frames} frames, keypoints {keypoints_px:.1f} px, contours {silhouette_px:.1f} px off"
        words = words.format(**turn)
        found["keypoints_px"] = round(turn["keypoints_px"], 1)
    elif ran.status == 0:
        # What `talk` heard stands in its output, a line for the words and one for a note.
        heard = [text.strip() for text in ran.tail.splitlines() if text.startswith("heard")]
        words = "; ".join(heard)[:_WORDS] or "done"
    elif ran.status < 0:
        words = f"killed by signal {-ran.status}"
    else:
        words = f"stopped: {last_words(ran.tail)}"
    return {"outcome": words, **found}


def last_words(text: str) -> str:
    """Return the error that ends an output, in one line of at most 300 characters."""
    lines = [re.sub(r"\s+", " ", line).strip("│ ") for line in text.splitlines()]
    lines = [line for line in lines if line and not re.fullmatch(r"[─╭╮╰╯━ ]+", line)]
    # An error begins with the word; what stands before it are notes of stages that went well.
    begin = max((k for k, line in enumerate(lines) if re.match(r"(\w*Error|error)\b", line)), default=len(lines) - 1)
    words = " ".join(lines[max(begin, 0) :])
    return words if len(words) <= _WORDS else words[: _WORDS - 3] + "..."
