"""Other rasterisers on the same Gaussians, built or given from outside the project: nothing of them is in it."""

from __future__ import annotations

import ctypes
import os
import subprocess
import time
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.support.gaussian_scene import BenchmarkScene

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
