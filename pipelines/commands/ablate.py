"""`smplxpp ablate`: variants of the avatar trained on one capture, measured by one protocol, in one table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pipelines.commands.options import OptionalInt, OptionalPath, OptionalText, require_avatar
from pipelines.runs.stage import how_to_continue
from smplxpp.core.errors import InputError, ProgressCallback

if TYPE_CHECKING:
    from avatar.training.engine.loop import Progress as TrainingProgress
    from avatar.training.presets import TrainingPreset
    from pipelines.ablation.ablate import AblationOutcome


_NOT_IN_RECORD = ("run_folder", "capture", "params", "body", "max_minutes", "device", "force", "json")


@dataclass(frozen=True)
class Ablate:
    """Options of `smplxpp ablate`. The same command resumes an ablation that was interrupted."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` wrote; the ablation goes into RUN/ablation."""
    capture: Path
    """Folder of the capture: cameras, images, masks and body parameters."""
    preset: Literal["paper", "gpu", "paper-small", "cpu", "demo"] = "cpu"
    """Sizes and iterations of all rows, as for `smplxpp train`."""
    rows: tuple[str, ...] = ("paper",)
    """Rows by name, or groups of them: paper, options, baselines, all. See docs/ablation.md."""
    iterations_share: float = 1.0
    """Fraction of the preset's iterations of every training: 0.25 takes a quarter of the time and is less accurate."""
    gaussians: OptionalInt = None
    """Number of Gaussians, in the place of the preset's."""
    scale: float = 1.0
    """Size of the images to train and measure on, 1 for every pixel."""
    every: int = 1
    """Measure every n-th of the held-out frames."""
    metric: Literal["st-lpips", "lpips", "none"] = "st-lpips"
    """Perceptual distance to measure, and to train with where the preset does."""
    lpips_weights: tuple[Path, ...] = ()
    """Weights of LPIPS, as of `smplxpp evaluate`; it is measured beside ST-LPIPS then."""
    samples: int = 100_000
    """Points of a mesh for its distance to the true surface; 0 leaves the surface out."""
    hold_out: tuple[str, ...] = ()
    """Cameras to keep from training and to measure on; by default those that the capture holds out."""
    protocol: OptionalText = None
    """Protocol of the capture, whose parameters, labels and normals are read; by default the one of the build."""
    params: OptionalPath = None
    """Stacked body parameters to take instead of the capture's own, the same as for the build."""
    body: OptionalPath = None
    """SMPL-X-layout body file that the parameters are for; the open body by default."""
    max_minutes: float = math.inf
    """Stop after this many minutes and print the finished rows. The same command then resumes, without --force, which
    would start again."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA where it is."""
    seed: int = 0
    """Seed of all random numbers."""
    force: bool = False
    """Train the rows again even if they are up to date."""
    json: bool = False
    """Print the results as JSON."""

    def run(self) -> dict[str, Any]:
        """Train, measure, write and print the table."""
        require_avatar("training avatars")
        from avatar.evaluation.evaluate import EvaluationConfig
        from avatar.evaluation.protocol import ProtocolConfig
        from avatar.training.engine.resources import choose_device
        from pipelines.ablation.ablate import AblationRun, ablate
        from pipelines.ablation.rows import ablation_rows
        from pipelines.runs.folders import keep_out_of_capture
        from pipelines.stages.scene import TrainInputs

        # Check folder and options before anything is trained: all rows together take hours.
        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        for name, value in (("max-minutes", self.max_minutes), ("iterations-share", self.iterations_share)):
            if not value > 0:
                raise InputError(f"option {name}", expected="a number above 0", received=f"{value:g}")
        # Every row is measured by the same protocol; rendering speed is not part of the table.
        rows, preset = ablation_rows(self.rows), self.training()
        config = EvaluationConfig(
            protocol=ProtocolConfig(every=self.every),
            metric="both" if self.lpips_weights and self.metric == "st-lpips" else self.metric,
            lpips_weights=self.lpips_weights,
            samples=self.samples,
            speed_pictures=0,
        )
        with _progress(enabled=not self.json) as (training, measuring):
            outcome = ablate(
                self.run_folder,
                TrainInputs(self.capture, self.params, self.body, self.hold_out, self.scale, self.protocol),
                rows,
                preset,
                config,
                AblationRun(
                    self.command(), choose_device(self.device), 60.0 * self.max_minutes, self.force, training, measuring
                ),
            )
        if not self.json:
            _print(outcome, how_to_continue(force=self.force))
        return outcome.results

    def command(self) -> str:
        """Return the command line for the table's record, without paths, limits and display options."""
        words = ["smplxpp ablate RUN --capture DIR"]
        for f in fields(self):
            value = getattr(self, f.name)
            # The preset is always stated, other options only where they differ from their defaults.
            if f.name not in _NOT_IN_RECORD and (value != f.default or f.name == "preset"):
                shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
                words.append(f"--{f.name.replace('_', '-')} {shown}")
        return " ".join(words)

    def training(self) -> TrainingPreset:
        """Return the preset with the changes of the options.

        Raises:
            InputError: numbers out of range.
        """
        from dataclasses import replace

        from avatar.training.presets import training_preset

        preset = training_preset(self.preset)
        if self.iterations_share != 1.0:
            preset = preset.shortened(self.iterations_share)
        if self.seed < 0:
            raise InputError("option seed", expected="a number, at least 0", received=str(self.seed))
        preset = preset.with_seed(self.seed)
        if self.gaussians is not None:
            sampling = replace(preset.fit.sampling, count=self.gaussians)
            preset = replace(preset, fit=replace(preset.fit, sampling=sampling))
        return preset


Training = Callable[[str, "TrainingProgress"], None]


@contextmanager
def _progress(*, enabled: bool) -> Iterator[tuple[Training, ProgressCallback]]:
    """Show a bar with loss, held-out PSNR and speed for each training, and one while a row is measured."""
    columns = (
        TextColumn("{task.description:<18}"),
        BarColumn(bar_width=10),
        MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    # Bars appear when their training reports first, so that rows up to date show none.
    tasks: dict[str, Any] = {}
    quality: dict[str, str] = {}
    with Progress(*columns, console=Console(stderr=True), disable=not enabled, speed_estimate_period=20.0) as bar:

        def task(name: str, total: int) -> Any:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=total, figures="")
            return tasks[name]

        def training(name: str, state: TrainingProgress) -> None:
            # Most steps have no evaluation; show the PSNR of the last one.
            if state.evaluation is not None and "psnr" in state.evaluation["mean"]:
                quality[name] = f"PSNR {state.evaluation['mean']['psnr']:.2f} dB"
            figures = [f"loss {state.metrics['loss']:.4f}"] if "loss" in state.metrics else []
            figures += [f"{state.rate:.1f} it/s"] if state.rate else []
            figures += [quality[name]] if name in quality else []
            bar.update(task(name, state.iterations), completed=state.iteration, figures="  ".join(figures))

        def measuring(name: str, share: float) -> None:
            bar.update(task(f"measuring {name}", 100), completed=round(100 * share))

        yield training, measuring


def _print(outcome: AblationOutcome, how_to_continue: str) -> None:
    console = Console()
    if outcome.results["rows"]:
        console.print(outcome.table.text(width=console.width), soft_wrap=True, highlight=False)
    if outcome.waiting:
        console.print(f"still to do: {', '.join(outcome.waiting)}; {how_to_continue}", soft_wrap=True)
    console.print(f"table, figures and pictures: {outcome.folder}", soft_wrap=True, highlight=False, markup=False)
