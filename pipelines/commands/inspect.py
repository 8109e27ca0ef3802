"""`smplxpp inspect`: list a run's stages with their times, and check its numbers against their gates."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pipelines.commands.file_kinds import print_kind, shown_bytes
from pipelines.report.model import CheckRow, Step, count_statuses, worst_status
from pipelines.report.words import next_steps
from pipelines.runs.folders import read_record
from pipelines.runs.layout import (
    ALL_STAGES,
    EVALUATE_STAGE,
    FIT_STAGE,
    METRICS_FILE,
    REFINE_STAGE,
    RELIGHT_STAGE,
    TEMPLATE_GLB,
    TEMPLATE_STAGES,
    TRAIN_STAGES,
)
from pipelines.runs.stage import MANIFEST, is_finished
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_list, as_object, read_json

_STYLES = {"pass": "green", "warn": "yellow", "fail": "red"}
_STATES = {
    "done": "green",
    "missing": "yellow",
    "unfinished": "yellow",
    "outdated": "yellow",
    "incomplete": "red",
    "unreadable": "red",
}


@dataclass(frozen=True)
class Inspect:
    """Options of `smplxpp inspect`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder that `smplxpp build` wrote; or any file or folder, whose kind is named."""
    all: bool = False
    """List every check; by default those that pass are only counted."""
    strict: bool = False
    """Exit with status 1 when a check fails."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Summarise the run, or say what a file is; prints tables unless `json`."""
        path = self.run_folder
        holds_a_run = (path / METRICS_FILE).is_file() or any(path.glob("[0-9][0-9]_*/manifest.json"))
        if path.exists() and not holds_a_run:
            return print_kind(path, console=None if self.json else Console())
        summary, checks = summarise_run(self.run_folder)
        if not self.json:
            _print_summary(summary, checks, show_all=self.all)
        failed = summary["counts"]["fail"] > 0
        return {**summary, "exit_status": int(self.strict and failed)}


def summarise_run(run: Path) -> tuple[dict[str, Any], list[CheckRow]]:
    """Return the stages of a run, finished or not, as JSON values, and all of its checks.

    Raises:
        InputError: the folder holds no run.
    """
    run = Path(run)
    # Stages of the template are listed even if missing; others only where the run has them.
    others = sorted({p.parent.name for p in run.glob("[0-9][0-9]_*/manifest.json")} - set(TEMPLATE_STAGES))
    order = {name: number for number, name in enumerate(ALL_STAGES)}
    names = sorted({*TEMPLATE_STAGES, *others}, key=lambda name: (order.get(name, len(order)), name))
    # Stages in their order, because outdated ones are found from earlier to later.
    stages = [_stage(run, name) for name in names]
    _mark_outdated(stages)
    metrics = _read_json(run / "metrics.json")
    if not metrics and all(stage["state"] == "missing" for stage in stages):
        raise InputError(
            "run folder",
            expected="a folder with stages or a metrics.json",
            received=f"{run} with neither" if run.is_dir() else f"{run}, which does not exist",
            remedy="make one with `smplxpp build RUN --capture DIR`",
        )
    # Manifests are the source of checks; metrics.json serves runs without any.
    checks = [CheckRow.of(record, stage=stage["stage"]) for stage in stages for record in stage.pop("records")]
    if not checks:
        checks = _checks_of(metrics.get("checks"))
    # Suggest the command for the first stage to make; it leads to the rest.
    unfinished = [stage["stage"] for stage in stages if stage["state"] != "done"]
    report, glb = run / "report.html", run / TEMPLATE_GLB
    summary = {
        "run": str(run),
        "subject": metrics["subject"] if isinstance(metrics.get("subject"), str) else None,
        "verdict": worst_status(checks) if checks else None,
        "counts": count_statuses(checks),
        "seconds": round(sum(stage["seconds"] or 0.0 for stage in stages), 3),
        "stages": stages,
        "unfinished": unfinished,
        "remedy": _remedy(run, unfinished[0]) if unfinished else None,
        "report": str(report) if report.is_file() else None,
        "glb": str(glb) if glb.is_file() else None,
        "next": [step.__dict__ for step in _next_steps(run, checks)] if glb.is_file() and not unfinished else [],
        "checks": [check.__dict__ for check in checks],
    }
    return summary, checks


def _next_steps(run: Path, checks: list[CheckRow]) -> tuple[Step, ...]:
    """Return what a person with a finished template, and perhaps a student, is likely to do next."""
    from pipelines.stages.build_config import load_build
    from pipelines.stages.run_inputs import capture_of_build

    build = load_build(run)
    return next_steps(run, capture=None if build is None else capture_of_build(run, build[0]), checks=checks)


def _remedy(run: Path, stage: str) -> str:
    """Return the command that makes a stage."""
    if stage == FIT_STAGE:
        return f"smplxpp fit {run} --capture DIR (with the fit's options)"
    if stage in (REFINE_STAGE, *TRAIN_STAGES):
        return f"smplxpp train {run} --capture DIR (with the training's options)"
    if stage in (EVALUATE_STAGE, RELIGHT_STAGE):
        return f"smplxpp evaluate {run} --capture DIR (with the evaluation's options)"
    return f"smplxpp build {run} --from-stage {stage} (with the build's options)"


def _stage(run: Path, name: str) -> dict[str, Any]:
    folder = run / name
    manifest, problem = _manifest(folder)
    files = manifest.get("files", {})
    # Compare the manifest's files with the disk: a deleted file makes a stage incomplete.
    present = [folder / file for file in files if (folder / file).is_file()]
    if not manifest:
        state = "unreadable" if problem else "missing"
    else:
        whole = "done" if is_finished(manifest) else "unfinished"
        state = whole if len(present) == len(files) else "incomplete"
    records = manifest.get("checks", [])
    return {
        "stage": name,
        "state": state,
        "seconds": manifest.get("seconds"),
        "bytes": sum(path.stat().st_size for path in present),
        "files": len(present),
        "counts": count_statuses([CheckRow.of(record) for record in records]),
        "problem": problem,
        "records": records,
        "inputs": manifest.get("inputs", {}),
        "digests": {f"{name}/{file}": digest for file, digest in files.items()},
    }


def _manifest(folder: Path) -> tuple[dict[str, Any], str | None]:
    """Read a stage's manifest, empty without one, and the error of one that cannot be read."""
    path = folder / MANIFEST
    if not path.exists() and not path.is_symlink():
        return {}, None
    try:
        return read_record(path), None
    except InputError as error:
        return {}, str(error)


def _mark_outdated(stages: list[dict[str, Any]]) -> None:
    """Mark finished stages whose input files, or the sources of these, have been made again since."""
    digests: dict[str, str] = {}
    outdated: set[str] = set()
    for stage in stages:
        inputs, own = stage.pop("inputs"), stage.pop("digests")
        # An input is outdated if its digest differs from the file's current one, or its stage is outdated. One pass
        # suffices, since inputs come from earlier stages.
        changed = any(
            digests.get(file, digest) != digest or file.split("/")[0] in outdated for file, digest in inputs.items()
        )
        if stage["state"] == "done" and changed:
            stage["state"] = "outdated"
        if changed:
            outdated.add(stage["stage"])
        digests |= own


def _checks_of(records: Any) -> list[CheckRow]:
    """Return the checks of a metrics.json; none for a damaged one."""
    try:
        return [CheckRow.of(as_object(one, subject="check")) for one in as_list(records or [], subject="checks")]
    except InputError:
        return []


def _read_json(path: Path) -> dict[str, Any]:
    """Read the mapping in a JSON file; empty when it is missing or damaged, which a summary survives."""
    try:
        return as_object(read_json(path), subject="metrics")
    except InputError:
        return {}


def _print_summary(summary: dict[str, Any], checks: list[CheckRow], *, show_all: bool) -> None:
    console = Console()
    title = Text(str(summary["subject"] or Path(summary["run"]).name), style="bold")
    console.print(title + Text(f"  {summary['run']}", style="dim"))
    # One row for each stage with state, time and size, then the totals.
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("stage")
    table.add_column("state")
    for name in ("seconds", "size", "files"):
        table.add_column(name, justify="right")
    table.add_column("checks")
    for stage in summary["stages"]:
        done = stage["seconds"] is not None
        table.add_row(
            stage["stage"],
            Text(stage["state"], style=_STATES[stage["state"]]),
            f"{stage['seconds']:.2f}" if done else "",
            shown_bytes(stage["bytes"]) if done else "",
            str(stage["files"]) if done else "",
            _counts(stage["counts"]),
        )
    table.add_row(
        "all", "", f"{summary['seconds']:.2f}", shown_bytes(sum(s["bytes"] for s in summary["stages"])), style="bold"
    )
    console.print(table)
    for stage in summary["stages"]:
        if stage["problem"]:
            console.print(Text("unreadable ", style="red") + Text(stage["problem"]), soft_wrap=True)
    # By default only checks that need attention are listed.
    shown = [check for check in checks if show_all or check.status != "pass"]
    if shown:
        console.print()
        console.print(_check_table(shown))
    # End with the counts, the command to continue, and the report.
    verdict = Text("no checks", style="dim") if not checks else _counts(summary["counts"], zeros=True)
    console.print(Text("\nchecks  ") + verdict)
    if summary["unfinished"]:
        console.print(Text("to make ", style="yellow") + Text(", ".join(summary["unfinished"])))
        console.print(Text("make it ", style="yellow") + Text(summary["remedy"]), soft_wrap=True)
    if summary["report"]:
        console.print(Text("report  ") + Text(summary["report"]), soft_wrap=True)
    else:
        console.print(Text("report  ") + Text("none yet; a finished build writes it", style="dim"))
    if summary["glb"]:
        console.print(Text("rigged  ") + Text(summary["glb"]), soft_wrap=True)
    for step in summary["next"]:
        console.print(Text("next    ") + Text(step["command"]) + Text(f"   {step['purpose']}", "dim"), soft_wrap=True)


def _check_table(checks: list[CheckRow]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("status")
    table.add_column("stage", style="dim")
    table.add_column("check")
    table.add_column("value", justify="right")
    table.add_column("gate", style="dim")
    for check in checks:
        table.add_row(Text(check.status, style=_STYLES[check.status]), check.stage, check.name, check.shown, check.gate)
    return table


def _counts(counts: dict[str, int], *, zeros: bool = False) -> Text:
    parts = [
        Text(f"{counts[status]} {status}", style=style) for status, style in _STYLES.items() if zeros or counts[status]
    ]
    return Text("  ").join(parts)
