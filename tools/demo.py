"""`make demo`: the embedded person, from scan and photographs to a template, a student, a report, a film and a page."""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.logging import RichHandler

from pipelines.commands.animate import Animate
from pipelines.commands.build import Build
from pipelines.commands.evaluate import Evaluate
from pipelines.commands.talk import Talk
from pipelines.commands.templates import BUNDLE_SUFFIX, export_bundle
from pipelines.commands.train import Train
from pipelines.commands.web import Web
from pipelines.report.sections.build import rewrite_report
from pipelines.runs.layout import REFINED_PARAMS, TALKING_FILM
from smplxpp.capture.protocols import TRACKED
from smplxpp.core.errors import InputError, MissingExtraError

# Below what the small scan has, so that simplification has something to do.
BUDGETS = {"upper": 8_000, "lower": 8_000}
NAME, LICENCE = "The embedded person", "CC0-1.0"
SAID = (
    "Hello! I was made from one scan and a few photographs. Nobody has ever filmed me talking: "
    "my voice, my mouth and my hands all come from this text. Type one of your own, and I will say it."
)
FIXTURE = Path(__file__).resolve().parents[1] / "data" / "fixtures" / "person"


@dataclass(frozen=True)
class Demo:
    """Register the embedded person's body to what a tracker and a detector saw of it, build the template, refine the
    poses on the photographs, train teacher and student, measure both, animate the template, write a page that plays
    the student, let it talk, say where they lie.

    Nothing exact goes in: its protocol is `tracked`. The truth is looked at in measuring alone.
    """

    out: Path = Path("runs/demo")
    """Folder of the run."""
    capture: Path = FIXTURE
    """Capture to build; the embedded person by default."""

    def run(self) -> Path:
        """Build, train, evaluate, animate, write the page and talk; returns the path of the report.

        Raises:
            InputError: the fixture is not there (an installed package does not hold it).
        """
        console = Console(stderr=True)
        if not self.capture.is_dir():
            raise InputError("fixture", expected="a folder", received=str(self.capture), remedy="run in a checkout")
        Build(run_folder=self.out, capture=self.capture, protocol=TRACKED, budgets=BUDGETS).run()
        Train(run_folder=self.out, capture=self.capture, preset="demo").run()
        Evaluate(run_folder=self.out, capture=self.capture).run()
        film = self.out / "motion.mp4"
        Animate(run_folder=self.out, params=self.out / REFINED_PARAMS, out=film, height=540).run()
        page = self.out / "player.html"
        Web(source=self.out, single_file=page, params=self.out / REFINED_PARAMS, name=NAME, licence=LICENCE).run()
        talking = self._talk(console)
        report = self.out / "report.html"
        where = {"report": report, "film": film, "player": page, **talking}
        lines = [f"{name:7} {path.resolve()}" for name, path in where.items()]
        console.print("\n" + "\n".join(lines), highlight=False, soft_wrap=True, markup=False)
        return report

    def _talk(self, console: Console) -> dict[str, Path]:
        """Let her say something, in the report and in a page; where the extra is not installed, say how to get it."""
        avatar = self.out / f"me{BUNDLE_SUFFIX}"
        params = self.out / REFINED_PARAMS
        export_bundle(self.out, avatar, name=NAME, licence=LICENCE, params=params, exact=False)
        page = self.out / "talking.html"
        try:
            Talk(avatar, self.out / TALKING_FILM, web=page, text=SAID, view="front", height=540).run()
        except MissingExtraError as error:
            console.print(f"she does not talk: {error}", markup=False, highlight=False)
            return {"avatar": avatar}
        rewrite_report(self.out)
        return {"avatar": avatar, "talking": page}


def main() -> int:
    """Entry point of `python -m tools.demo`."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[RichHandler(show_path=False)])
    try:
        tyro.cli(Demo, prog="python -m tools.demo").run()
    except InputError as error:
        Console(stderr=True).print(f"error: {error}", style="red", highlight=False, markup=False)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
