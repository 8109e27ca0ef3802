"""`smplxpp demo`: the embedded person, from scan and photographs to a template, a student, a report, films, pages."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from runpy import run_module
from threading import Event
from time import perf_counter, sleep
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

import pipelines
from pipelines.batch.process import meaning_of, own_program, run_process
from pipelines.commands.animate import Animate
from pipelines.commands.build import Build
from pipelines.commands.options import OptionalPath, require_avatar
from pipelines.commands.talk import Talk
from pipelines.commands.templates import BUNDLE_SUFFIX, export_bundle
from pipelines.commands.train import Train
from pipelines.commands.web import Web
from pipelines.report.sections.build import rewrite_report
from pipelines.runs.layout import REFINED_PARAMS, TALKING_FILM
from smplxpp.capture.protocols import TRACKED
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files import atomic_write_bytes, read_bytes

if TYPE_CHECKING:
    from avatar.driving import Heard

_LOG = logging.getLogger(__name__)
# Below what the small scan has, so that simplification has something to do.
BUDGETS = {"upper": 8_000, "lower": 8_000}
NAME, LICENCE = "The embedded person", "CC0-1.0"
# Two processes share the chunks of the refinement, which have few frames, so that both end at about the same time. A
# pixel is 6 mm of her, and half of the usual Gaussians find poses of the same error: 2.1 mm of the body's surface.
POSES: dict[str, Any] = {"refine_frames": 2, "refine_gaussians": 15_000}
# The student is shown alone. It takes the tracked surface from its teacher, whose own networks need no more steps than
# these, and three quarters of the preset's steps of its own: two seeds lose nothing on held-out views and poses.
STEPS: dict[str, Any] = {"teacher_iterations": 20, "bake_iterations": 200, "compensate_iterations": 250}
SPEECH = (
    "Hello! I was made from one scan and a few photographs. My voice, my mouth and my hands come from this text: "
    "type one of your own!"
)
# The wheel holds a copy of the person beside the package; a checkout holds the original.
_IN_WHEEL = Path("pipelines", "person")
_IN_CHECKOUT = Path("data", "fixtures", "person")


def embedded_capture() -> Path:
    """Return the folder of the embedded person: of the checkout, or the copy that the wheel installs.

    Raises:
        InputError: neither is there.
    """
    root = Path(pipelines.__file__).resolve().parents[1]
    for folder in (root / _IN_CHECKOUT, root / _IN_WHEEL):
        if (folder / "cameras.json").is_file():
            return folder
    raise InputError(
        "the embedded person",
        expected=f"its capture in {root / _IN_CHECKOUT} or {root / _IN_WHEEL}",
        received="neither folder",
        remedy="install the wheel again, or give a capture of your own with --capture",
    )


class Helper:
    """A command in a process of its own, with half of the cores, which has imported everything before it begins.

    Imports, torch's among them, take seconds; a process that is started early takes them from a core that idles.

    Args:
        words: the command.
        capture: its capture.
        stages: modules of the stages that it makes.
        log: file that takes the log where it fails.
    """

    def __init__(self, words: Sequence[str], capture: Path, stages: Sequence[str], log: Path) -> None:
        self._stop, self._log, self._files = Event(), log, tempfile.TemporaryDirectory()
        self._begin = Path(self._files.name, "begin")
        words = (str(self._begin), ",".join(stages), *words, "--capture", str(capture.resolve()), "--json")
        self._thread = ThreadPoolExecutor(1)
        self._ended = self._thread.submit(self._run, words)

    def begin(self) -> None:
        """Let the command begin; a second call does nothing."""
        self._begin.touch()

    def failure(self) -> str | None:
        """Wait for the end; return what was wrong, None where the command has done its work or was stopped."""
        failed, log = self._ended.result()
        if failed is not None:
            atomic_write_bytes(self._log, log)
        return failed

    def close(self) -> None:
        """Stop the process, whatever it does, and remove its files."""
        self._stop.set()
        self._thread.shutdown()
        self._files.cleanup()

    def _run(self, words: tuple[str, ...]) -> tuple[str | None, bytes]:
        """Run the process to its end; return what was wrong, and the log."""
        log, answer = (Path(self._files.name, name) for name in ("log", "answer.json"))
        program, variables = own_program(__name__)
        half = str(max(1, (os.cpu_count() or 1) // 2))
        ended = run_process(
            (*program, *words),
            log=log,
            answer=answer,
            environment={**variables, "OMP_NUM_THREADS": half},
            folder=log.parent,
            stop=self._stop.is_set,
            began=lambda pid: None,
        )
        meaning, error = meaning_of(ended, log=log, answer=answer, judged=False)
        if meaning in ("done", "stopped"):
            return None, b""
        wrong = str((error or {}).get("message") or f"exit status {ended.exit_status}")
        return wrong.rstrip("."), read_bytes(log)


def evaluation_beside(run: Path, capture: Path) -> Helper:
    """Start the process that will evaluate a run, on fewer points, pictures and training frames than usual."""
    words = ["evaluate", str(run.resolve()), "--no-report"]
    words += ["--samples", "30000", "--speed-pictures", "8", "--training-every", "8"]
    return Helper(words, capture, ("pipelines.stages.evaluate", "pipelines.stages.relight"), run / "evaluate.log")


def poses_beside(run: Path, capture: Path) -> Helper:
    """Start the process that will compute chunks of the refinement, until none is left.

    Two processes of one thread take half the time of one with two threads, which wait for each other's Python.
    """
    words = ["train", str(run.resolve()), "--stage", "refine", "--refine-help"]
    for name, value in POSES.items():
        words += [f"--{name.replace('_', '-')}", str(value)]
    return Helper(words, capture, ("pipelines.stages.refine", "pipelines.stages.train"), run / "refine_help.log")


def begin_when_told(begin: Path, stages: Sequence[str], words: Sequence[str]) -> None:
    """Import what a command needs, and run it as `smplxpp` when a file is there; a parent that has ended ends it."""
    from pipelines.runs.code import code_of

    parent = os.getppid()
    for stage in stages:
        import_module(stage)
    code_of(*stages)
    while not begin.exists():
        if os.getppid() != parent:
            return
        sleep(0.02)
    sys.argv = ["smplxpp", *words]
    run_module("pipelines.cli", run_name="__main__")


def say() -> Heard:
    """Return what the student will say, as sound and phonemes."""
    from avatar.driving import hear

    return hear(text=SPEECH)


@dataclass(frozen=True)
class Demo:
    """Options of `smplxpp demo`.

    The body is registered to what a tracker and a detector saw of the embedded person, the template is built, the
    poses are refined on the photographs, teacher and student are trained and measured, and the student is shown in a
    film, a page and a speech.

    Nothing exact goes in: its protocol is `tracked`. The truth is read for measuring alone.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = Path("runs/demo")
    """Folder of the run."""
    capture: OptionalPath = None
    """Capture to build; by default the embedded person."""

    def run(self) -> dict[str, int]:
        """Build, train, evaluate, animate, write the pages and print where they are; failed gates give a status of 1.

        Raises:
            InputError: the embedded person is not there and no capture is given.
        """
        require_avatar("training the student of the demo")
        console = Console(stderr=True)
        out, capture = self.run_folder, self.capture or embedded_capture()
        started = perf_counter()
        # The template is made on one core. Meanwhile the other one imports what two more processes need, and loads the
        # voice.
        with (
            closing(poses_beside(out, capture)) as poses,
            closing(evaluation_beside(out, capture)) as evaluation,
            ThreadPoolExecutor(1) as voice,
        ):
            heard = voice.submit(say)
            # Poses need the template, not its validation nor its report: another process begins with them meanwhile.
            # Photographs with pixels of 6 mm show no more than these texels.
            built = Build(run_folder=out, capture=capture, protocol=TRACKED, budgets=BUDGETS, texture_size=1024).run(
                poses.begin
            )
            _LOG.info(
                "demo: the template stands after %.0f s: open %s while the student is trained (minutes more)",
                perf_counter() - started,
                (out / "report.html").resolve(),
            )
            # The report is written when all of its parts are there, because writing it takes seconds.
            chosen: dict[str, Any] = {"run_folder": out, "capture": capture, "no_report": True, **POSES}
            # torch, seconds of imports, which the template does not need.
            from avatar.training.engine.resources import half_of_the_threads

            with half_of_the_threads():
                Train(**chosen, stage="refine", json=True).run()
            poses.close()
            if (failed := poses.failure()) is not None:
                _LOG.warning("a process that was to help with the poses has ended: %s; see refine_help.log", failed)
            Train(**chosen, preset="demo", **STEPS).run()
            # The evaluation reads nothing of the film and the pages, and none of them keeps two cores busy: side by
            # side they take half the time. Film, page and speech play one bundle.
            evaluation.begin()
            where = self._show(console, heard.result)
            if (failed := evaluation.failure()) is not None:
                log = out / "evaluate.log"
                raise InputError(
                    "the evaluation of the demo", expected="its figures", received=failed, remedy=f"see {log}"
                )
        rewrite_report(out)
        lines = [f"{name:7} {path.resolve()}" for name, path in where.items()]
        console.print("\n" + "\n".join(lines), highlight=False, soft_wrap=True, markup=False)
        return {"exit_status": built["exit_status"]}

    def _show(self, console: Console, heard: Callable[[], Heard]) -> dict[str, Path]:
        """Write the bundle of the avatar, its film and its pages; return them by name, the report first."""
        out = self.run_folder
        avatar, params = out / f"me{BUNDLE_SUFFIX}", out / REFINED_PARAMS
        export_bundle(out, avatar, name=NAME, licence=LICENCE, params=params, exact=False)
        film, page = out / "motion.mp4", out / "player.html"
        Animate(run_folder=avatar, params=params, out=film, height=540).run()
        Web(source=avatar, single_file=page).run()
        where = {"report": out / "report.html", "film": film, "player": page, "avatar": avatar}
        return where | self._talk(avatar, console, heard)

    def _talk(self, avatar: Path, console: Console, heard: Callable[[], Heard]) -> dict[str, Path]:
        """Let the student speak, in the report and in a page; where the extra is not installed, print how to get it."""
        page = self.run_folder / "talking.html"
        try:
            Talk(avatar, self.run_folder / TALKING_FILM, web=page, text=SPEECH, view="front", height=540).run(heard)
        except MissingExtraError as error:
            console.print(f"she does not talk: {error}", markup=False, highlight=False)
            return {}
        return {"talking": page}


if __name__ == "__main__":
    begin_when_told(Path(sys.argv[1]), sys.argv[2].split(","), sys.argv[3:])
