"""What test_little_memory starts: native entry points with little memory, a little more at every call.

    python little_memory.py THREADS

Prints a line an entry point: its name, how many calls ended in a memory error before one had enough, and how many of
those errors came from the native library.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from avatar.gaussians import native_kernels
from avatar.losses.image_similarity import ssim
from avatar.rendering import rasterize
from avatar.rendering.mesh_maps import mesh_maps
from smplxpp.capture.distortion import RationalDistortion, undistort
from smplxpp.core.camera import Camera
from smplxpp.raster import rasterize_triangles

STEP = 192 << 10
"""Bytes that a call has more than the one before."""
SIDES = {"draw_mesh": 400, "draw_maps": 400, "straighten": 1500, "compare": 400, "splat": 400, "bind": 100}
Work = Callable[[], object]
AXIS = np.array([0.0, 0.0, 1.0])


def soup(faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Small triangles all over the picture."""
    rng = np.random.default_rng(faces)
    corners = rng.uniform(-1, 1, (faces, 1, 3)) + rng.normal(0, 0.01, (faces, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * faces, dtype=np.int32).reshape(-1, 3)


def camera(side: int) -> Camera:
    return Camera.orthographic_view(center=np.zeros(3), direction=AXIS, half_extent=1.0, size=side)


def draw_mesh(side: int) -> Work:
    mesh, seen_by = soup(side * side // 8), camera(side)
    return lambda: rasterize_triangles(*mesh, seen_by, threads=torch.get_num_threads())


def draw_maps(side: int) -> Work:
    points, faces = soup(side * side // 32)
    vertices = torch.from_numpy(points).float().requires_grad_()
    values = torch.rand(len(points), 5, requires_grad=True)
    corners, seen_by = torch.from_numpy(faces), camera(side)

    def work() -> None:
        maps = mesh_maps(vertices, corners, seen_by, values)
        assert maps.attributes is not None
        (maps.attributes.sum() + maps.barycentric.sum()).backward()

    return work


def straighten(side: int) -> Work:
    K = np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])
    lens = RationalDistortion((0.1, 0, 0, 0, 0, 0), (0.0, 0.0))
    image = np.zeros((side, side, 3), np.uint8)
    return lambda: undistort(image, lens, source_K=K, target_K=K, size=(side, side))


def compare(side: int) -> Work:
    x, y = torch.rand(side, side, 3, requires_grad=True), torch.rand(side, side, 3)
    return lambda: ssim(x, y).backward()


def splat(side: int) -> Work:
    count = side * side // 16
    leaves = [torch.randn(count, 3) * 0.4, torch.randn(count, 4), torch.full((count, 3), 0.02)]
    leaves += [torch.rand(count) * 0.9, torch.rand(count, 12)]
    pose, K = torch.eye(4), torch.tensor([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])
    pose[2, 3] = 3.0
    gaussians = [t.requires_grad_() for t in leaves]
    return lambda: rasterize(*gaussians, pose[None], K[None], side, side)[0].sum().backward()


def bind(side: int) -> Work:
    count = side * side
    triangles = count // 4
    vertices = torch.randn(triangles, 3, requires_grad=True)
    faces, face = torch.randint(triangles, (triangles, 3)), torch.randint(triangles, (count,))
    local = [torch.rand(count, *tail).requires_grad_() for tail in ((2,), (), (3,), (2,), (4,))]
    base, harmonics, cameras = torch.rand(count, 3), torch.rand(count, 15, 3), torch.rand(2, 3)
    colored = [t.requires_grad_() for t in (base, harmonics, cameras)]

    def work() -> None:
        frames = native_kernels.FramesFunction.apply(vertices, faces)[:4]
        world = native_kernels.WorldFunction.apply(0.1, face, *local, *frames)
        colors = native_kernels.ColorsFunction.apply(face, frames[1], *colored[:2], world[0], colored[2])
        torch.stack([t.sum() for t in (*world, colors)]).sum().backward()

    return work


def outcome(work: Work) -> str:
    """What became of a call with more memory each time, until one has enough: `ended NUMBER` or what went wrong."""
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    native = 0
    for step in range(400):
        resource.setrlimit(resource.RLIMIT_AS, (used + step * STEP, hard))
        try:
            work()
        except MemoryError as error:
            native += "native library" in str(error)
        except RuntimeError as error:
            if "can't allocate memory" not in str(error):  # torch's own way to say so
                return repr(error)
        else:
            return f"ended {step} {native}"
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    return "never enough"


def main(threads: int) -> None:
    torch.set_num_threads(threads)
    for prepare in (draw_mesh, draw_maps, straighten, compare, splat, bind):
        work = prepare(SIDES[prepare.__name__])
        work()  # what libraries and threads keep for themselves
        sys.stdout.write(f"{prepare.__name__} {outcome(work)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
