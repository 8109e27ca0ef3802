"""`smplxpp demo`: the embedded person, from scan and photographs to a template, a student, a report, films, pages."""

from __future__ import annotations

import logging
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from time import perf_counter
from typing import Annotated, Any

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

_LOG = logging.getLogger(__name__)
# Below what the small scan has, so that simplification has something to do.
BUDGETS = {"upper": 8_000, "lower": 8_000}
NAME, LICENCE = "The embedded person", "CC0-1.0"
# Two processes share the chunks of the refinement, which have few frames, so that both end at about the same time.
CHUNKS = {"refine_frames": 2}
SPEECH = (
    "Hello! I was made from one scan and a few photographs. Nobody has ever filmed me talking: "
    "my voice, my mouth and my hands all come from this text. Type one of your own, and I will say it."
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


def evaluate_beside(run: Path, capture: Path, stop: Event) -> None:
    """Run `smplxpp evaluate` as a process of its own, with half of the cores, until `stop` is set.

    Raises:
        InputError: the evaluation has failed; its log is kept in the run folder.
    """
    failed = _beside(("evaluate", str(run.resolve()), "--no-report"), run, capture, "evaluate", stop)
    if failed is not None:
        log = run / "evaluate.log"
        raise InputError("the evaluation of the demo", expected="its figures", received=failed, remedy=f"see {log}")


def help_refine_beside(run: Path, capture: Path, stop: Event) -> None:
    """Compute chunks of the refinement as a process of its own, until none is left or `stop` is set.

    Two processes of one thread take half the time of one with two threads, which wait for each other's Python.
    """
    words = (
        "train",
        str(run.resolve()),
        "--stage",
        "refine",
        "--refine-help",
        "--refine-frames",
        str(CHUNKS["refine_frames"]),
    )
    failed = _beside(words, run, capture, "refine_help", stop)
    if failed is not None and not stop.is_set():
        _LOG.warning("a process that was to help with the poses has ended: %s; see refine_help.log", failed)


def _beside(words: tuple[str, ...], run: Path, capture: Path, name: str, stop: Event) -> str | None:
    """Run a command on a capture beside this process; return what was wrong, None where it has done its work."""
    log, answer = run / f"{name}.log", run / f"{name}.json"
    program, variables = own_program()
    half = str(max(1, (os.cpu_count() or 1) // 2))
    ended = run_process(
        (*program, *words, "--capture", str(capture.resolve()), "--json"),
        log=log,
        answer=answer,
        environment={**variables, "OMP_NUM_THREADS": half},
        folder=run,
        stop=stop.is_set,
        began=lambda pid: None,
    )
    meaning, error = meaning_of(ended, log=log, answer=answer, judged=False)
    if meaning not in ("done", "stopped"):
        return str((error or {}).get("message") or f"exit status {ended.exit_status}").rstrip(".")
    log.unlink()
    answer.unlink()
    return None


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
        from avatar.training.engine.resources import half_of_the_threads

        console = Console(stderr=True)
        out, capture = self.run_folder, self.capture or embedded_capture()
        started, helped = perf_counter(), Event()
        # Poses need the template, not its validation nor its report: another process begins with them meanwhile.
        with ThreadPoolExecutor(1) as beside:
            try:
                built = Build(run_folder=out, capture=capture, protocol=TRACKED, budgets=BUDGETS).run(
                    assembled=lambda: beside.submit(help_refine_beside, out, capture, helped)
                )
                _LOG.info(
                    "demo: the template stands after %.0f s: open %s while the student is trained (minutes more)",
                    perf_counter() - started,
                    (out / "report.html").resolve(),
                )
                # The report is written when all of its parts are there, because writing it takes nine seconds.
                chosen: dict[str, Any] = {"run_folder": out, "capture": capture, "no_report": True, **CHUNKS}
                with half_of_the_threads():
                    Train(**chosen, stage="refine", json=True).run()
            finally:
                helped.set()
        Train(**chosen, preset="demo").run()
        # The evaluation reads nothing of the film and the pages, and none of them keeps two cores busy: side by side
        # they take half the time. Film, page and speech play one bundle.
        stop = Event()
        with ThreadPoolExecutor(1) as beside:
            measured = beside.submit(evaluate_beside, out, capture, stop)
            try:
                where = self._show(console)
            except BaseException:  # an interrupt, too: nobody waits for the figures any more
                stop.set()
                raise
            measured.result()
        rewrite_report(out)
        lines = [f"{name:7} {path.resolve()}" for name, path in where.items()]
        console.print("\n" + "\n".join(lines), highlight=False, soft_wrap=True, markup=False)
        return {"exit_status": built["exit_status"]}

    def _show(self, console: Console) -> dict[str, Path]:
        """Write the bundle of the avatar, its film and its pages; return them by name, the report first."""
        out = self.run_folder
        avatar, params = out / f"me{BUNDLE_SUFFIX}", out / REFINED_PARAMS
        export_bundle(out, avatar, name=NAME, licence=LICENCE, params=params, exact=False)
        film, page = out / "motion.mp4", out / "player.html"
        Animate(run_folder=avatar, params=params, out=film, height=540).run()
        Web(source=avatar, single_file=page).run()
        where = {"report": out / "report.html", "film": film, "player": page, "avatar": avatar}
        return where | self._talk(avatar, console)

    def _talk(self, avatar: Path, console: Console) -> dict[str, Path]:
        """Let the student speak, in the report and in a page; where the extra is not installed, print how to get it."""
        page = self.run_folder / "talking.html"
        try:
            Talk(avatar, self.run_folder / TALKING_FILM, web=page, text=SPEECH, view="front", height=540).run()
        except MissingExtraError as error:
            console.print(f"she does not talk: {error}", markup=False, highlight=False)
            return {}
        return {"talking": page}
