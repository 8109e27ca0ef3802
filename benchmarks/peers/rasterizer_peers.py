"""A scene of Gaussians, and other rasterisers that draw it, built or given from outside the project.

The Gaussians lie on a body of ellipsoids, 1.8 m tall, as an avatar has them: flat, on the surface, in random order.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

# Centre and half axes in metres: head, chest, hips, legs, arms, feet.
_ELLIPSOIDS = np.array(
    [
        [[0, 1.66, 0], [0.09, 0.13, 0.11]],
        [[0, 1.27, 0], [0.20, 0.30, 0.13]],
        [[0, 0.92, 0], [0.19, 0.16, 0.14]],
        [[-0.11, 0.47, 0], [0.085, 0.46, 0.09]],
        [[0.11, 0.47, 0], [0.085, 0.46, 0.09]],
        [[-0.35, 1.20, 0], [0.06, 0.34, 0.06]],
        [[0.35, 1.20, 0], [0.06, 0.34, 0.06]],
        [[-0.12, 0.04, 0.06], [0.05, 0.04, 0.13]],
        [[0.12, 0.04, 0.06], [0.05, 0.04, 0.13]],
    ]
)
DISTANCE = 3.5
"""Metres from the camera to the body."""


@dataclass(frozen=True)
class BenchmarkScene:
    """One camera's view of N Gaussians with D channels."""

    means: Tensor  # (N, 3)
    quats: Tensor  # (N, 4)
    scales: Tensor  # (N, 3)
    opacities: Tensor  # (N,)
    features: Tensor  # (N, D)
    viewmat: Tensor  # (4, 4)
    K: Tensor  # (3, 3)
    width: int
    height: int

    @property
    def gaussians(self) -> tuple[Tensor, ...]:
        return self.means, self.quats, self.scales, self.opacities, self.features

    def with_channels(self, channels: int) -> BenchmarkScene:
        """The first `channels` of the features, repeated where there are not enough."""
        repeats = -(-channels // self.features.shape[1])
        return replace(self, features=self.features.repeat(1, repeats)[:, :channels].contiguous())


def body_scene(count: int, width: int, height: int, *, sigma: float = 0.008, channels: int = 10) -> BenchmarkScene:
    """`count` Gaussians of about `sigma` metres (a log-normal spread of .3) along the surface, a hundredth of it thick.

    Opacities are uniform in [.5, .95]; the body fills the height of the image.
    """
    rng = np.random.default_rng(0)
    points, normals = _sample_surface(rng, count)
    quats = _quats_along(normals, rng.uniform(0, 2 * np.pi, count))
    scales = sigma * np.exp(rng.normal(0, 0.3, (count, 3)))
    scales[:, 0] = 0.01 * sigma
    waves = points @ rng.normal(0, 6, (3, channels)) + rng.normal(0, 0.1, (count, channels))
    turn, focal = 0.3, 0.95 * height * DISTANCE / 1.8
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.diag([1, -1, -1]) @ _rotation_about_y(-turn)
    viewmat[:3, 3] = viewmat[:3, :3] @ [0, -0.9, 0] + [0, 0, DISTANCE]
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    arrays = (points, quats, scales, rng.uniform(0.5, 0.95, count), 0.5 + 0.5 * np.sin(waves), viewmat, K)
    return BenchmarkScene(*(torch.as_tensor(array.astype(np.float32)) for array in arrays), width, height)


def _sample_surface(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals, uniform over the ellipsoids' area: directions on a sphere, accepted by the stretch."""
    centers, axes = _ELLIPSOIDS[:, 0], _ELLIPSOIDS[:, 1]
    weight = axes.prod(1) / axes.min(1)  # an upper bound of the stretch of the area
    points, normals, found = [], [], 0
    while found < count:
        part = rng.choice(len(axes), 2 * count, p=weight / weight.sum())
        direction = rng.normal(size=(2 * count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        scaled = direction / axes[part]
        stretch = axes[part].prod(1) * np.linalg.norm(scaled, axis=1)
        kept = rng.random(2 * count) < stretch / weight[part]
        points.append(centers[part[kept]] + direction[kept] * axes[part[kept]])
        normals.append(scaled[kept] / np.linalg.norm(scaled[kept], axis=1, keepdims=True))
        found += int(kept.sum())
    return np.concatenate(points)[:count], np.concatenate(normals)[:count]


def _quats_along(normals: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotations (wxyz) that turn x to the normal after a turn about x by the angle."""
    align = np.concatenate([1 + normals[:, :1], np.zeros((len(normals), 1)), -normals[:, 2:], normals[:, 1:2]], 1)
    align[normals[:, 0] < -0.999999] = [0, 0, 1, 0]
    align /= np.linalg.norm(align, axis=1, keepdims=True)
    w, x = np.cos(angles / 2), np.sin(angles / 2)
    a, b, c, d = align.T
    return np.stack([a * w - b * x, a * x + b * w, c * w + d * x, d * w - c * x], 1)


def _rotation_about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


_WRAPPER = r"""
#include <chrono>
#include "bindings.h"
using torch::Tensor;
static Tensor view(float* data, std::vector<int64_t> shape) { return torch::from_blob(data, shape, torch::kFloat32); }
static double now() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}
extern "C" void peer_blend(int width, int height, int64_t n, float* xys, float* conics, float* colors, float* opacities,
                           float* cov2d, float* depths, float* grad_image, float* grad_alpha, float* image,
                           double* seconds) {
    torch::NoGradGuard no_grad;
    Tensor xy = view(xys, {n, 2}), conic = view(conics, {n, 3}), color = view(colors, {n, 3});
    Tensor opacity = view(opacities, {n, 1}), cov = view(cov2d, {n, 2, 2}), depth = view(depths, {n});
    Tensor black = torch::zeros({3}), to_image = view(grad_image, {height, width, 3});
    Tensor to_alpha = view(grad_alpha, {height, width});
    const double start = now();
    auto [out, left, lists] =
        rasterize_forward_tensor_cpu(width, height, xy, conic, color, opacity, black, cov, depth);
    seconds[0] = now() - start;
    rasterize_backward_tensor_cpu(height, width, xy, conic, color, opacity, black, cov, depth, left, lists, to_image,
                                  to_alpha);
    seconds[1] = now() - start - seconds[0];
    delete[] lists;
    view(image, {height, width, 3}).copy_(out);
}
"""


def build_opensplat(checkout: Path, target: Path) -> Path:
    """Compiles OpenSplat's CPU kernels (of a checkout of its sources) behind a C function; returns the library."""
    library = target / "opensplat.so"
    if library.exists():
        return library
    target.mkdir(parents=True, exist_ok=True)
    (target / "wrapper.cpp").write_text(_WRAPPER)
    folder, root = checkout / "rasterizer" / "gsplat-cpu", Path(torch.__file__).parent
    includes = [folder, root / "include", root / "include/torch/csrc/api/include"]
    command = [os.environ.get("CXX", "g++"), "-std=c++20", "-O3", "-march=native", "-fopenmp", "-shared", "-fPIC"]
    command += [f"-D_GLIBCXX_USE_CXX11_ABI={int(torch.compiled_with_cxx11_abi())}", *(f"-I{path}" for path in includes)]
    command += [
        str(target / "wrapper.cpp"),
        str(folder / "gsplat_cpu.cpp"),
        f"-L{root / 'lib'}",
        "-ltorch_cpu",
        "-lc10",
    ]
    subprocess.run([*command, "-o", str(library)], check=True)
    return library


def time_opensplat(
    library: Path, scene: BenchmarkScene, projected: dict[str, Tensor]
) -> tuple[dict[str, float], Tensor]:
    """Milliseconds of its blending, forward and backward, of three channels, and its image (H, W, 3).

    `projected` are means2d (N, 2), covariances (N, 2, 2), conics (N, 3) and depths (N), which it does not compute here.
    """
    peer = ctypes.CDLL(str(library))
    count, size = len(scene.means), (scene.height, scene.width)
    # Its pixels have their centres on whole numbers.
    inputs = [projected["means2d"] - 0.5, projected["conics"], scene.features[:, :3], scene.opacities[:, None]]
    inputs += [projected["covariances"], projected["depths"], torch.ones(*size, 3), torch.ones(size)]
    inputs, image = [tensor.contiguous() for tensor in inputs], torch.empty(*size, 3)
    seconds = (ctypes.c_double * 2)()
    addresses = [ctypes.c_void_p(tensor.data_ptr()) for tensor in (*inputs, image)]
    peer.peer_blend(scene.width, scene.height, ctypes.c_int64(count), *addresses, seconds)
    return {"forward_ms": 1e3 * seconds[0], "backward_ms": 1e3 * seconds[1]}, image


class EarlierLibrary:
    """A library with the interface of the first version of these kernels: `gs_project` .. `gs_chain`."""

    def __init__(self, path: Path, scene: BenchmarkScene):
        library = self.library = ctypes.CDLL(str(path))
        library.gs_new.restype = library.gs_gbuf.restype = ctypes.c_void_p
        library.gs_gbuf.argtypes = [ctypes.c_void_p, ctypes.c_int64]
        library.gs_nv.argtypes = [ctypes.c_void_p]
        self.context, self.scene = ctypes.c_void_p(library.gs_new()), scene
        count, size = len(scene.means), (scene.height, scene.width)
        self.projected = [torch.empty(count, n) for n in (2, 3, 1, 2)]
        self.image, self.alpha = torch.empty(*size, scene.features.shape[1]), torch.empty(size)
        self.grad_image, self.grad_alpha = torch.ones_like(self.image), torch.ones_like(self.alpha)

    def run(self) -> dict[str, float]:
        """Milliseconds of a forward and of a forward and backward pass."""
        library, scene, context, threads = self.library, self.scene, self.context, torch.get_num_threads()
        count, channels = scene.features.shape
        address = lambda tensors: [ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors]  # noqa: E731
        means2d, conics, depths, extents = address(self.projected)
        means, quats, scales, opacities, features = address(scene.gaussians)
        camera = [*address((scene.viewmat, scene.K)), scene.width, scene.height, ctypes.c_float(0.3)]
        image, alpha, grad_image, grad_alpha = address((self.image, self.alpha, self.grad_image, self.grad_alpha))
        library.gs_threads(threads)
        start = time.perf_counter()
        planes = [ctypes.c_float(0.01), ctypes.c_float(1e10)]
        library.gs_project(count, means, quats, scales, opacities, *camera, *planes, means2d, conics, depths, extents)
        size = [scene.width, scene.height, channels]
        library.gs_bin(context, count, *size, means2d, conics, depths, extents, opacities, features)
        library.gs_fwd(context, channels, image, alpha, None)
        middle = time.perf_counter()
        rows = library.gs_gbuf(context, threads * library.gs_nv(context) * library.gs_na(channels))
        rows = ctypes.c_void_p(rows)
        library.gs_bwd(context, channels, image, grad_image, grad_alpha, None, rows, threads)
        grads = [torch.zeros_like(tensor) for tensor in (*scene.gaussians, self.projected[0])]
        to = address(grads)
        library.gs_chain(context, channels, rows, threads, count, means, quats, scales, opacities, *camera, *to)
        end = time.perf_counter()
        return {"forward_ms": 1e3 * (middle - start), "both_ms": 1e3 * (end - start)}
