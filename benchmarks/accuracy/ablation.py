"""Store the table of an ablation: the paper's rows, options and baselines, with the command that made it.

    python -m benchmarks ablation --run RUN

stores what `smplxpp ablate` left in RUN/ablation. With --capture DIR the command runs first.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from benchmarks.support.results import store_results
from pipelines.ablation.ablate import RESULTS_FILE
from pipelines.commands.ablate import Ablate
from pipelines.commands.options import OptionalPath
from pipelines.runs.layout import ABLATION
from smplxpp.core.errors import InputError

SHOWN = ("psnr", "ssim", "perceptual", "psnr_head", "psnr_head_alone", "images", "frames", "spread")
"""Ends of the figures of views that are stored; those of surfaces and of training all are."""


@dataclass(frozen=True)
class AblationBenchmark:
    """Store the table of an ablation."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Run with the ablation."""
    capture: OptionalPath = None
    """Folder of the capture, to train and measure first what is missing."""
    preset: Literal["paper", "gpu", "paper-small", "cpu", "demo"] = "cpu"
    """Capture of the training."""
    rows: tuple[str, ...] = ("paper",)
    """Rows and groups."""
    iterations_share: float = 1.0
    """Share of the preset's iterations."""
    name: str | None = None
    """Name of the stored file, `ablation_NAME`; by default that of the capture."""

    def run(self) -> None:
        """Run what is asked for, print the table, store the figures."""
        if self.capture is not None:
            Ablate(self.run_folder, self.capture, self.preset, self.rows, iterations_share=self.iterations_share).run()
        results = read_results(self.run_folder)
        print((self.run_folder / ABLATION / "table.txt").read_text())
        name = self.name or results["evaluation"]["capture"]
        path = store_results(f"ablation_{name}", results["command"], figures(results))
        print(f"stored {path.name}")


def read_results(run: Path) -> dict[str, Any]:
    """Figures of a finished ablation.

    Raises:
        InputError: none, or rows that wait for their training.
    """
    path = run / ABLATION / RESULTS_FILE
    results = json.loads(path.read_text()) if path.is_file() else {}
    if not results.get("rows") or results["waiting"]:
        raise InputError(
            f"ablation of {run}",
            expected="finished rows",
            received=f"still to do: {', '.join(results['waiting'])}" if results.get("waiting") else "none",
            remedy="make them with `smplxpp ablate RUN --capture DIR`",
        )
    return results


def figures(results: dict[str, Any]) -> dict[str, Any]:
    """Return what is stored: sizes of the training, and the rows' figures to five digits."""
    preset = results["preset"]
    rows = {
        row["title"]: {
            "what": row["note"],
            **{
                key: float(f"{value:.5g}") if isinstance(value, float) else value
                for key, value in row["figures"].items()
                if "." not in key or key.startswith("surface.") or key.split(".")[-1] in SHOWN
            },
        }
        for row in results["rows"].values()
    }
    return {
        "capture": results["evaluation"]["capture"],
        "scale": results["scale"],
        "device": results["device"],
        "gaussians": preset["fit"]["sampling"]["count"],
        "iterations": {name: preset[name]["iterations"] for name in ("fit", "teacher", "bake", "compensate")},
        "perceptual": results["evaluation"]["metric"],
        "inputs": results["evaluation"]["inputs"],
        "rows": rows,
    }


if __name__ == "__main__":
    tyro.cli(AblationBenchmark, prog="python -m benchmarks ablation").run()
