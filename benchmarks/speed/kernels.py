"""Time native kernels beside torch, with their gradients: Gaussians from triangles to the world, mesh maps, SSIM.

python -m benchmarks kernels binding [--run RUN] [--repeats 15] [--no-store]
python -m benchmarks kernels maps
python -m benchmarks kernels ssim
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import fast_simplification
import numpy as np
import torch
import tyro

from avatar.gaussians.binding import BoundGaussians, world_from_frames, world_from_frames_reference
from avatar.gaussians.colors import view_colors, view_colors_reference
from avatar.gaussians.frames import TriangleFrames, triangle_frames, triangle_frames_reference
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.losses.image_similarity import ssim, ssim_reference
from avatar.rendering.barycentrics import barycentrics_reference, interpolate_reference
from avatar.rendering.mesh_maps import mesh_maps
from benchmarks.peers.viewer_check import build_fixture
from benchmarks.support.results import store_results
from pipelines.runs import layout
from smplxpp.body import load_body
from smplxpp.core.camera import Camera
from smplxpp.raster import rasterize_triangles
from smplxpp.template.template import Template

COUNTS = (50_000, 220_000)
LEAVES = ("normal_offset", "offset", "log_scales", "quats", "opacity_logits", "dc", "sh")


def time_binding(*, run: Path | None = None, repeats: int = 15, store: bool = True) -> None:
    """Time Gaussians from their triangles to the world, with colours: native kernels beside torch.

    Each figure is the milliseconds of frames, world transform and colours of degree 1 for one camera, together:
    forward alone; forward and backward to the attributes on a mesh that stands still; and to attributes and vertices.
    Kernel and torch take turns in one process; minimum and median are given.

    Args:
        run: folder of a built template; the fixture's is built where none is given.
        repeats: repeats of the kernels; the torch formulas get a third.
        store: store the figures.
    """
    with tempfile.TemporaryDirectory() as folder:
        template = Template.load((run or build_fixture(Path(folder))) / layout.TEMPLATE)
    figures = {"faces": len(template.faces), "threads": torch.get_num_threads()}
    for count in COUNTS:
        bound = sample_on_mesh(template, SamplingConfig(count=count))
        figures[str(count)] = measure_binding(bound, template, repeats)
    print(json.dumps(figures, indent=1))
    if store:
        store_results("binding", "python -m benchmarks kernels binding", figures)


def measure_binding(bound: BoundGaussians, template: Template, repeats: int) -> dict:
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


SIZES = [(384, 640, 3), (512, 512, 3), (1024, 1024, 3)]


def images(shape: tuple[int, int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth image and a noisy copy."""
    H, W, C = shape
    rng = torch.Generator().manual_seed(0)
    x = torch.nn.functional.interpolate(torch.rand((1, C, H // 8, W // 8), generator=rng), size=(H, W), mode="bilinear")
    x = x[0].permute(1, 2, 0).contiguous()
    return x, (x + 0.1 * torch.randn(shape, generator=rng)).clamp(0, 1)


def step(function: Callable, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    x = x.detach().requires_grad_()
    function(x, y).backward()
    return x.grad


def forward(function: Callable, x: torch.Tensor, y: torch.Tensor) -> float:
    with torch.no_grad():
        return float(function(x, y))


def milliseconds(actions: dict[str, Callable], repeats: int) -> dict[str, dict[str, float]]:
    """Median and minimum of each action, all in turns."""
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for k in range(repeats + 1):
        for name, action in actions.items():
            start = time.perf_counter()
            action()
            if k:
                seconds[name].append(time.perf_counter() - start)
    return {name: {"median_ms": 1e3 * float(np.median(s)), "min_ms": 1e3 * min(s)} for name, s in seconds.items()}


def measure_ssim() -> None:
    """Print and store times and gradient errors of SSIM at every size.

    Forward and backward with the gradient to the first image, float32, channels last; errors against the reference in
    float64 as a share of the largest entry. Rivals take turns in one process, on all of torch's threads.
    """
    rows = []
    print(f"{'size':>14} {'forward':>9} {'fwd+bwd':>9} {'torch fwd+bwd':>14} {'ratio':>6} {'gradient error':>15}")
    for shape in SIZES:
        x, y = images(shape)
        times = milliseconds(
            {
                "forward": lambda x=x, y=y: forward(ssim, x, y),
                "fused": lambda x=x, y=y: step(ssim, x, y),
                "torch": lambda x=x, y=y: step(ssim_reference, x, y),
            },
            repeats=15 if shape[0] < 1000 else 5,
        )
        truth = step(ssim_reference, x.double(), y.double())
        errors = {
            name: float((step(f, x, y) - truth).abs().max() / truth.abs().max())
            for name, f in (("fused", ssim), ("torch", ssim_reference))
        }
        ratio = times["torch"]["median_ms"] / times["fused"]["median_ms"]
        rows.append({"shape": shape, "times": times, "torch_over_fused": ratio, "gradient_error": errors})
        medians = [times[k]["median_ms"] for k in ("forward", "fused", "torch")]
        print(
            f"{'x'.join(map(str, shape)):>14} {medians[0]:>9.2f} {medians[1]:>9.2f} {medians[2]:>14.2f} "
            f"{ratio:>6.1f} {errors['fused']:>15.1e}"
        )
    figures = {"threads": torch.get_num_threads(), "rows": rows}
    print("stored", store_results("ssim", "python -m benchmarks kernels ssim", figures))


FACES, CHANNELS = 45_000, 9


def body() -> tuple[torch.Tensor, torch.Tensor]:
    """The open body with `FACES` faces."""
    model = load_body()
    vertices, faces = np.asarray(model.v_template, np.float64), np.asarray(model.faces)
    while len(faces) < FACES:
        vertices, faces = subdivide(vertices, faces)
    points, corners = fast_simplification.simplify(
        vertices.astype(np.float32), faces.astype(np.int32), target_count=FACES
    )
    return torch.from_numpy(points).float(), torch.from_numpy(corners.astype(np.int64))


def subdivide(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face into four at the middles of its edges."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (inverse.reshape(-1, 3) + len(vertices)).T
    split = np.concatenate([np.stack(k, 1) for k in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return np.concatenate([vertices, vertices[unique].mean(1)]), split


def measure_maps(vertices: torch.Tensor, faces: torch.Tensor, camera: Camera) -> dict[str, object]:
    """Times of one camera in milliseconds."""
    values = torch.rand(len(vertices), CHANNELS, generator=torch.Generator().manual_seed(0))
    maps = mesh_maps(vertices, faces, camera)
    covered = maps.mask.flatten().nonzero().squeeze(1)
    numbers, corners = vertices.double().numpy(), faces.int().numpy()

    def gradients(render: Callable) -> None:
        v, a = vertices.clone().requires_grad_(), values.clone().requires_grad_()
        render(v, a).backward(ones)

    def reference(v: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        barycentric, _ = barycentrics_reference(v, faces, maps.face_id, camera)
        return interpolate_reference(a, barycentric, faces, maps.face_id, covered)

    def native(v: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        return mesh_maps(v, faces, camera, a).attributes

    ones = torch.ones((*maps.face_id.shape, CHANNELS))
    times = milliseconds(
        {
            "z-buffer": lambda: rasterize_triangles(numbers, corners, camera, threads=torch.get_num_threads()),
            "interpolate": lambda: maps.interpolate(values),
            "maps": lambda: native(vertices, values),
            "maps and gradients": lambda: gradients(native),
            "torch at known faces": lambda: reference(vertices, values),
            "torch at known faces and gradients": lambda: gradients(reference),
        },
        repeats=9,
    )
    return {
        "size": (camera.width, camera.height),
        "orthographic": camera.orthographic,
        "covered_pixels": int(maps.mask.sum()),
        "times": times,
    }


def measure_mesh_maps() -> None:
    """Print and store times of mesh maps of both cameras at both sizes.

    The open body, subdivided and simplified to 45k faces, fills the height of images of 512 and 1024 pixels, 9
    interpolated channels. Rivals take turns in one process, on all of torch's threads.
    """
    vertices, faces = body()
    center = 0.5 * (vertices.amin(0) + vertices.amax(0)).double().numpy()
    rows = []
    for size in (512, 1024):
        for camera in (
            Camera.look_at(eye=center + [0.0, 0.0, 2.6], target=center, fov_y_deg=40, width=size, height=size),
            Camera.orthographic_view(center=center, direction=(0, 0, 1), half_extent=1.0, size=size),
        ):
            row = measure_maps(vertices, faces, camera)
            rows.append(row)
            print(f"{size} px, {'orthographic' if camera.orthographic else 'perspective'}")
            for name, t in row["times"].items():
                print(f"  {name:<36} {t['median_ms']:>8.2f} ms (least {t['min_ms']:.2f})")
    figures = {"faces": len(faces), "channels": CHANNELS, "threads": torch.get_num_threads(), "rows": rows}
    print("stored", store_results("mesh_maps", "python -m benchmarks kernels maps", figures))


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"binding": time_binding, "maps": measure_mesh_maps, "ssim": measure_ssim})
