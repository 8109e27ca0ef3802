"""The table of a batch: a row a subject with state, cost, failed gates and figures, worst first."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from avatar.evaluation.input_protocol import NOT_KNOWN, InputProtocol
from pipelines.batch.records import JOB_FILE, RUN_FOLDER, JobRecord, read_batch, read_job
from pipelines.runs.folders import read_record
from pipelines.runs.layout import BEST_FIRST, COMPACT_STUDENT, EVALUATE_STAGE, REPORT_FILE, STUDENT
from pipelines.runs.stage import MANIFEST
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_object

PLAYER_FILE = "player.html"
STATES = ("failed", "refused", "stopped", "running", "waiting", "done")
"""States of a subject and of its steps, those that need a person first."""
PROTOCOLS = ("tracked", "mixed", NOT_KNOWN, "exact")
"""Protocols of an evaluation's inputs, the harder first: figures of two of them do not compare."""
FIGURES = {
    "poses_psnr": "novel_pose.psnr",
    "poses_perceptual": "novel_pose.perceptual",
    "poses_p2s": "surface.held_out.p2s",
    "views_psnr": "novel_view.psnr",
    "views_perceptual": "novel_view.perceptual",
    "views_p2s": "surface.training.p2s",
}
"""Fields of a `Row` and the figures of an evaluation that fill them, held-out poses before held-out views."""


@dataclass(frozen=True)
class Row:
    """A subject of a batch; what is not known yet is None or empty.

    Attributes:
        subject: name of the subject and of its folder.
        state: among `STATES`.
        step: the step that runs, failed or comes next; empty when all are done.
        done: number of finished steps.
        steps: number of all steps.
        minutes: time by the clock that the steps have taken.
        cpu_minutes: processor time of the steps.
        gpu_hours: hours of GPUs that steps have held; one that several share counts for each.
        peak_mb: largest memory of a step, MB.
        gates_failed: checks of the run's stages that failed.
        gates_warned: checks that warned.
        protocol: of the evaluation's inputs, among `PROTOCOLS`.
        model: whose figures follow, the best of `pipelines.runs.layout.BEST_FIRST` that was measured.
        poses_psnr: dB over the person in held-out poses.
        poses_perceptual: perceptual distance of whole images in held-out poses.
        poses_p2s: mean distance of the posed mesh to the true surface in held-out frames, mm.
        views_psnr: dB over the person from held-out cameras.
        views_perceptual: perceptual distance of whole images from held-out cameras.
        views_p2s: mean distance to the true surface in training frames, mm.
        metric: which perceptual distance.
        megabytes: size of that model's file, MB.
        host: machine of the step that ran last.
        report: report of the run, relative to the batch's folder.
        player: page that plays the student, likewise.
        log: output of the step that ran last, likewise.
        reason: why the subject stopped, in the words of its step.
        convention: how the figures are defined.
    """

    subject: str
    state: str
    step: str = ""
    done: int = 0
    steps: int = 0
    minutes: float = 0.0
    cpu_minutes: float = 0.0
    gpu_hours: float = 0.0
    peak_mb: float | None = None
    gates_failed: int | None = None
    gates_warned: int | None = None
    protocol: str = ""
    model: str = ""
    poses_psnr: float | None = None
    poses_perceptual: float | None = None
    poses_p2s: float | None = None
    views_psnr: float | None = None
    views_perceptual: float | None = None
    views_p2s: float | None = None
    metric: str = ""
    megabytes: float | None = None
    host: str = ""
    report: str = ""
    player: str = ""
    log: str = ""
    reason: str = ""
    convention: str = ""


class BatchTable:
    """The rows of a batch's folder, which read a subject again only when its record or its run has changed.

    A thousand subjects have ten thousand manifests; a table that is written every few seconds cannot read all of them.

    Args:
        runs: folder of the batch, a folder a subject in it.
    """

    def __init__(self, runs: str | Path) -> None:
        self.runs = Path(runs)
        self._known: dict[str, tuple[tuple[int, ...], Row]] = {}

    def rows(self) -> list[Row]:
        """Return a row a subject, worst first.

        Raises:
            InputError: the folder holds no batch.
        """
        found = {}
        for job in read_batch(self.runs).jobs:
            subject = job["subject"]
            stamp, kept = _stamp(self.runs / subject), self._known.get(subject)
            steps = len(job.get("steps", ()))
            found[subject] = kept if kept and kept[0] == stamp else (stamp, read_row(self.runs, subject, steps=steps))
        self._known = found
        return worst_first(row for _, row in found.values())


def _stamp(folder: Path) -> tuple[int, ...]:
    """Return times of change, ns, of a subject's record and of the files of its run that a row shows."""
    run = folder / RUN_FOLDER
    out = []
    for path in (folder / JOB_FILE, run, run / EVALUATE_STAGE / MANIFEST, run / REPORT_FILE, folder / PLAYER_FILE):
        try:
            out.append(path.stat().st_mtime_ns)
        except OSError:  # not there yet, or replaced at this moment
            out.append(0)
    return tuple(out)


def read_row(runs: Path, subject: str, *, steps: int = 0) -> Row:
    """Read a subject's record and the manifests of its run.

    A record that cannot be read is a failed row whose reason says so, because one damaged file must not hide the table.

    Args:
        runs: folder of the batch.
        subject: name of the subject.
        steps: number of its steps, for one that has not begun.
    """
    try:
        record = read_job(runs, subject)
    except InputError as error:
        return Row(subject, "failed", steps=steps, reason=f"its record cannot be read: {error}")
    if record is None:
        return Row(subject, "waiting", steps=steps)
    return Row(subject, record.state, **_of_record(record), **_of_run(runs / subject))


def _of_record(record: JobRecord) -> dict[str, Any]:
    """Return step, cost, place and reason of a subject's record."""
    steps, states = record.steps, [step.state for step in record.steps]
    # The step that a reader asks about is the first that is not done; the last that ran has host and log.
    at = next((step for step in steps if step.state != "done"), None)
    last = next((step for step in reversed(steps) if step.attempts), None)
    return {
        "step": "" if at is None else at.step,
        "done": states.count("done"),
        "steps": len(steps),
        "minutes": sum(step.seconds for step in steps) / 60.0,
        "cpu_minutes": sum(step.cpu_seconds for step in steps) / 60.0,
        "gpu_hours": sum(len(list(filter(None, step.gpu.split(",")))) * step.seconds for step in steps) / 3600.0,
        "peak_mb": max((step.peak_mb for step in steps), default=0.0) or None,
        "host": "" if last is None else last.host,
        "log": f"{record.subject}/{last.log}" if last is not None and last.log else "",
        "reason": "" if record.state in ("done", "running") else _reason(record),
    }


def _reason(record: JobRecord) -> str:
    """Return in a line why a subject stopped: expected, received and remedy of its step's error, or its status."""
    stopped = [one for one in record.steps if one.state in ("failed", "refused", "stopped")]
    # A full disk or other code leaves a step waiting, with the reason.
    step = next(
        (one for one in [*stopped, *record.steps] if one in stopped or (one.state == "waiting" and one.error)), None
    )
    if step is None:
        return "" if record.state == "waiting" else record.note
    error = step.error or {}
    parts = [f"{name} {error[name]}" for name in ("expected", "received") if error.get(name)]
    if not parts:
        status = "" if step.exit_status is None else f"ended with status {step.exit_status}"
        return str(error.get("message") or ("stopped by a person" if step.state == "stopped" else status))
    words = (f"{error['subject']}: " if error.get("subject") else "") + ", ".join(parts)
    remedy = str(error.get("remedy") or "")
    return f"{words}. {remedy[0].upper()}{remedy[1:]}" if remedy else words


def _of_run(folder: Path) -> dict[str, Any]:
    """Return gates, figures and links of a subject's run, as far as it has them."""
    run = folder / RUN_FOLDER
    out: dict[str, Any] = {}
    statuses: list[str] = []
    figures: dict[str, Any] = {}
    for path in sorted(run.glob(f"[0-9][0-9]_*/{MANIFEST}")):
        try:
            manifest = read_record(path)
        except InputError:  # being written, or damaged: `inspect` says which
            continue
        statuses += [check["status"] for check in manifest["checks"]]
        if path.parent.name == EVALUATE_STAGE:
            figures = _figures(manifest["numbers"])
    if statuses:
        out = {"gates_failed": statuses.count("fail"), "gates_warned": statuses.count("warn")}
    # Without an evaluation the size is that of the student's own file.
    if figures.get("megabytes") is None:
        file = next((run / name for name in (STUDENT, COMPACT_STUDENT) if (run / name).is_file()), None)
        figures["megabytes"] = None if file is None else file.stat().st_size / 1e6
    # A subject that a check stopped has the page of that check.
    pages = {"report": (f"{RUN_FOLDER}/{REPORT_FILE}", f"check/{REPORT_FILE}"), "player": (PLAYER_FILE,)}
    for name, places in pages.items():
        there = next((place for place in places if (folder / place).is_file()), None)
        out |= {} if there is None else {name: f"{folder.name}/{there}"}
    return out | figures


def _figures(numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of the best model of an evaluation, with protocol and convention; empty for damaged ones."""
    models = numbers.get("models")
    best = next((name for name in BEST_FIRST if isinstance(models, Mapping) and name in models), None)
    if best is None or not isinstance(models, Mapping) or not isinstance(models[best], Mapping):
        return {}
    try:
        inputs = InputProtocol.from_dict(as_object(numbers.get("inputs"), subject="inputs"))
    except InputError:
        inputs = InputProtocol()
    conventions = numbers.get("conventions")
    words = [str(conventions.get(key, "")) for key in ("images", "surface")] if isinstance(conventions, Mapping) else []
    return {
        "protocol": inputs.name,
        "model": best,
        "metric": str(numbers.get("metric") or ""),
        "megabytes": _number(models[best].get("megabytes")),
        "convention": " ".join(filter(None, words)),
        **{field: _number(models[best].get(figure)) for field, figure in FIGURES.items()},
    }


def _number(value: Any) -> float | None:
    """Return a finite number, None for anything else."""
    fine = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if fine else None


def worst_first(rows: Iterable[Row]) -> list[Row]:
    """Return rows in the order of their need: by state, then failed gates, then the figures in held-out poses."""

    def need(row: Row) -> tuple[Any, ...]:
        quality = row.poses_psnr if row.poses_psnr is not None else row.views_psnr
        return (
            STATES.index(row.state),
            -(row.gates_failed or 0),
            PROTOCOLS.index(row.protocol) if row.protocol in PROTOCOLS else len(PROTOCOLS),
            math.inf if quality is None else quality,
            row.subject,
        )

    return sorted(rows, key=need)


def count_states(rows: Iterable[Row]) -> dict[str, int]:
    """Count the rows in each state."""
    states = [row.state for row in rows]
    return {state: states.count(state) for state in STATES}


def csv_text(rows: Iterable[Row]) -> str:
    """Return the table as CSV, a row a subject and a column a field of `Row`; unknown values are empty."""
    text = io.StringIO()
    names = [field.name for field in fields(Row)]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values = (getattr(row, name) for name in names)
        writer.writerow([f"{value:.6g}" if isinstance(value, float) else _plain(value) for value in values])
    return text.getvalue()


def _plain(value: Any) -> Any:
    """Return a cell that no spreadsheet takes for a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "@", "\t", "\r") else value
