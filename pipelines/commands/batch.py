"""`smplxpp batch`: a chain of commands for each of many subjects; its status, its stop, and another attempt."""

from __future__ import annotations

import contextlib
import io
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from pipelines.batch.clusters import RayExecutor, SlurmExecutor, cancel_queued
from pipelines.batch.driver import Progress as State
from pipelines.batch.driver import begin_batch, drive, retry, take_batch
from pipelines.batch.executors import Executor, LocalExecutor, gpus_here
from pipelines.batch.hold import BATCH_HOLD, at_work, request_stop
from pipelines.batch.jobs import Job, JobFile, option_words, read_jobs
from pipelines.batch.page import INDEX_FILE, STATE_STYLES, IndexWriter, cost_table, terminal_table
from pipelines.batch.plan import Cost, breaks_first, demands, learned, plan_jobs, spent_in
from pipelines.batch.rates import Site, read_rates
from pipelines.batch.records import BATCH_FILE, Batch, read_batch
from pipelines.batch.run_job import Resources
from pipelines.batch.steps import STEPS
from pipelines.batch.table import Row, count_states
from pipelines.commands.help import checked_arguments
from pipelines.commands.options import OptionalInt, OptionalPath, OptionalText
from pipelines.commands.terminal import print_paths
from smplxpp.core.errors import InputError, require_between


@dataclass(frozen=True)
class Machines:
    """Where the commands run."""

    local: OptionalInt = None
    """Run this many subjects at a time on this machine, which share its cores and GPUs out; the default, with one
    subject a GPU, or one for four cores."""
    ray: OptionalText = None
    """Run on the Ray cluster at this address, or `auto` (extra cluster)."""
    slurm: bool = False
    """Run as job arrays of Slurm, by submitit (extra cluster)."""
    partition: str = ""
    """With --slurm: the partition; by default Slurm's."""
    minutes: float = 1440.0
    """With --slurm: limit of a stay on a machine, for jobs that name none; a training stops before it and continues."""
    max_retries: int = 2
    """Further attempts of a command that the system ended: killed, out of memory, its machine lost. What a command
    refuses, and checks that fail, are final until `batch retry`."""
    scratch: OptionalPath = None
    """Folder on a local disk for captures that are copied from addresses; by default that of temporary files."""

    def executor(self, file: JobFile, batch: Batch) -> Executor:
        """Return what runs the tasks.

        Raises:
            InputError: two places at once, or a cluster that does not answer.
        """
        if (self.local is not None) + (self.ray is not None) + self.slurm > 1:
            raise InputError("options local, ray and slurm", expected="one of them", received="several")
        require_between("option max-retries", self.max_retries, 0, 100)
        resources = Resources(
            max_retries=self.max_retries,
            code_key=batch.code_key,
            scratch="" if self.scratch is None else str(self.scratch.absolute()),
            results=file.results,
            folder=str(file.folder),
        )
        if self.ray is not None:
            return RayExecutor(file.out, resources, address=self.ray)
        if self.slurm:
            return SlurmExecutor(file.out, resources, partition=self.partition, minutes=self.minutes)
        cores, gpus = (
            len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
            gpus_here(),
        )
        workers = self.local or len(gpus) or max(1, cores // 4)
        require_between("option local", workers, 1, 4096)
        return LocalExecutor(file.out, resources, workers=workers, gpus=gpus, cores=cores)


@dataclass(frozen=True)
class RunBatch:
    """Options of `smplxpp batch`. The same command continues with a batch that was interrupted."""

    jobs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="JOBS.yaml")]
    """File with the subjects, their captures, and what to do with each (docs/batch.md)."""
    machines: Annotated[Machines, tyro.conf.arg(name="")] = field(default_factory=Machines)
    """Where the commands run."""
    upgrade: bool = False
    """Go on with another version of smplxpp than the batch began with: what its code affects is made again, and
    unfinished trainings begin again."""
    dry_run: bool = False
    """Check the job file and print the commands, with hours, gigabytes and what the site lacks; run nothing."""
    rates: OptionalPath = None
    """With --dry-run: JSON with rates of this site, and its cores, GPUs and disk under `site` (docs/batch.md)."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict[str, Any]:
        """Run the batch; exit status 1 if a subject failed, 2 if the batch was halted."""
        file = read_jobs(self.jobs)
        check_options(file.jobs)
        if self.dry_run:
            return self._plan(file)
        with take_batch(file.out) as held:
            batch, jobs = begin_batch(file, self.jobs.absolute(), upgrade=self.upgrade)
            executor = self.machines.executor(file, batch)
            begin, index = time.perf_counter(), IndexWriter(file.out)
            with shown(index, enabled=not self.json) as report:
                state = drive(
                    file.out,
                    jobs,
                    executor,
                    total=len(file.jobs),
                    retries=self.machines.max_retries,
                    report=report,
                    held=held,
                )
            rows = index.write()
        summary = summarise(file.out, rows)
        if not self.json:
            print_status(summary, rows, Console(), every=False)
        halted = {"halted": state.halted, "seconds": round(time.perf_counter() - begin, 3)}
        failed = bool(summary["states"].get("failed", 0) + summary["states"].get("refused", 0))
        return {**summary, **halted, "exit_status": 2 if state.halted else int(failed)}

    def _plan(self, file: JobFile) -> dict[str, Any]:
        """Print what would run."""
        commands = {
            job.subject: [" ".join(job.command(step, file.out / job.subject, job.capture)) for step in job.steps]
            for job in file.jobs
        }
        if not self.json:
            console = Console()
            for subject, lines in commands.items():
                console.print(Text(subject, style="bold"))
                for line in lines:
                    console.print(f"  smplxpp {line}", soft_wrap=True, highlight=False, markup=False)
        rates, site = read_rates(self.rates)
        # What this batch has finished tells how its machines and people differ from those of the rates.
        if (file.out / BATCH_FILE).exists():
            rates = learned(rates, spent_in(file.out, rates))
        costs, unknown = plan_jobs(file.jobs, rates, site, runs=file.out)
        if not self.json and costs:
            print_plan(costs, site, unknown, Console())
        plan = {step: vars(cost) for step, cost in costs.items()}
        return {"runs": str(file.out), "commands": commands, "plan": plan, "unknown": unknown}


@dataclass(frozen=True)
class BatchStatus:
    """Options of `smplxpp batch status`."""

    runs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUNS")]
    """Folder of the batch, `out` of its job file."""
    all: bool = False
    """List every subject; by default those that are done or wait are only counted."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict[str, Any]:
        """Summarise the records, and write the page and the table again."""
        rows = IndexWriter(self.runs).write()
        summary = summarise(self.runs, rows)
        if not self.json:
            print_status(summary, rows, Console(), every=self.all)
        return summary


@dataclass(frozen=True)
class BatchStop:
    """Options of `smplxpp batch stop`."""

    runs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUNS")]
    """Folder of the batch."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict[str, Any]:
        """Ask all that work on the batch to end their commands, which they do within seconds."""
        batch = read_batch(self.runs)
        request_stop(self.runs)
        cancel_queued(self.runs)
        if not self.json:
            Console().print(
                f"asked to stop; `smplxpp batch {batch.job_file}` continues", soft_wrap=True, highlight=False
            )
        return {"runs": str(self.runs), "driver": at_work(self.runs / BATCH_HOLD)}


@dataclass(frozen=True)
class BatchRetry:
    """Options of `smplxpp batch retry`."""

    runs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUNS")]
    """Folder of the batch."""
    failed: bool = False
    """Run again all that failed or was refused."""
    subjects: tuple[str, ...] = ()
    """Run only these of them again."""
    machines: Annotated[Machines, tyro.conf.arg(name="")] = field(default_factory=Machines)
    """Where the commands run."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict[str, Any]:
        """Put the failures back, and go on with the batch.

        Raises:
            InputError: nothing named, or another process drives the batch.
        """
        if not self.failed and not self.subjects:
            raise InputError("batch retry", expected="--failed, or --subjects NAME ...", received="neither")
        with take_batch(self.runs):
            retried = retry(self.runs, self.subjects)
            path = Path(read_batch(self.runs).job_file)
        return {**RunBatch(path, self.machines, json=self.json).run(), "retried": retried}


def check_options(jobs: tuple[Job, ...]) -> None:
    """Parse the options of every job as their commands will, before anything runs.

    Raises:
        InputError: an option that a command does not have, or a value that it does not take.
    """
    for job in jobs:
        for step in job.steps:
            try:
                own = ("truth", "run")  # the runner writes them in their places
                given = {name: value for name, value in job.options.get(step, {}).items() if name not in own}
                _parsed(step, tuple(option_words(given, subject="subject")))
            except InputError as error:
                raise InputError(
                    f"{job.subject}: {step}: {error.subject}",
                    expected=error.expected,
                    received=error.received,
                    remedy=error.remedy,
                ) from None


@cache
def _parsed(step: str, words: tuple[str, ...]) -> None:
    """Parse options once for all jobs that have the same."""
    kind = STEPS[step]
    name, options = " ".join(kind.words), getattr(import_module(kind.module), kind.options)
    checked = checked_arguments(name, options, words)
    # What the runner adds itself; an option of the job that says it again is the user's.
    of_capture = ["--capture", "capture"]
    more = dict.fromkeys(("refine", "train", "evaluate", "reconstruct"), of_capture)
    places = {**more, "convert": ["--out", "out"], "metrics": ["truth"]}.get(step, [])
    places = [] if places and places[0] in checked else places
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(printed):
            tyro.cli(options, args=["place", *places, *checked], config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit:
        lines = [line.strip(" │╭╰─╮╯") for line in printed.getvalue().splitlines()]
        raise InputError(
            "options",
            expected=f"values that `smplxpp {name}` takes",
            received=" ".join(filter(None, lines))[:300] or " ".join(words),
            remedy=f"`smplxpp {name} --help` lists them",
        ) from None


def summarise(runs: Path, rows: Sequence[Row]) -> dict[str, Any]:
    """Return what has become of a batch as JSON values, the worst subject first."""
    batch = read_batch(runs)
    return {
        "runs": str(runs),
        "name": batch.name,
        "started": batch.started,
        "driver": at_work(runs / BATCH_HOLD),
        "states": {state: count for state, count in count_states(rows).items() if count},
        "subjects": [{name: value for name, value in vars(row).items() if name != "convention"} for row in rows],
        "index": str(runs / INDEX_FILE),
    }


def print_status(summary: Mapping[str, Any], rows: Sequence[Row], console: Console, *, every: bool) -> None:
    """Print the counts, and a line for each subject that failed, stopped, runs, or is done with failed gates."""
    counts = Text("  ").join(
        Text(f"{count} {state}", STATE_STYLES[state]) for state, count in summary["states"].items()
    )
    console.print(Text(f"{summary['name']}  ", style="bold") + counts)
    shown = [row for row in rows if every or row.gates_failed or row.state not in ("done", "waiting")]
    if shown:
        console.print(terminal_table(shown, most=len(shown) if every else 40))
    print_paths({"table": Path(summary["index"])}, console)


def print_plan(costs: Mapping[str, Cost], site: Site, unknown: Sequence[str], console: Console) -> None:
    """Print what the steps cost over all subjects, how long the site is busy, and what it lacks."""
    console.print(cost_table(costs, "all subjects"))
    hours = ", ".join(f"{name} {hours:,.1f} h" for name, hours in demands(costs.values(), site).items() if hours)
    console.print(f"busy on {site.cores} cores and {site.gpus} GPUs: {hours}", highlight=False, soft_wrap=True)
    console.print(f"breaks first: {breaks_first(costs, site)}", highlight=False, soft_wrap=True)
    if unknown:
        words = f"{len(unknown)} captures cannot be looked at from here and count as the mean of the others"
        console.print(words, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def shown(index: IndexWriter, *, enabled: bool) -> Any:
    """Show a bar with the subjects by state and those at work, and keep the page up to date."""
    columns = (TextColumn("subjects"), BarColumn(bar_width=20), MofNCompleteColumn(), TimeElapsedColumn())
    words = TextColumn("{task.fields[words]}", markup=False)
    with Progress(*columns, words, console=Console(stderr=True), disable=not enabled) as bar:
        task = bar.add_task("", total=None, words="")

        def report(state: State) -> None:
            ended = sum(state.states[name] for name in ("done", "failed", "refused", "stopped"))
            failed = state.states["failed"] + state.states["refused"]
            at_work = ", ".join(list(state.running)[:4]) + (", ..." if len(state.running) > 4 else "")
            now = state.halted or at_work
            words = f"{failed} failed; {now}" if failed else now
            bar.update(task, total=state.total, completed=ended, words=words)
            index.update()

        yield report
