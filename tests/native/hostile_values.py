"""What test_hostile_values starts: native entry points with values and sizes that no scene has, from a seed.

    python hostile_values.py SEED TRIALS

Prints what was refused and what was drawn, a line an entry point; anything else ends it with a traceback or a signal.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter

import numpy as np
import torch

from avatar.gaussians import BoundGaussians, triangle_frames, view_colors, world_from_frames
from avatar.losses.image_similarity import ssim, ssim_map
from avatar.rendering import rasterize
from avatar.rendering.mesh_maps import mesh_maps
from smplxpp.capture.distortion import RationalDistortion, undistort
from smplxpp.core import Camera, GeometryWarning, InputError
from smplxpp.raster import rasterize_triangles

POISON = (np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-38, 1e-45, 0.0, -1.0, 1e9)


class Draws:
    """Random inputs, some of which are spoilt."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def choice(self, *values: int) -> int:
        return int(self.rng.choice(values))

    def floats(self, *shape: int) -> np.ndarray:
        values = self.rng.normal(size=shape)
        for _ in range(self.choice(0, 0, 0, 0, 1, 3)):
            if values.size:
                values.flat[self.rng.integers(values.size)] = self.rng.choice(POISON)
        return values

    def tensor(self, *shape: int) -> torch.Tensor:
        return torch.from_numpy(self.floats(*shape)).float().requires_grad_()

    def indices(self, count: int, bound: int) -> np.ndarray:
        values = self.rng.integers(0, max(bound, 1), (count, 3))
        if self.choice(*[0] * 9, 1) and values.size:
            values.flat[self.rng.integers(values.size)] = self.rng.choice([-1, bound, 2**31 + 5, -(2**40), 2**62])
        return values

    def camera(self) -> Camera:
        K = np.eye(3)
        K[:2, :2] = np.diag(
            self.rng.choice([30.0, 0.0, -5.0, 1e-30, 1e30, np.inf], 2, p=[0.7, 0.06, 0.06, 0.06, 0.06, 0.06])
        )
        K[:2, 2] = self.floats(2)
        sides = [self.choice(1, 17, 30, 64, 0, 1 << 40) if self.choice(*[0] * 5, 1) else 20 for _ in "xy"]
        pose = np.eye(4)
        pose[:3, 3] = self.floats(3) + [0, 0, 3]
        return Camera(K, pose, *sides, orthographic=bool(self.choice(0, 1)))


def differentiate(*outputs: torch.Tensor) -> None:
    total = torch.stack([output.double().nansum() for output in outputs]).sum()
    if total.requires_grad:
        total.backward()


def draw_mesh(d: Draws) -> None:
    count = d.choice(0, 3, 50)
    near, threads = float(d.rng.choice([1e-3] * 7 + [np.nan, np.inf, -1.0])), d.choice(1, 2, 1, 2, 0, -5, 2**40)
    rasterize_triangles(d.floats(count, 3), d.indices(d.choice(0, 20), count), d.camera(), near=near, threads=threads)


def draw_maps(d: Draws) -> None:
    count = d.choice(0, 3, 50)
    faces = torch.from_numpy(d.indices(d.choice(0, 20), count))
    maps = mesh_maps(d.tensor(count, 3), faces, d.camera(), d.tensor(count, d.choice(0, 1, 4)))
    assert maps.attributes is not None
    differentiate(maps.attributes, maps.barycentric)


def splat(d: Draws, check: bool = True) -> None:
    count, channels, cameras = d.choice(0, 1, 30), d.choice(1, 3, 12), d.choice(0, 1, 2)
    scales = (d.tensor(count, 3) * 0.1).exp() * 0.1 if d.choice(0, 1) else d.tensor(count, 3).abs()
    poses, Ks = torch.eye(4).repeat(cameras, 1, 1), torch.eye(3).repeat(cameras, 1, 1)
    poses[:, :3, 3] = d.tensor(cameras, 3).detach() + torch.tensor([0, 0, 3.0])
    Ks[:, [0, 1], [0, 1]] = 30 + d.tensor(cameras, 2).detach()
    width, height = (d.choice(1, 5, 33, 40, 0, -1, 1 << 40) if d.choice(*[0] * 5, 1) else 20 for _ in "xy")
    opacities = torch.rand(count) if d.choice(0, 1) else d.tensor(count).abs().clamp(max=1)
    gaussians = (d.tensor(count, 3), d.tensor(count, 4), scales, opacities, d.tensor(count, channels))
    if not check:
        width, height = 20, 20
    image, alpha, _ = rasterize(*gaussians, poses, Ks, width, height, background=d.tensor(channels), check=check)
    differentiate(image, alpha)


def splat_unchecked(d: Draws) -> None:
    splat(d, check=False)


def compare(d: Draws) -> None:
    shape = (d.choice(0, 1, 11, 40, 20), d.choice(0, 1, 11, 300, 20), d.choice(0, 1, 3, 3))
    padding = ("zero", "valid")[d.choice(0, 1)]
    x, y = d.tensor(*shape), d.tensor(*shape)
    differentiate(ssim(x, y, padding=padding), ssim_map(x, y, padding=padding))
    mask = d.tensor(*shape[:2]).detach().abs()
    differentiate(ssim(x, y, mask=mask, padding=padding))


def bind(d: Draws) -> None:
    vertices, triangles, count = d.choice(1, 3, 40), d.choice(0, 1, 30), d.choice(0, 1, 50)
    faces = torch.from_numpy(d.indices(triangles, vertices))
    frames = triangle_frames(d.tensor(vertices, 3), faces)
    harmonics = d.choice(0, 3, 8, 15)
    shapes = {"barycentric": (2,), "normal_offset": (), "offset": (3,), "log_scales": (2,), "quats": (4,)}
    shapes |= {"opacity_logits": (), "dc": (3,), "sh": (harmonics, 3)}
    local = {name: d.tensor(count, *tail) for name, tail in shapes.items()}
    face = torch.from_numpy(d.indices(count, triangles)[:, 0])
    bound = BoundGaussians(face_index=face, **local, face_count=triangles, topology="")
    world = world_from_frames(bound, frames)
    colors = view_colors(bound, frames, world.means, d.tensor(d.choice(0, 1, 3), 3))
    differentiate(world.means, world.quats, world.scales, world.normals, colors)


def straighten(d: Draws) -> None:
    sides = (d.choice(0, 1, 30, 30, 30), d.choice(0, 1, 40, 40, 40))
    tail = [(), (0,), (1,), (2,), (3,), (4,), (7,)][d.choice(*range(7))]
    image = d.rng.integers(0, 256, (*sides, *tail)).astype(np.uint8)
    source, target = (np.diag([*(20 + 5 * d.floats(2)), 1.0]) for _ in "st")
    if d.choice(*[0] * 7, 1):
        target[0, 0] = 0.0
    k1, k2, k3, k4, k5, k6, p1, p2 = d.floats(8).tolist()
    lens = RationalDistortion((k1, k2, k3, k4, k5, k6), (p1, p2))
    size = (d.choice(1, 30, 30, 30, 0, -1), d.choice(1, 20))
    out = undistort(image, lens, source_K=source, target_K=target, size=size, nearest=bool(d.choice(0, 1)))
    assert out.shape == (size[1], size[0], *tail)


def main(seed: int, trials: int) -> None:
    warnings.simplefilter("ignore", GeometryWarning)
    warnings.simplefilter("ignore", RuntimeWarning)  # numpy's, of products with infinity
    for work in (draw_mesh, draw_maps, splat, splat_unchecked, compare, bind, straighten):
        found: Counter[str] = Counter()
        for trial in range(trials):
            try:
                work(Draws(seed * 100_003 + trial))
                found["drawn"] += 1
            except InputError:
                found["refused"] += 1
        sys.stdout.write(f"{work.__name__} {found['drawn']} {found['refused']}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
