"""`smplxpp fit`: a template and one frame's photographs in; Gaussians on it, figures and a report out."""

from __future__ import annotations

import logging
import math
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipelines.commands.options import OptionalInt, OptionalPath, OptionalText, require_avatar
from pipelines.commands.terminal import print_paths, shared_progress, training_progress
from pipelines.runs.artefacts import values_of
from pipelines.runs.stage import StageRecord, how_to_continue
from smplxpp.core.errors import require_at_least, require_positive

if TYPE_CHECKING:
    from avatar.training.fit.fit import FitConfig

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Fit:
    """Options of `smplxpp fit`. The same command resumes a fit that was interrupted."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` wrote; the fit goes into it as 70_fit."""
    capture: Path
    """Folder of the capture: cameras, images, masks and body parameters of the frame."""
    frame: int = 0
    """Frame to fit."""
    protocol: OptionalText = None
    """Protocol of the capture, whose parameters, labels and normals are read; by default the one of the build."""
    params: OptionalPath = None
    """Stacked body parameters to take instead of the capture's own, the same as for the build."""
    body: OptionalPath = None
    """SMPL-X-layout body file that the parameters are for; the open body by default."""
    preset: Literal["quick", "default", "paper"] = "default"
    """quick: 60k Gaussians and 200 iterations, to check the inputs. default: 150k and 800. paper: 270k and 10,000, for
    many cameras."""
    iterations: OptionalInt = None
    """Iterations, in the place of the preset's; each renders one view."""
    gaussians: OptionalInt = None
    """Number of Gaussians, in the place of the preset's."""
    refine_poses: Literal["auto", "on", "off"] = "auto"
    """Refine the poses of all training frames on the photographs first, as `smplxpp train` does."""
    hold_out: tuple[str, ...] = ()
    """Cameras to keep from training and to measure on; by default those that the capture holds out."""
    scale: float = 1.0
    """Size of the images to work on, 1 for every pixel."""
    max_minutes: float = math.inf
    """Stop after this many minutes of iterations and write the model reached so far. The same command then resumes,
    without --force, which would start again."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA where it is."""
    seed: int = 0
    """Seed of the Gaussians' positions and the order of views."""
    force: bool = False
    """Fit again even if the fit is up to date."""
    no_report: bool = False
    """Leave report.html as it is."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Fit, write the report, print the figures."""
        require_avatar("fitting Gaussians")
        from avatar.training.engine.processes import Distributed
        from avatar.training.engine.resources import choose_device
        from avatar.training.refinement.config import RefineConfig
        from pipelines.report.sections.build import rewrite_report
        from pipelines.runs.folders import keep_out_of_capture
        from pipelines.runs.layout import FIT_STAGE, REPORT_FILE
        from pipelines.stages.fit import FitStage
        from pipelines.stages.models import Trainer, TrainOptions
        from pipelines.stages.refine import refine, wants_refinement
        from pipelines.stages.scene import TrainInputs, open_frame

        # Check options and presets before the capture is opened.
        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        require_positive("option max-minutes", self.max_minutes, finite=False)
        config = self.config()
        inputs = TrainInputs(self.capture, self.params, self.body, self.hold_out, self.scale, self.protocol)
        # Refined poses are used by all later stages, so that refinement comes before the fit.
        device = choose_device(self.device)
        if wants_refinement(self.run_folder, inputs, self.refine_poses):
            with shared_progress(enabled=not self.json) as show:
                refine(self.run_folder, inputs, RefineConfig(seed=self.seed), progress=show, device=device)
        # `by_hand` in the record tells a later training to keep this fit.
        scene = open_frame(self.run_folder, inputs, self.frame)
        with training_progress("fit", config.iterations, enabled=not self.json) as progress:
            options = TrainOptions(
                max_seconds=60.0 * self.max_minutes, force=self.force, bar=lambda name, total: nullcontext(progress)
            )
            trainer = Trainer(self.run_folder, scene, options, Distributed(device=device), scale=self.scale)
            record = trainer.make(FitStage(name=FIT_STAGE, config=config, by_hand=True))
        # The page is rewritten if it lacks the new figures.
        report = self.run_folder / REPORT_FILE
        if not self.no_report and (record.ran or not report.is_file()) and rewrite_report(self.run_folder) is None:
            log.warning("the run has no record of its build: `smplxpp build` writes the report with the fit")
        if not self.json:
            with values_of(record):
                _print(record, report, force=self.force)
        numbers = record.manifest["numbers"]
        return {**numbers, "run": str(self.run_folder), "ran": record.ran, "checks": record.manifest["checks"]}

    def config(self) -> FitConfig:
        """Return the preset with the changes of the options.

        Raises:
            InputError: numbers out of range.
        """
        from dataclasses import replace

        from avatar.training.fit.fit import PRESETS

        config = PRESETS[self.preset]
        count = config.sampling.count if self.gaussians is None else self.gaussians
        iterations = config.iterations if self.iterations is None else self.iterations
        for name, value, least in (("gaussians", count, 1), ("iterations", iterations, 1), ("seed", self.seed, 0)):
            require_at_least(f"option {name}", value, least)
        sampling = replace(config.sampling, count=count, seed=self.seed)
        return replace(config, sampling=sampling, iterations=iterations, seed=self.seed)


def _print(record: StageRecord, report: Path, *, force: bool) -> None:
    """Print the quality of each held-out camera and of the means, the progress, and the files."""
    console = Console()
    numbers = record.manifest["numbers"]
    # One row for each held-out camera, then the means; dB for PSNR, no unit for SSIM.
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("camera")
    for name in ("PSNR person", "PSNR image", "SSIM", "PSNR head"):
        table.add_column(name, justify="right")
    keys = ("psnr", "psnr_image", "ssim", "psnr_head")

    def add(name: str, figures: dict[str, Any], style: str | None = None) -> None:
        cells = [
            f"{figures[key]:.4f}" if key == "ssim" else "-" if figures.get(key) is None else f"{figures[key]:.2f}"
            for key in keys
        ]
        table.add_row(name, *cells, style=style)

    for name, figures in numbers["held_out"].items():
        add(escape(name), figures)
    for which, label in (("held_out", "mean, held out"), ("train", "mean, training")):
        if which in numbers["mean"]:
            add(label, numbers["mean"][which], style="bold" if which == "held_out" else "dim")
    console.print(table)
    # A fit that reached its time limit prints how to resume it.
    done, total = numbers["iterations_done"], numbers["iterations"]
    state = "finished" if numbers["finished"] else f"stopped; {how_to_continue(force=force)}"
    console.print(
        f"{numbers['gaussians']:,} Gaussians, {done:,} of {total:,} iterations in {numbers['seconds_of_steps']:.1f} s "
        f"({numbers['iterations_per_second']:.1f} a second), {state if record.ran else 'stands, not run again'}",
        soft_wrap=True,
    )
    files = {"splats": record.folder / "splats.ply", "views": record.folder / "previews", "report": report}
    print_paths({name: path for name, path in files.items() if path.exists()}, console)
