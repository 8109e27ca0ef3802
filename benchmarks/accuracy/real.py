"""Give public recordings of real people to the commands that a user would type, and store what comes of it.

    python -m benchmarks real --sources DIR [--out DIR] [--only KEY ...] [--again]

`benchmarks.support.real_sources` lists the recordings, their licences, and where their files are expected below DIR.
Nothing of them is stored: the result has figures, outcomes in words, and an assessment by eye, which a person writes
into benchmarks/results/real.json by hand and which stays while the template that it speaks of is the same. Every
command runs to its end, one at a time; a sheet of pictures a row is written to OUT/KEY/sheet.png.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from benchmarks.support.real_sources import SOURCES, Source, chosen_sources
from benchmarks.support.real_truth import distances, fingerprint, write_sheet
from benchmarks.support.results import RESULTS, store_results
from pipelines.runs.layout import METRICS_FILE, REGISTRATION, TEMPLATE
from smplxpp.body import BodyModel, load_body
from smplxpp.core import InputError
from smplxpp.core.files import atomic_write_text

CAPTURE = "capture/capture.json"
_POLL = 0.2  # seconds between two looks at a command: short against minutes, rare enough to cost nothing
_WORDS = 300  # characters of an error or a transcript: a row of a table
_TAIL = 4_000  # characters of output that are kept: an error with its remedy, and the table of checks
COMMAND = "python -m benchmarks real --sources DIR"
RECORD = "ran.json"


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


@dataclass(frozen=True)
class Real:
    """Run, measure, draw, store; one recording after the other."""

    sources: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder with the files of the sources."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/real")
    """Folder for runs, what they print, and sheets."""
    only: tuple[str, ...] = ()
    """These sources alone, by their keys; the stored rows of the others are kept."""
    again: bool = False
    """Measure and draw the runs that are there again, without running them."""
    store: bool = True
    """Write benchmarks/results/real.json after every row."""
    results: Path = RESULTS
    """Folder of the result."""

    def run(self) -> None:
        """Print a table and store the rows."""
        there, absent = chosen_sources(self.sources, self.only)
        body, rows = load_body(), stored_rows(self.results)
        for source in there:
            row = self._row(source, body)
            rows[source.key] = with_assessment(row, rows.get(source.key, {}))
            if self.store:
                self._store(rows)
            print(line(rows[source.key]), flush=True)
        if absent:
            print("not there: " + ", ".join(source.key for source in absent))

    def _row(self, source: Source, body: BodyModel) -> dict[str, Any]:
        """Run the command of a source, or take up its run, and measure what it made."""
        folder = self.out / folder_name(source.key)
        run = folder / "run"
        record = folder / RECORD
        if not self.again:
            # Stages that stand from an earlier run would be skipped, and the minutes would be none.
            if folder.exists() and not record.is_file() and any(folder.iterdir()):
                raise InputError(
                    f"folder for {source.key}",
                    expected=f"a run of this benchmark with its {RECORD}, or none",
                    received=f"{folder} without it",
                    remedy="remove it, or give another --out",
                )
            shutil.rmtree(folder, ignore_errors=True)
            run_command(self._words(source, folder), folder / "log.txt").save(record)
        elif not record.is_file():
            raise InputError(f"run of {source.key}", expected=f"{record}", received="none", remedy="omit --again")
        ran = Ran.load(record)
        row = {**described(source), **outcome(ran, run)}
        # Errors name files: what lies where on this machine is nobody's business.
        for place, name in ((self.sources, "DIR"), (self.out, "OUT")):
            row["outcome"] = row["outcome"].replace(str(place.resolve()), name).replace(str(place), name)
        row |= {"minutes": round(ran.minutes, 1), "cpu_minutes": round(ran.cpu_minutes, 1)}
        row["memory_gib"] = round(ran.memory_gib, 2)
        if source.truth is not None:
            row["truth_mm"] = distances(run, self.sources, source.truth, body)
        row["made"] = fingerprint(run, row["outcome"])
        if source.kind == "scan" or (run / TEMPLATE).is_file():
            write_sheet(folder / "sheet.png", run, self.sources / source.files[0], body)
        return row

    def _words(self, source: Source, folder: Path) -> list[str]:
        places = {
            "file": self.sources / source.files[0],
            "folder": self.sources,
            "out": folder,
            "run": folder / "run",
            "before": self.out / folder_name(source.after),
        }
        return [word.format(**places) for word in source.command.split()]

    def _store(self, rows: Mapping[str, Mapping[str, Any]]) -> None:
        ordered = [rows[source.key] for source in SOURCES if source.key in rows]
        store_results("real", COMMAND, {"rows": ordered, "summary": summary(ordered)}, folder=self.results)


def folder_name(key: str) -> str:
    """Return the name of a source's folder."""
    return re.sub(r"\W+", "_", key)


def described(source: Source) -> dict[str, Any]:
    """Return what a row says of its source."""
    places = {"file": Path(source.files[0]).name, "folder": "DIR", "out": "OUT", "run": "RUN", "before": "OTHER"}
    command = source.command.format(**places)
    return {
        "source": source.key,
        "kind": source.kind,
        "person": source.person,
        "origin": source.origin,
        "licence": source.licence,
        "command": f"smplxpp {command}",
        "should_stop": source.should_stop,
    }


def stored_rows(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the rows of the stored result by their sources."""
    path = folder / "real.json"
    rows = json.loads(path.read_text())["figures"]["rows"] if path.is_file() else []
    return {row["source"]: row for row in rows}


def with_assessment(row: dict[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row with the assessment by eye of an earlier one, if both speak of the same template.

    An assessment has `verdict`, `words`, `who` and `when`. It is lost with the template that it was made of, because
    nobody has looked at the new one.
    """
    same = before.get("made") == row["made"]
    return {**row, "assessment": before.get("assessment") if same else None}


def summary(rows: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Count scans, templates, templates without a failed check, and what looked right."""
    scans = [row for row in rows if row["kind"] == "scan"]
    made = [row for row in scans if "checks" in row and row["outcome"].startswith("a template")]
    verdicts = [(row["assessment"] or {}).get("verdict") for row in scans]
    return {
        "scans": len(scans),
        "templates": len(made),
        "without_a_failed_check": sum(row["checks"]["fail"] == 0 for row in made),
        "rightly_stopped": sum(row["should_stop"] and row not in made for row in scans),
        "right_by_eye": verdicts.count("right"),
        "usable_by_eye": verdicts.count("usable"),
        "wrong_by_eye": verdicts.count("wrong"),
    }


def line(row: Mapping[str, Any]) -> str:
    """Say a row in words."""
    truth = row.get("truth_mm")
    known = "" if not truth else "; known body: " + ", ".join(f"{name} {value} mm" for name, value in truth.items())
    seen = row["assessment"]
    eye = "" if seen is None else f"; by eye: {seen['verdict']}, {seen['words']}"
    return (
        f"{row['source']} ({row['command']}): {row['outcome']}{known}; {row['minutes']} min, "
        f"{row['cpu_minutes']} of CPU, {row['memory_gib']} GiB{eye}"
    )


if __name__ == "__main__":
    tyro.cli(Real, prog="python -m benchmarks real").run()
