"""`smplxpp batch frames`: one long take in chunks of frames, each a job of its own, and the step that joins them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from pipelines.batch.driver import begin_batch, drive, retry, take_batch
from pipelines.batch.frames import (
    OVERLAP,
    frames_option,
    join_metrics,
    join_reconstructions,
    join_registrations,
    shape_frames,
)
from pipelines.batch.jobs import Job, JobFile, Needs
from pipelines.batch.page import IndexWriter
from pipelines.batch.records import BATCH_FILE
from pipelines.commands.batch import Machines, check_options, shown
from pipelines.commands.metrics import frame_number, over_frames, pair_frames
from pipelines.commands.options import OptionalPath, OptionalText, frame_numbers, selected_frames
from pipelines.commands.terminal import print_checks, print_paths
from pipelines.runs.folders import read_record
from pipelines.runs.layout import REFINE_STAGE, REGISTERED_PARAMS
from pipelines.runs.stage import MANIFEST
from smplxpp.body import load_body
from smplxpp.capture import open_capture
from smplxpp.capture.recording import TURNTABLE
from smplxpp.core import Check, InputError, require_at_least
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_object, jsonable, read_json
from smplxpp.core.files.paths import absolute
from smplxpp.core.spread import Chunk, split_frames
from smplxpp.register import RegisterConfig


@dataclass(frozen=True)
class BatchFrames:
    """Options of `smplxpp batch frames`. The same command continues one that was interrupted."""

    step: Annotated[Literal["reconstruct", "register", "metrics", "refine"], tyro.conf.Positional]
    """Command that computes a chunk. All frames of a registration share the shape of frames all over the take; the
    processes of a refinement of poses share each of its passes."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder of the chunks, and of what they are joined to: params.npz of a registration, scans/ of a reconstruction,
    metrics.json; seams.json says how far the chunks fit together."""
    capture: Path
    """Folder of the capture; for metrics the folder of the frames that are measured."""
    truth: OptionalPath = None
    """For metrics: folder of the true frames."""
    into: OptionalPath = None
    """For refine: RUN, whose template and capture they are; the result is its stage 66_refine."""
    frames: OptionalText = None
    """Frames: numbers and ranges START:STOP:STEP with commas; by default all that the split names."""
    size: int = 200
    """Most frames of a chunk. Below 100 the overlap of a registration costs more than a fifth."""
    also: tuple[str, ...] = ()
    """Further options of the command: masks=DIR initial=none, NAME alone for a flag, again for a list."""
    machines: Annotated[Machines, tyro.conf.arg(name="")] = field(default_factory=Machines)
    """Where the chunks run."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict[str, Any]:
        """Run the chunks that do not stand, join them, check the seams; exit status 1 if one failed.

        Raises:
            InputError: options that the command does not have, no frames, a person who turns before one camera.
        """
        require_at_least("option size", self.size, 1)
        given, out = options_of(self.also), absolute(self.out)
        if self.step == "refine":
            return self._refine(given, out)
        frames, told = self._frames(given)
        chunks = split_frames(frames, self.size, overlap=OVERLAP if self.step == "register" else 0)
        # A chunk alone would fit a shape of its own, and the body would change at every border.
        if self.step == "register" and "shape" not in given:
            first = self._job(f"shape_of_{len(told)}", self._options(given, told))
            self._drive(out / "shape", [first])
            given = {**given, "shape": str(out / "shape" / first.subject / "run" / REGISTERED_PARAMS)}
        jobs = [self._job(f"{self.step}_{chunk.name}", self._options(given, chunk.frames)) for chunk in chunks]
        self._drive(out / "chunks", jobs)
        folders = [out / "chunks" / job.subject for job in jobs]
        checks = self._join(chunks, folders, out)
        return self._answer(out, len(chunks), len(frames), [check.as_dict() for check in checks])

    def _refine(self, given: dict[str, Any], out: Path) -> dict[str, Any]:
        """Run as many processes as there are chunks, which share the passes, and one that ends the stage of RUN."""
        if self.into is None or self.frames is not None:
            raise InputError(
                "batch frames refine",
                expected="--into RUN, the folder with the template, and no --frames: its training frames are refined",
                received="no --into" if self.into is None else "--frames",
            )
        run = absolute(self.into)
        given = {**given, "run": str(run), "refine_frames": self.size, "no_report": True}
        splits = open_capture(self.capture, protocol=given.get("protocol")).splits
        count = -(-len(splits.train_frames) // self.size)
        if count > 1:
            self._drive(
                out / "chunks", [self._job(f"refine_{k:04d}", {**given, "refine_help": True}) for k in range(count)]
            )
        self._drive(out / "end", [self._job("refine", given)])
        record = read_record(run / REFINE_STAGE / MANIFEST)
        frames = len(record["numbers"]["training"]["frames"])
        return self._answer(run / REFINE_STAGE, count, frames, record["checks"])

    def _job(self, name: str, options: dict[str, Any]) -> Job:
        """Return a job of one command."""
        needs = Needs(cores=1, gpus=0.0)
        return Job(name, self._place, (self.step,), {self.step: options}, needs=needs, accept=(self.step,))

    def _answer(self, out: Path, chunks: int, frames: int, checks: list[dict[str, Any]]) -> dict[str, Any]:
        """Print the checks, and return the summary."""
        if not self.json:
            print_checks(checks, Console())
            print_paths({"joined": out}, Console())
        worst = any(check["status"] == "fail" for check in checks)
        found = {"out": str(out), "chunks": chunks, "frames": frames}
        return {**found, "checks": checks, "exit_status": int(worst)}

    @property
    def _place(self) -> str:
        return str(absolute(self.capture))

    def _frames(self, given: Mapping[str, Any]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the frames to compute, and those of them that tell the shape."""
        if self.step == "metrics":
            if self.truth is None:
                raise InputError("option truth", expected="the folder of the true frames", received="none")
            pairs, _ = pair_frames(self.capture, self.truth)
            numbers = {int(number) for pair in pairs if (number := frame_number(pair[1])).isdigit()}
            wanted = frame_numbers(self.frames)
            return tuple(sorted(numbers if wanted is None else numbers & set(wanted))), ()
        capture = open_capture(self.capture, protocol=given.get("protocol"))
        if capture.kind == TURNTABLE:
            raise InputError(
                "capture",
                expected="cameras that see a motion",
                received="a person who turns, whose frames share a pose",
            )
        train, held_out = capture.splits.train_frames, capture.splits.novel_pose_frames
        by_split = train if self.step == "reconstruct" else (*train, *held_out)
        frames = selected_frames(self.frames, capture) or tuple(sorted(by_split))
        # Held-out frames may not decide the shape that all frames get.
        told = shape_frames([f for f in frames if f not in held_out], RegisterConfig().shape_frames)
        return frames, told

    def _options(self, given: Mapping[str, Any], frames: Sequence[int]) -> dict[str, Any]:
        """Return the options of a chunk's command."""
        named = {"frame" if self.step == "reconstruct" else "frames": frames_option(frames)}
        named |= {} if self.truth is None else {"truth": str(absolute(self.truth))}
        return {**given, **named, **({} if self.step == "metrics" else {"no_report": True})}

    def _drive(self, runs: Path, jobs: list[Job]) -> None:
        """Run the jobs that do not stand, as `smplxpp batch` does.

        Raises:
            InputError: one that did not come to its end.
        """
        check_options(tuple(jobs))
        file = JobFile(self.step, runs, Path.cwd(), "", tuple(jobs))
        with take_batch(runs) as held:
            if (runs / BATCH_FILE).exists():
                retry(runs)
            batch, left = begin_batch(file, runs, upgrade=True)
            executor, index = self.machines.executor(file, batch), IndexWriter(runs)
            with shown(index, enabled=not self.json) as report:
                drive(runs, left, executor, total=len(jobs), report=report, held=held)
            failed = [row for row in index.write() if row.state != "done"]
        if failed:
            raise InputError(
                f"chunk {failed[0].subject}",
                expected="all chunks done",
                received=f"{len(failed)} that are not; {failed[0].reason or failed[0].state}",
                remedy="give the same command again, which runs what does not stand",
            )

    def _join(self, chunks: tuple[Chunk, ...], folders: list[Path], out: Path) -> list[Check]:
        """Join what the chunks made, and return the checks of the seams."""
        runs = [folder / "run" for folder in folders]
        if self.step == "reconstruct":
            return join_reconstructions(chunks, runs, out / "scans")
        if self.step == "register":
            given = options_of(self.also).get("body")
            return join_registrations(chunks, runs, out, body=load_body(None if given is None else Path(given)))
        answers = [as_object(read_json(folder / "metrics.json"), subject=f"metrics {folder}") for folder in folders]
        joined = join_metrics(answers, over_frames)
        atomic_write_text(out / "metrics.json", json.dumps(jsonable(joined), indent=1) + "\n")
        return []


def options_of(words: Sequence[str]) -> dict[str, Any]:
    """Return options by their names, as a job file has them.

    Raises:
        InputError: a value without a name.

    Example:
        >>> options_of(["masks=mattes", "hold_out=A", "hold_out=B", "hull_only"])
        {'masks': 'mattes', 'hold_out': ['A', 'B'], 'hull_only': True}
    """
    out: dict[str, Any] = {}
    for word in words:
        name, sign, value = word.partition("=")
        if not name or name.startswith("-"):
            raise InputError("option also", expected="NAME=VALUE, or NAME alone for a flag", received=word)
        name = name.replace("-", "_")
        before = out.get(name)
        if before is None:
            out[name] = value if sign else True
        else:
            out[name] = [*(before if isinstance(before, list) else [before]), value]
    return out
