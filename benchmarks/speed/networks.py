"""Measure the networks: milliseconds, parameters and memory of teacher, field, blend shapes and ST-LPIPS.

    python -m benchmarks networks [--presets cpu demo] [--device cpu]

A step is forward and backward of one frame, with the lookup of the Gaussians; the median and the fastest of `--repeats`
are stored. A large preset on a CPU takes minutes a step: it is left out unless asked for. What a step of the teacher
holds in memory is counted for all presets, without running it.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from avatar.losses.perceptual import ShiftTolerantLPIPS
from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes
from avatar.models.networks.control_points import choose_control_points
from avatar.models.networks.deformation_field import DeformationField, FieldConfig
from avatar.models.networks.sparse_lookups import MapSampler
from avatar.models.networks.teacher import NETWORK_PRESETS, Teacher, network_preset
from avatar.rendering.mesh_maps import MapFrame
from benchmarks.support.results import store_results

VERTICES, GAUSSIANS = 22_000, {"paper": 220_000, "gpu": 220_000, "paper-small": 50_000, "cpu": 50_000, "demo": 20_000}


@dataclass(frozen=True)
class Options:
    """presets: of the teacher. device: of torch. threads: of the CPU. repeats: of each step."""

    presets: tuple[str, ...] = ("cpu", "demo")
    device: str = "cpu"
    threads: int = 2
    repeats: int = 9


def measure(step: Callable[[], torch.Tensor | None], options: Options) -> dict[str, float]:
    """Milliseconds of a step: median and minimum."""
    times = []
    for k in range(options.repeats + 2):
        start = time.perf_counter()
        step()
        if options.device != "cpu":
            torch.cuda.synchronize()
        if k >= 2:
            times.append(1e3 * (time.perf_counter() - start))
    return {"median_ms": statistics.median(times), "fastest_ms": min(times)}


def body_points(count: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Points with normals on a body-sized ellipsoid."""
    normals = torch.nn.functional.normalize(torch.randn(count, 3, device=device), dim=1)
    return normals * torch.tensor([0.4, 0.9, 0.2], device=device), normals


def teacher_memory(name: str) -> dict[str, float]:
    """GiB in float32 of one frame's step: weights, gradients and Adam's moments; and what the backward pass needs.

    Counted on torch's meta device. Images, Gaussians, the perceptual metric and temporary buffers come on top.
    """
    config = network_preset(name).teacher
    held: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        held[storage._cdata] = storage
        return tensor

    with torch.device("meta"):
        teacher = Teacher(config)
        positions, semantics = torch.rand(2, 1, 2, config.in_size, config.in_size, 3)
        views = torch.rand(1, 2, config.in_size, config.in_size)
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            maps = teacher(positions, semantics, views)
    own = {parameter.untyped_storage()._cdata for parameter in teacher.parameters()}
    weights = sum(parameter.numel() * 4 for parameter in teacher.parameters())
    outputs = maps.shape.numel() * 4 + maps.colour.numel() * 4
    saved = sum(storage.nbytes() for key, storage in held.items() if key not in own)
    return {"weights_and_adam_gib": 4 * weights / 2**30, "backward_gib": (saved + outputs) / 2**30}


def teacher_steps(name: str, options: Options) -> dict[str, dict]:
    config = network_preset(name).teacher
    teacher = Teacher(config).to(options.device)
    size, count = config.in_size, GAUSSIANS[name]
    points, normals = body_points(count, options.device)
    sampler = MapSampler(MapFrame((0.0, 0.0, 0.0)), config.out_size, points, normals[:, 2] >= 0)
    positions, semantics = torch.rand(2, 1, 2, size, size, 3, device=options.device)
    views = torch.rand(1, 2, size, size, device=options.device)

    def both() -> None:
        residuals = teacher(positions, semantics, views).sampled(sampler)
        (residuals.shape.square().mean() + residuals.colour.square().mean()).backward()

    @torch.no_grad()
    def forward() -> None:
        teacher(positions, semantics, views).sampled(sampler)

    parameters = sum(p.numel() for p in teacher.parameters())
    about = {"parameters": parameters, "maps": config.out_size, "gaussians": count}
    return {
        f"teacher {name}, forward": about | measure(forward, options),
        f"teacher {name}, step": about | measure(both, options),
    }


def student_steps(options: Options) -> dict[str, dict]:
    vertices, _ = body_points(VERTICES, options.device)
    cloth = torch.arange(VERTICES, device=options.device) % 2 == 0
    control = choose_control_points(vertices.cpu().numpy(), cloth.cpu().numpy(), count=2000)
    pose, code = torch.randn(1, 63, device=options.device), torch.randn(1, 32, device=options.device)
    rows = {}
    for name, points in (("field", None), ("field, 2000 control points", control)):
        field = DeformationField(FieldConfig(), vertices, cloth, control=points).to(options.device)
        about = {"parameters": sum(p.numel() for p in field.parameters()), "vertices": VERTICES}

        def both(field: DeformationField = field) -> None:
            (field(pose, code) - 1.0).square().mean().backward()

        @torch.no_grad()
        def forward(field: DeformationField = field) -> None:
            field(pose, code)

        rows[f"{name}, forward"] = about | measure(forward, options)
        rows[f"{name}, step"] = about | measure(both, options)

    count = GAUSSIANS["cpu"]
    part = torch.from_numpy(np.arange(count) % 256)
    for name, config, extra in (
        ("blend shapes", BlendShapeConfig(), {}),
        ("blend shapes, 256 parts x 16", BlendShapeConfig(head_shapes=4, body_shapes=12, parts=256), {"part": part}),
    ):
        shapes = BlendShapes(config, count, **extra).to(options.device)
        expression = torch.randn(1, config.expression_size, device=options.device)

        def both(shapes: BlendShapes = shapes, expression: torch.Tensor = expression) -> None:
            du, dc = shapes(shapes.coefficients(expression, pose))
            ((du - 1.0).square().mean() + (dc - 1.0).square().mean()).backward()

        @torch.no_grad()
        def forward(shapes: BlendShapes = shapes, expression: torch.Tensor = expression) -> None:
            shapes(shapes.coefficients(expression, pose))

        about = {"stored_mib": shapes.stored_bytes() / 2**20, "gaussians": count}
        rows[f"{name}, forward"] = about | measure(forward, options)
        rows[f"{name}, step"] = about | measure(both, options)
    return rows


def perceptual_steps(options: Options) -> dict[str, dict]:
    metric = ShiftTolerantLPIPS().to(options.device)
    image, reference = torch.rand(2, 1, 256, 256, 3, device=options.device)
    image.requires_grad_()
    return {"ST-LPIPS at 256 x 256, step": measure(lambda: metric(image, reference).sum().backward(), options)}


def main(options: Options) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    rows: dict[str, dict] = {}
    for name in options.presets:
        rows |= teacher_steps(name, options)
    rows |= student_steps(options) | perceptual_steps(options)
    table = Table("step", "parameters", "median ms", "fastest ms")
    for name, row in rows.items():
        table.add_row(name, str(row.get("parameters", "")), f"{row['median_ms']:.1f}", f"{row['fastest_ms']:.1f}")
    Console(width=110).print(table)
    device = torch.cuda.get_device_name() if options.device != "cpu" else f"CPU, {options.threads} threads"
    name = "networks" if options.device == "cpu" else "networks_gpu"
    memory = {f"teacher {preset}, memory of a step": teacher_memory(preset) for preset in NETWORK_PRESETS}
    for title, held in memory.items():
        print(f"{title}: {', '.join(f'{key} {value:.2f}' for key, value in held.items())}")
    command = f"python -m benchmarks networks --presets {' '.join(options.presets)}"
    store_results(name, command, {"device": device} | rows | memory)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
