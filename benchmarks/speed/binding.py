"""Time Gaussians from their triangles to the world, with colours: native kernels beside torch.

    python -m benchmarks binding [--run RUN] [--repeats 15] [--no-store]

Each figure is the milliseconds of frames, world transform and colours of degree 1 for one camera, together: forward
alone; forward and backward to the attributes on a mesh that stands still; and to attributes and vertices. Kernel and
torch take turns in one process; minimum and median are given.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

from avatar.gaussians.binding import BoundGaussians, world_from_frames, world_from_frames_reference
from avatar.gaussians.colors import view_colors, view_colors_reference
from avatar.gaussians.frames import TriangleFrames, triangle_frames, triangle_frames_reference
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from benchmarks.peers.viewer_check import build_fixture
from benchmarks.support.results import store_results
from pipelines.runs import layout
from smplxpp.template.template import Template

COUNTS = (50_000, 220_000)
LEAVES = ("normal_offset", "offset", "log_scales", "quats", "opacity_logits", "dc", "sh")


@dataclass(frozen=True)
class BindingBenchmark:
    """Time the steps from local attributes to what a rasteriser takes."""

    run: Path | None = None
    """Folder of a built template; the fixture's is built where none is given."""
    repeats: int = 15
    """Repeats of the kernels; the torch formulas get a third."""
    store: bool = True
    """Store the figures."""

    def __call__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            run = self.run or build_fixture(Path(folder))
            template = Template.load(run / layout.TEMPLATE)
        figures = {"faces": len(template.faces), "threads": torch.get_num_threads()}
        for count in COUNTS:
            bound = sample_on_mesh(template, SamplingConfig(count=count))
            figures[str(count)] = measure(bound, template, self.repeats)
        print(json.dumps(figures, indent=1))
        if self.store:
            store_results("binding", "python -m benchmarks binding", figures)


def measure(bound: BoundGaussians, template: Template, repeats: int) -> dict:
    """Return milliseconds by work and by implementation."""
    vertices = torch.tensor(template.vertices, dtype=torch.float32)
    faces = torch.tensor(template.faces)
    variants = {
        "kernel": (triangle_frames, world_from_frames, view_colors),
        "torch": (
            lambda v, f: TriangleFrames(*triangle_frames_reference(v, f)[:4]),
            world_from_frames_reference,
            view_colors_reference,
        ),
    }
    figures: dict[str, dict] = {}
    for work in ("forward", "attributes", "attributes and vertices"):
        jobs = {name: job(work, bound, vertices, faces, variant) for name, variant in variants.items()}
        figures[work] = race(jobs, repeats)
    return figures


def job(
    work: str, bound: BoundGaussians, vertices: torch.Tensor, faces: torch.Tensor, variant: tuple
) -> Callable[[], object]:
    """One run of the work: nothing is kept from one to the next but a standing mesh's frames."""
    to_frames, to_world, to_colors = variant
    camera = torch.tensor([[0.0, 1.0, 3.0]])
    backward = work != "forward"
    leaves = {name: getattr(bound, name).clone().requires_grad_(backward) for name in LEAVES}
    vertices = vertices.clone().requires_grad_(work == "attributes and vertices")
    standing = to_frames(vertices, faces) if work == "attributes" else None

    def run() -> None:
        with nullcontext() if backward else torch.no_grad():
            frames = standing or to_frames(vertices, faces)
            gaussians = replace(bound, **leaves)
            world = to_world(gaussians, frames)
            outputs = [world.means, world.quats, world.scales, world.normals, world.opacities]
            outputs.append(to_colors(gaussians, frames, world.means, camera))
        if backward:
            torch.autograd.backward(outputs, [torch.ones_like(x) for x in outputs])
            for leaf in (vertices, *leaves.values()):
                leaf.grad = None

    return run


def race(jobs: dict[str, Callable[[], object]], repeats: int) -> dict[str, dict[str, float]]:
    """Milliseconds of each, in turns; the torch formulas run every third time."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(-1, repeats):  # turn -1 warms up
        for name, run in jobs.items():
            if name == "torch" and turn % 3 > 0:
                continue
            begin = time.perf_counter()
            run()
            if turn >= 0:
                times[name].append(1e3 * (time.perf_counter() - begin))
    return {
        name: {"min_ms": round(min(t), 2), "median_ms": round(statistics.median(t), 2)} for name, t in times.items()
    }


if __name__ == "__main__":
    tyro.cli(BindingBenchmark, prog="python -m benchmarks binding")()
