"""Splats in other programs' files: bytes, and decibels of what foreign readers get, against the player's picture.

    python -m benchmarks.exports --source ME.avatar [--frame 3] [--pictures DIR]

Each file is written by `smplxpp export`, read by a program that is not ours (`tests.formats.foreign`) and drawn by our
rasteriser in three views 640 pixels high. PSNR is over the pixels that the person covers, of the worst view.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from avatar.formats import Splats
from avatar.runtime import AvatarPlayer
from avatar.runtime.splatting import Splatter
from pipelines.commands.export import Export
from pipelines.figures import VIEWS, fit_cameras
from tests.formats.foreign import as_world, gsply_splats, pygltflib_splats, usd_splats

READERS: dict[str, Callable[[Path], Splats]] = {
    "a.ply": gsply_splats,
    "full.ply": gsply_splats,
    "a.spz": gsply_splats,
    "a.sog": gsply_splats,
    "a.glb": pygltflib_splats,
    "a.usdc": usd_splats,
}
_WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class ExportsBenchmark:
    """Measure all formats of splats."""

    source: Path
    """Bundle of an avatar."""
    frame: int = 0
    """Of its motion."""
    pictures: Path | None = None
    """Folder for the front views."""

    def run(self) -> None:
        """Print a row a format."""
        player = AvatarPlayer(self.source)
        assert player.motion is not None
        posed = player.pose(player.motion.frame(self.frame))
        views = [VIEWS[name] for name in ("front", "back", "three-quarter")]
        cameras = fit_cameras(posed.means.astype(float), directions=views, height=640)
        truth = [tuple(map(np.copy, player.draw(camera, background=_WHITE))) for camera in cameras]
        print(f"{len(posed.means)} splats, harmonics of {posed.sh.shape[1]} coefficients")
        with tempfile.TemporaryDirectory() as folder:
            for name, read in READERS.items():
                path = Path(folder) / name
                Export(self.source, out=path, frame=self.frame, full_harmonics=name.startswith("full"), json=True).run()
                drawn = [Splatter().draw(as_world(read(path)), camera, background=_WHITE)[0] for camera in cameras]
                pairs = zip(truth, drawn, strict=True)
                worst = min(_psnr(image, other, alpha) for (image, alpha), other in pairs)
                print(f"{name:9} {path.stat().st_size / 1e6:7.2f} MB  {worst:6.1f} dB", flush=True)
                if self.pictures is not None:
                    self.pictures.mkdir(parents=True, exist_ok=True)
                    shown = np.clip(np.hstack([truth[0][0], drawn[0]]), 0.0, 1.0)
                    Image.fromarray((255 * shown).astype(np.uint8)).save(self.pictures / f"{name}.png")


def _psnr(image: np.ndarray, other: np.ndarray, alpha: np.ndarray) -> float:
    """PSNR where the person is."""
    difference = np.clip(image, 0.0, 1.0) - np.clip(other, 0.0, 1.0)
    return float(-10.0 * np.log10(max(np.square(difference[alpha > 1 / 255]).mean(), 1e-20)))


if __name__ == "__main__":
    tyro.cli(ExportsBenchmark).run()
