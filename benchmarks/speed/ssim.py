"""Time and accuracy of the fused SSIM beside torch's convolutions; prints a table and stores it.

    python -m benchmarks ssim

Forward and backward with the gradient to the first image, float32, channels last, all of torch's threads. The rivals
take turns in one process. Errors are against the reference in float64, as a share of the largest entry.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from avatar.losses.ssim import ssim, ssim_reference
from benchmarks.support.results import store_results

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


def main() -> None:
    """Measure every size."""
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
    print("stored", store_results("ssim", "python -m benchmarks ssim", figures))


if __name__ == "__main__":
    main()
