"""Measure reading of captures: images a second, memory over a long capture, every reader on a known scene.

python -m benchmarks capture_loader
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.support.results import store_results
from smplxpp.capture import Capture, open_capture
from smplxpp.core.camera import Camera
from smplxpp.raster import rasterize_mesh
from tests.capture.scene import make_scene, overlap
from tests.capture.writers import WRITERS

LENS = [-0.12, 0.03, 0.001, -0.0007, 0.01]
BOUND = 256 << 20


def main() -> int:
    """Measure and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=16, help="distinct images of 1500 x 2000")
    parser.add_argument("--frames", type=int, default=6000, help="frames of the long capture")
    parser.add_argument("--captures", type=Path, default=Path("../shared/captures"), help="for the two calibrations")
    parser.add_argument("--memory-of", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.memory_of is not None:
        print(json.dumps(walk_long_capture(args.memory_of)))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        figures = {
            "at 1500 x 2000, images a second": throughput(root, args.images),
            f"index of {args.frames} frames": memory(root / "long", args.frames),
            "readers on a known scene, IoU": readers(root / "readers"),
        }
    if (args.captures / "woman_casual").is_dir():
        figures["two calibrations of one capture, largest difference of rays"] = rays(args.captures / "woman_casual")
    print(json.dumps(figures, indent=1))
    store_results("capture_loader", "python -m benchmarks capture_loader", figures)
    return 0


def write_images(root: Path, *, size: tuple[int, int], count: int, photographs: bool) -> None:
    """A capture of one camera in our layout: a figure with texture, on black or before a room."""
    scene = make_scene()
    camera = next(iter(scene.cameras.values()))
    width, height = size
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    camera = Camera(scale @ camera.K, camera.cam_from_world, width, height, name="A")
    mask = rasterize_mesh(scene.meshes[0], camera).mask
    rng = np.random.default_rng(0)
    for folder in ("rgbs/A", "masks/A"):
        (root / folder).mkdir(parents=True)
    for frame in range(count):
        grain = rng.integers(0, 256, (height // 6, width // 6, 3), dtype=np.uint8)
        picture = np.array(Image.fromarray(grain).resize(size, Image.Resampling.BICUBIC)) // 2 + 60
        if not photographs:
            picture[~mask] = 0
        Image.fromarray(picture).save(root / f"rgbs/A/A_rgb{frame:06d}.jpg", quality=95)
        Image.fromarray(mask.astype(np.uint8) * 255).save(root / f"masks/A/A_mask{frame:06d}.png")
    pose = camera.cam_from_world
    entry = {"name": "A", "w": width, "h": height, "K": camera.K.tolist(), "R": pose[:3, :3].tolist()}
    entry |= {"T": pose[:3, 3].tolist()} | ({"dist": LENS} if photographs else {})
    (root / "cameras.json").write_text(json.dumps([entry]))
    (root / "capture.json").write_text(json.dumps({"background": None if photographs else [0, 0, 0]}))


def throughput(root: Path, count: int) -> dict[str, object]:
    """Time each reader of the same files beside a plain decode, in alternation; return medians of three rounds."""
    write_images(root / "black", size=(1500, 2000), count=count, photographs=False)
    write_images(root / "photos", size=(3000, 4000), count=count // 4, photographs=True)
    # Nothing is kept: every image is decoded again.
    black = open_capture(root / "black", cache_bytes=0)
    photos = open_capture(root / "photos", cache_bytes=0).resized(0.5)
    kept = open_capture(root / "black")
    for view in kept.views():
        kept.foreground(*view)
    ways: dict[str, tuple[Capture, Callable[[Capture, tuple[str, int]], object], int]] = {}
    for workers in (0, 2):
        told = f"{workers} workers" if workers else "this process"
        ways[f"plain decode, image alone, {told}"] = (black, plain_image, workers)
        ways[f"plain decode, image and mask, {told}"] = (black, plain_both, workers)
        ways[f"Capture.image, {told}"] = (black, read_image, workers)
        ways[f"Capture.foreground, {told}"] = (black, read_foreground, workers)
        ways[f"plain decode of 3000 x 4000 photographs, {told}"] = (photos, plain_both, workers)
        ways[f"Capture.foreground, undistorted to half of 3000 x 4000, {told}"] = (photos, read_foreground, workers)
    ways["Capture.composited from the cache, this process"] = (kept, read_composited, 0)
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(3):
        for name, (capture, read, workers) in ways.items():
            seconds[name].append(seconds_an_image(capture, read, workers))
    return {name: round(1.0 / statistics.median(values), 1) for name, values in seconds.items()}


def seconds_an_image(capture: Capture, read: Callable, workers: int) -> float:
    """Mean over the capture's images; a loader's start is not counted."""
    views = capture.views()
    if workers == 0:
        start = time.perf_counter()
        for view in views:
            read(capture, view)
        return (time.perf_counter() - start) / len(views)
    from torch.utils.data import DataLoader

    loader = DataLoader(Reading(capture, read, views * 2), batch_size=None, num_workers=workers, prefetch_factor=2)
    batches, lead = iter(loader), 4
    for _ in range(lead):
        next(batches)
    start = time.perf_counter()
    rest = sum(1 for _ in batches)
    return (time.perf_counter() - start) / rest


class Reading:
    """A dataset of torch's kind over the views of a capture."""

    def __init__(self, capture: Capture, read: Callable, views: list[tuple[str, int]]) -> None:
        self.capture, self.read, self.views = capture, read, views

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int):
        import torch

        arrays = self.read(self.capture, self.views[index])
        return [torch.from_numpy(np.array(a)) for a in (arrays if isinstance(arrays, tuple) else (arrays,))]


def plain_image(capture: Capture, view: tuple[str, int]) -> np.ndarray:
    """Pillow alone."""
    with Image.open(capture.file(*view)) as image:
        return np.asarray(image.convert("RGB"))


def plain_both(capture: Capture, view: tuple[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pillow alone, image and mask."""
    with Image.open(capture.file(*view, "mask")) as mask:
        return plain_image(capture, view), np.asarray(mask)


def read_image(capture: Capture, view: tuple[str, int]) -> np.ndarray:
    """Photographs, as a training reads them."""
    return capture.image(*view)


def read_foreground(capture: Capture, view: tuple[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """The person alone, as a training reads it."""
    return capture.foreground(*view)


def read_composited(capture: Capture, view: tuple[str, int]) -> np.ndarray:
    """The person as float, on a background colour."""
    return capture.composited(*view, (1.0, 1.0, 1.0))


def memory(root: Path, frames: int) -> dict[str, object]:
    """A long capture of 4 cameras whose files are links to a few; walked through in a process of its own."""
    write_images(root / "few", size=(375, 500), count=8, photographs=False)
    entry = json.loads((root / "few" / "cameras.json").read_text())[0]
    names = ["A", "B", "C", "D"]
    for kind, tag, suffix in (("rgbs", "rgb", "jpg"), ("masks", "mask", "png")):
        for name in names:
            (root / "all" / kind / name).mkdir(parents=True)
            for frame in range(frames):
                source = root / "few" / kind / "A" / f"A_{tag}{frame % 8:06d}.{suffix}"
                os.link(source, root / "all" / kind / name / f"{name}_{tag}{frame:06d}.{suffix}")
    (root / "all" / "cameras.json").write_text(json.dumps([{**entry, "name": name} for name in names]))
    (root / "all" / "capture.json").write_text("{}")
    command = [sys.executable, "-m", "benchmarks.speed.capture_loader", "--memory-of", str(root / "all")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def walk_long_capture(root: Path) -> dict[str, object]:
    """Open, read three times the cache's bound at random, and say what the process held at most."""
    warm = plain_image(open_capture(root), ("A", 0))
    before = resident("VmRSS")
    start = time.perf_counter()
    capture = open_capture(root, cache_bytes=BOUND)
    views = capture.views()
    opened = time.perf_counter() - start
    after = resident("VmRSS")
    size = warm.nbytes + warm.nbytes // 3
    rng, most = np.random.default_rng(1), 0
    reads = 3 * BOUND // size
    for index in rng.integers(0, len(views), reads):
        capture.foreground(*views[index])
        most = max(most, capture.cache.held_bytes)
    return {
        "views": len(views),
        "seconds to open": round(opened, 2),
        "MiB of the index": round(after - before, 1),
        "reads": int(reads),
        "MiB decoded": round(reads * size / 2**20),
        "MiB allowed to the cache": BOUND >> 20,
        "MiB the cache held at most": round(most / 2**20, 1),
        "MiB of the process above the index, at most": round(resident("VmHWM") - after, 1),
    }


def resident(field: str) -> float:
    """MiB of this process: VmRSS now, VmHWM at most so far (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


def readers(root: Path) -> dict[str, dict[str, float]]:
    """Least overlap of the drawn scene and the masks read, over cameras; and with camera-to-world mistaken."""
    names = {"thuman4": ("cam00", "cam01", "cam02"), "neus2": ("image_c_000", "image_c_001", "image_c_002")}
    figures = {}
    for layout, (_, write, lens) in WRITERS.items():
        cameras = names.get(layout, ("Cam1", "Cam2", "Cam3"))
        scene = make_scene(lens=lens, square_pixels=layout == "colmap-binary", names=cameras)
        folder = write(scene, root / layout / "set")
        mattes = root / layout / "mattes"
        capture = open_capture(folder, masks=mattes if mattes.is_dir() else None)
        right, wrong = [], []
        for camera in capture.cameras.values():
            mask = capture.mask(camera.name, capture.frames[0]) > 127
            for values, pose in ((right, camera.cam_from_world), (wrong, np.linalg.inv(camera.cam_from_world))):
                drawn = rasterize_mesh(scene.meshes[0], replace(camera, cam_from_world=pose)).mask
                values.append(overlap(drawn, mask))
        figures[layout] = {"least": round(min(right), 4), "with the pose inverted, most": round(max(wrong), 4)}
    return figures


def rays(root: Path) -> dict[str, float]:
    """Directions (unit vectors) and origins (metres) through cameras.json and calibration.csv."""
    directions, origins = [], []
    for layout in ("simple", "actorshq"):
        for camera in open_capture(root, format=layout).cameras.values():
            x, y = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
            plane = np.linalg.solve(camera.K, np.stack([x, y, np.ones_like(x)]).reshape(3, -1))
            rays_ = camera.cam_from_world[:3, :3].T @ plane
            directions.append(rays_ / np.linalg.norm(rays_, axis=0))
            origins.append(camera.position)
    half = len(origins) // 2
    difference = [np.abs(np.subtract(v[:half], v[half:])).max() for v in (directions, origins)]
    return {"direction": float(difference[0]), "origin, m": float(difference[1])}


if __name__ == "__main__":
    sys.exit(main())
