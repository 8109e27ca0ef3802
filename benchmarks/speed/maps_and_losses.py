"""Measure mesh maps and the fused SSIM with their gradients beside torch; store `mesh_maps.json` and `ssim.json`.

    python -m benchmarks maps_and_losses

SSIM: forward and backward with the gradient to the first image, float32, channels last; errors against the reference
in float64 as a share of the largest entry. Mesh maps: the open body, subdivided and simplified to 45k faces, fills the
height of images of 512 and 1024 pixels, 9 interpolated channels. Rivals take turns in one process, on all of torch's
threads.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import fast_simplification
import numpy as np
import torch

from avatar.losses.image_similarity import ssim, ssim_reference
from avatar.rendering.barycentrics import barycentrics_reference, interpolate_reference
from avatar.rendering.mesh_maps import mesh_maps
from benchmarks.support.results import store_results
from smplxpp.body import load_body
from smplxpp.core.camera import Camera
from smplxpp.raster import rasterize_triangles

COMMAND = "python -m benchmarks maps_and_losses"
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
    """Print and store times and gradient errors of SSIM at every size."""
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
    print("stored", store_results("ssim", COMMAND, figures))


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


def measure(vertices: torch.Tensor, faces: torch.Tensor, camera: Camera) -> dict[str, object]:
    """Times of one camera in milliseconds."""
    values = torch.rand(len(vertices), CHANNELS, generator=torch.Generator().manual_seed(0))
    maps = mesh_maps(vertices, faces, camera)
    numbers, corners = vertices.double().numpy(), faces.int().numpy()

    def gradients(render: Callable) -> None:
        v, a = vertices.clone().requires_grad_(), values.clone().requires_grad_()
        render(v, a).backward(ones)

    def reference(v: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        barycentric, _ = barycentrics_reference(v, faces, maps.face_id, camera)
        return interpolate_reference(a, barycentric, faces, maps.face_id)

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
    """Print and store times of both cameras at both sizes."""
    vertices, faces = body()
    center = 0.5 * (vertices.amin(0) + vertices.amax(0)).double().numpy()
    rows = []
    for size in (512, 1024):
        for camera in (
            Camera.look_at(eye=center + [0.0, 0.0, 2.6], target=center, fov_y_deg=40, width=size, height=size),
            Camera.orthographic_view(center=center, direction=(0, 0, 1), half_extent=1.0, size=size),
        ):
            row = measure(vertices, faces, camera)
            rows.append(row)
            print(f"{size} px, {'orthographic' if camera.orthographic else 'perspective'}")
            for name, t in row["times"].items():
                print(f"  {name:<36} {t['median_ms']:>8.2f} ms (least {t['min_ms']:.2f})")
    figures = {"faces": len(faces), "channels": CHANNELS, "threads": torch.get_num_threads(), "rows": rows}
    print("stored", store_results("mesh_maps", COMMAND, figures))


if __name__ == "__main__":
    measure_ssim()
    measure_mesh_maps()
