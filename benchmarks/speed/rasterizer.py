"""Measure the Gaussian rasteriser on the CPU: exactness, time by stage and instruction set, scaling, peers.

    python -m benchmarks rasterizer [--repeats 5] [--peer-lib LIB.so] [--opensplat CHECKOUT BUILD] [--no-store]

Times are wall milliseconds, minimum and median, of everything from the Gaussians to the picture (forward) and on to all
gradients (both). What is compared takes turns in one process.
"""

from __future__ import annotations

import ctypes
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro

from avatar.gaussians.tensor_operations import matrix_from_quat
from avatar.rendering import rasterize
from avatar.rendering.cpu import STAGES, CameraCall, Workspace
from avatar.rendering.reference import rasterize_reference
from avatar.rendering.settings import RasterSettings
from benchmarks.peers.rasterizer_peers import (
    BenchmarkScene,
    EarlierLibrary,
    body_scene,
    build_opensplat,
    time_opensplat,
)
from benchmarks.support.results import store_results
from smplxpp import native

SCENES = {
    "20k at 256x256": (20_000, 256, 256, 0.008),
    "50k at 512x512": (50_000, 512, 512, 0.008),
    "220k at 1500x2000, sigma 3 mm": (220_000, 1500, 2000, 0.003),
    "220k at 1500x2000, sigma 8 mm": (220_000, 1500, 2000, 0.008),
}
LANES = 16


def flop_per_pair(channels: int) -> dict[str, int]:
    """Floating-point operations of one Gaussian at one pixel: 10 for the exponent, 14 for the power of two, the rest
    for opacity, transmittance and channels; backward also the reciprocal, six moments and two sums over channels."""
    return {"blend": 27 + 2 * channels, "unblend": 50 + 4 * channels}


@dataclass(frozen=True)
class RasterizerBenchmark:
    """Measure the CPU backend."""

    repeats: int = 5
    """Repeats of each measurement; small scenes get three times as many."""
    peer_lib: Path | None = None
    """A library with the interface of the first version of the kernels, to be timed beside."""
    opensplat: tuple[Path, Path] | None = None
    """A checkout of OpenSplat and a folder to build its CPU kernels in, to be timed beside."""
    store: bool = True
    """Store the figures."""

    def __call__(self) -> None:
        figures = {
            "threads": torch.get_num_threads(),
            "levels": (levels := native.usable_levels()),
            "accuracy": {level: accuracy(level) for level in levels},
            "milliseconds": milliseconds(levels, self.repeats, self.peer_lib),
            "limits": limits(self.repeats),
            "scaling": scaling(self.repeats),
            "pure torch": against_oracle(),
        }
        if self.opensplat:
            figures["OpenSplat, blending alone"] = against_opensplat(*self.opensplat)
        print(json.dumps(figures, indent=1))
        if self.store:
            command = "python -m benchmarks rasterizer" + " --peer-lib LIB" * bool(self.peer_lib)
            store_results("rasterizer", command + " --opensplat CHECKOUT BUILD" * bool(self.opensplat), figures)


class Job:
    """One scene on one level, with its memory."""

    def __init__(self, scene: BenchmarkScene, level: str | None = None):
        size = (scene.height, scene.width)
        self.scene, self.workspace = scene, Workspace(level)
        self.view = CameraCall(
            scene.gaussians, (scene.viewmat, scene.K, None), RasterSettings(scene.width, scene.height)
        )
        count, channels = scene.features.shape
        self.image = torch.empty(*size, channels)
        self.outputs = (self.image, torch.empty(*size, 1), torch.empty(count, 2), torch.empty(count, 2))
        self.outputs += (torch.empty(count),)
        self.gradients = (torch.ones_like(self.image), torch.ones(size))

    def run(self) -> dict[str, float]:
        """Milliseconds of the passes and of their stages."""
        seconds = (ctypes.c_double * len(STAGES))()
        start = time.perf_counter()
        self.workspace.forward(self.view, self.outputs, seconds)
        middle = time.perf_counter()
        grads = (*(torch.empty_like(tensor) for tensor in self.scene.gaussians), None, None)
        backward_seconds = (ctypes.c_double * 2).from_buffer(seconds, 4 * ctypes.sizeof(ctypes.c_double))
        radii = self.outputs[3]
        self.workspace.backward(self.view, radii, *self.gradients, grads, (False, False), backward_seconds)
        end = time.perf_counter()
        stages = {f"{name}_ms": 1e3 * value for name, value in zip(STAGES, seconds, strict=True)}
        return {"forward_ms": 1e3 * (middle - start), "both_ms": 1e3 * (end - start), **stages}


def accuracy(level: str) -> dict[str, float]:
    """Largest errors against the oracle in float64, on a small scene with ten channels.

    Where an opacity or a transmittance falls on the other side of a threshold the image jumps: such pixels (an error
    above 1e-3 of one step, 1/255) are counted and their error left out.
    """
    scene = body_scene(1500, 96, 128, sigma=0.03)
    job = Job(scene, level)
    truths = [tensor.double().requires_grad_() for tensor in scene.gaussians]
    camera = (scene.viewmat.double()[None], scene.K.double()[None], None)
    truth, alpha, _ = rasterize_reference(*truths, *camera, RasterSettings(scene.width, scene.height))
    job.workspace.forward(job.view, job.outputs)
    error = (job.image - truth[0]).abs().amax(-1)
    decided_otherwise = error > 1e-3 / 255
    job.gradients = tuple(
        grad * ~decided_otherwise.view(*grad.shape[:2], *[1] * (grad.ndim - 2)) for grad in job.gradients
    )
    grads = tuple(torch.empty_like(tensor) for tensor in scene.gaussians)
    job.workspace.backward(job.view, job.outputs[3], *job.gradients, (*grads, None, None), (False, False))
    torch.autograd.backward([truth[0], alpha[0, ..., 0]], [grad.double() for grad in job.gradients])
    relative = [
        float((grad - leaf.grad).abs().max() / leaf.grad.abs().max()) for grad, leaf in zip(grads, truths, strict=True)
    ]
    names = ("means", "quats", "scales", "opacities", "features")
    return {
        "image": float(error[~decided_otherwise].detach().max()),
        "pixels decided otherwise": int(decided_otherwise.sum()),
        "pixels": decided_otherwise.numel(),
        **{f"gradient of {name}, of its largest": value for name, value in zip(names, relative, strict=True)},
    }


def race(jobs: dict[str, Callable[[], dict[str, float]]], repeats: int) -> dict[str, dict[str, float]]:
    """Minimum of every figure of every job, and the median of `both_ms`; the jobs take turns."""
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in jobs}
    for turn in range(-1, repeats):  # turn -1 warms up
        for name, run in jobs.items():
            row = run()
            if turn >= 0:
                rows[name].append(row)
    result = {}
    for name, found in rows.items():
        result[name] = {key: round(min(row[key] for row in found), 2) for key in found[0]}
        if "both_ms" in found[0]:
            result[name]["both_median_ms"] = round(statistics.median(row["both_ms"] for row in found), 2)
    return result


def milliseconds(levels: tuple[str, ...], repeats: int, peer_lib: Path | None) -> dict[str, dict]:
    """Return milliseconds by scene and number of channels, of every instruction set and of the peer."""
    figures = {}
    for name, (count, width, height, sigma) in SCENES.items():
        scene = body_scene(count, width, height, sigma=sigma)
        for channels in (3, 10):
            # The generic level is an order slower: seconds a turn on the largest scenes.
            chosen = levels if count < 200_000 else levels[:2]
            jobs = {level: Job(scene.with_channels(channels), level).run for level in chosen}
            if peer_lib:
                jobs["peer"] = EarlierLibrary(peer_lib, scene.with_channels(channels)).run
            figures[f"{name}, {channels} channels"] = race(jobs, repeats if count > 100_000 else 3 * repeats)
    return figures


def limits(repeats: int) -> dict[str, object]:
    """Return the cost of a pair of pixel and Gaussian, beside the limits of this machine."""
    a = torch.randn(1024, 1024)
    b, target = torch.randn(1024, 1024), torch.empty(1024, 1024)
    peak = 2 * 1024**3 / fastest(lambda: torch.mm(a, b, out=target), 3 * repeats) / 1e9
    source = torch.ones(1 << 26)
    copied = torch.empty_like(source)
    bandwidth = 2 * source.nbytes / fastest(lambda: copied.copy_(source), repeats) / 1e9
    figures: dict[str, object] = {"matrix product of torch, GFLOP/s": round(peak), "copy, GB/s": round(bandwidth, 1)}
    for name in list(SCENES)[1::2]:
        count, width, height, sigma = SCENES[name]
        job = Job(body_scene(count, width, height, sigma=sigma))
        times = race({"": job.run}, repeats)[""]
        visible, entries, visits = job.workspace.counts()
        channels = job.image.shape[-1]
        flop = flop_per_pair(channels)
        # A forward pass reads a Gaussian's ellipse and channels for each entry of a list; a backward pass again, and
        # reads and writes its row of gradients. The picture is read once and written once.
        traffic = {"blend": 8 + 32 + 4 * channels, "unblend": 8 + 32 + 4 * channels + 128}
        picture = 4 * width * height * (channels + 1)
        stages = {}
        for stage in ("blend", "unblend"):
            seconds = 1e-3 * times[f"{stage}_ms"]
            rate = visits * LANES * flop[stage] / seconds / 1e9
            stages[stage] = {
                "FLOP a pair": flop[stage],
                "bytes a pair": round((entries * traffic[stage] + picture) / (visits * LANES), 1),
                "ns a visit of 16 pixels": round(1e9 * seconds / visits, 1),
                "GFLOP/s": round(rate),
                "percent of the matrix product": round(100 * rate / peak, 1),
            }
        counts = {"visible": visible, "entries of tile lists": entries, "visits": visits}
        figures[name] = {**counts, **stages}
    return figures


def fastest(run: Callable[[], object], repeats: int) -> float:
    """Seconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def scaling(repeats: int) -> dict[str, dict[str, dict[str, float]]]:
    """Return times by each quantity, the others as in 50k at 512x512 with ten channels."""
    base = body_scene(50_000, 512, 512)
    keep = ("forward_ms", "both_ms")
    scenes = {
        "gaussians": {str(n): body_scene(n, 512, 512) for n in (12_500, 50_000, 200_000)},
        "pixels a side": {str(n): body_scene(50_000, n, n) for n in (256, 512, 1024)},
        "channels": {str(n): base.with_channels(n) for n in (1, 3, 10, 16, 32, 64)},
    }
    figures = {
        quantity: {
            value: {key: race({"": Job(scene).run}, repeats)[""][key] for key in keep} for value, scene in row.items()
        }
        for quantity, row in scenes.items()
    }
    before, job = torch.get_num_threads(), Job(base)
    figures["threads"] = {}
    try:
        for threads in sorted({1, 2, before}):
            torch.set_num_threads(threads)
            times = race({"": job.run}, repeats)[""]
            figures["threads"][str(threads)] = {key: times[key] for key in keep}
    finally:
        torch.set_num_threads(before)
    return figures


def against_oracle() -> dict[str, float]:
    """Milliseconds of a forward and backward pass through `rasterize`, kernels against pure torch in float32."""
    scene = body_scene(2000, 128, 128, sigma=0.02)

    def step(backend: str) -> dict[str, float]:
        leaves = [tensor.clone().requires_grad_() for tensor in scene.gaussians]
        start = time.perf_counter()
        camera = (scene.viewmat[None], scene.K[None], scene.width, scene.height)
        image, alpha, _ = rasterize(*leaves, *camera, backend=backend)
        (image.sum() + alpha.sum()).backward()
        return {"both_ms": 1e3 * (time.perf_counter() - start)}

    times = race({backend: partial(step, backend) for backend in ("cpu", "reference")}, 3)
    ours, theirs = times["cpu"]["both_ms"], times["reference"]["both_ms"]
    return {"kernels_ms": ours, "torch_ms": theirs, "ratio": round(theirs / ours)}


def against_opensplat(checkout: Path, build: Path) -> dict[str, float]:
    """Blending of three channels at 50k on 512x512, forward and backward; its projection is not counted."""
    scene = body_scene(50_000, 512, 512, channels=3)
    job = Job(scene)
    library = build_opensplat(checkout, build)
    projected = project_for_peer(scene)
    found = [time_opensplat(library, scene, projected) for _ in range(3)]
    ours = race({"": job.run}, 9)[""]
    theirs = {key: round(min(times[key] for times, _ in found), 2) for key in found[0][0]}
    return {
        **theirs,
        "largest difference of the images": float((found[0][1] - job.image).abs().max()),
        "ours, sort and bin and blend_ms": round(ours["sort_ms"] + ours["bin_ms"] + ours["blend_ms"], 2),
        "ours, unblend_ms": ours["unblend_ms"],
    }


def project_for_peer(scene: BenchmarkScene) -> dict[str, torch.Tensor]:
    """Centres, covariances and their inverses on the image, in torch."""
    view, K = scene.viewmat, scene.K
    centers = scene.means @ view[:3, :3].T + view[:3, 3]
    z = centers[:, 2]
    focal = K.diagonal()[:2]
    J = torch.cat([torch.diag_embed(focal / z[:, None]), (-focal * centers[:, :2] / z[:, None] ** 2)[..., None]], -1)
    half = J @ view[:3, :3] @ (matrix_from_quat(scene.quats) * scene.scales[:, None])
    covariances = half @ half.mT + 0.3 * torch.eye(2)
    inverse = torch.linalg.inv(covariances)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    means2d = focal * centers[:, :2] / z[:, None] + K[:2, 2]
    return {"means2d": means2d, "covariances": covariances, "conics": conics, "depths": z}


if __name__ == "__main__":
    tyro.cli(RasterizerBenchmark, prog="python -m benchmarks rasterizer")()
