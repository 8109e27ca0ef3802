"""Measure the fit to one frame: iterations a second, quality of held-out views over time, shares of a step.

    python -m benchmarks fit --capture DIR [--gaussians 150000] [--iterations 600]

The template is built first, which is not counted. Times are of the process alone on the machine or they mean little.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from avatar.data.one_frame import FRAME
from avatar.data.sequence import camera_centers_of
from avatar.data.views import read_views
from avatar.gaussians.binding import world_from_frames
from avatar.gaussians.colors import view_colors
from avatar.gaussians.sampling import SamplingConfig
from avatar.rig.rig import PosedAvatar
from avatar.training.engine.loop import METRICS_FILE
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.fit.fit import PRESETS, FitConfig, FitScene, FitTask, fit_gaussians
from benchmarks.support.results import store_results
from pipelines.commands.build import Build
from pipelines.runs import layout
from pipelines.stages.build import build
from smplxpp.capture import open_capture
from smplxpp.template.template import Template

WARM_UP, TIMED = 3, 24
WORLD = ("means", "quats", "scales", "opacities")


@dataclass(frozen=True)
class FitBenchmark:
    """Fit the reference frame of a capture and measure."""

    capture: Path
    """Folder of the capture; its splits must hold cameras out."""
    gaussians: int = PRESETS["default"].sampling.count
    """Number of Gaussians."""
    iterations: int = 600
    """Steps; the schedule of rates is stretched over them."""

    def run(self) -> None:
        """Build, fit, print and store."""
        config = replace(
            PRESETS["default"], sampling=SamplingConfig(count=self.gaussians), iterations=self.iterations, evaluations=6
        )
        with tempfile.TemporaryDirectory() as folder:
            scene = _scene(self.capture, Path(folder) / "run")
            result = fit_gaussians(scene, config, Path(folder) / "fit")
            entries = read_metrics(Path(folder) / "fit" / METRICS_FILE)
        quality = [
            {"iteration": e["iteration"], "seconds": e["seconds"], **{k: round(v, 4) for k, v in e["mean"].items()}}
            for e in entries
            if e["kind"] == "evaluation"
        ]
        figures = {
            "capture": self.capture.name,
            "gaussians": self.gaussians,
            "iterations": self.iterations,
            "threads": torch.get_num_threads(),
            "views": {"train": len(scene.train), "held_out": [view.name for view in scene.held_out]},
            "iterations_per_second": result.progress.rate,
            "held_out_over_time": quality,
            "milliseconds_of_a_step": _parts(scene, config),
        }
        _print(figures)
        path = store_results("fit", "python -m benchmarks fit --capture DIR", figures)
        print(f"stored {path.name}")


def _scene(folder: Path, run: Path) -> FitScene:
    command = Build(run_folder=run, capture=folder)
    build(run, command.inputs(), command.config(), last=layout.ASSEMBLE_STAGE)
    template = Template.load(run / layout.TEMPLATE)
    capture = open_capture(folder)
    frame = capture.frames[0]
    train, held_out = capture.splits.train_cameras, capture.splits.novel_view_cameras
    return FitScene(
        template,
        template.pose(capture.params(frame))[0],
        read_views(capture, frame, train),
        read_views(capture, frame, held_out),
        capture.recording.background or (0.0, 0.0, 0.0),
    )


def _parts(scene: FitScene, config: FitConfig) -> dict[str, float]:
    """Median milliseconds of each part of a step, forward and backward apart, over views in turn."""
    task = FitTask(scene, config)
    times: dict[str, list[float]] = {}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        begin = time.perf_counter()
        out = work()
        times.setdefault(name, []).append(1e3 * (time.perf_counter() - begin))
        return out

    rest = task.sequence.pose(FRAME).rest
    parameters = list(task.learned.values())
    for k in range(WARM_UP + TIMED):
        views = task.views(task.micro_batches(k)[0])
        bound = task.student.gaussians()
        world = timed("binding, forward", lambda b=bound: world_from_frames(b, task.frames))
        colors = timed(
            "colours, forward",
            lambda b=bound, w=world, v=views: view_colors(b, task.frames, w.means.detach(), camera_centers_of(v)),
        )
        outputs = [*(getattr(world, name) for name in WORLD), colors]
        # Cut the graph, so that each part's backward pass can be timed by itself.
        leaves = [value.detach().requires_grad_() for value in outputs]
        placed = replace(world, **dict(zip(WORLD, leaves, strict=False)))
        posed = PosedAvatar(rest, placed, leaves[-1], bound)
        loss = timed("rasteriser and loss, forward", lambda p=posed, v=views: task.penalised(p, v)[0])
        pulled = timed("rasteriser and loss, backward", lambda x=loss, v=leaves: torch.autograd.grad(x, v))
        timed("binding and colours, backward", lambda o=outputs, g=pulled: torch.autograd.grad(o, parameters, g))
        for value in parameters:
            value.grad = torch.zeros_like(value)  # the optimiser's work does not depend on the values
        timed("optimiser", task.optimiser.step)
    return {name: round(statistics.median(values[WARM_UP:]), 3) for name, values in times.items()}


def _print(figures: dict[str, Any]) -> None:
    print(
        f"{figures['capture']}: {figures['gaussians']:,} Gaussians, {figures['threads']} threads, "
        f"{figures['iterations_per_second']:.1f} iterations a second"
    )
    for entry in figures["held_out_over_time"]:
        print(
            f"  {entry['iteration']:6d} iterations {entry['seconds']:7.1f} s  PSNR {entry['psnr']:.2f} dB "
            f"(image {entry['psnr_image']:.2f}, head {entry['psnr_head']:.2f}) SSIM {entry['ssim']:.4f}"
        )
    total = sum(figures["milliseconds_of_a_step"].values())
    for name, value in figures["milliseconds_of_a_step"].items():
        print(f"  {name:32s}{value:8.2f} ms {value / total:6.1%}")


if __name__ == "__main__":
    tyro.cli(FitBenchmark, prog="python -m benchmarks fit").run()
