"""Measure splats in files of other programs: bytes, and decibels of what foreign readers get.

    python -m benchmarks exports --source ME.avatar [--frame 3] [--pictures DIR]

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
from avatar.formats.webavatar import typical_pose
from avatar.runtime import AvatarPlayer
from avatar.runtime.skeleton import skeleton_body
from avatar.runtime.splatting import Splatter
from pipelines.commands.export import Export
from pipelines.figures import VIEWS, fit_cameras
from smplxpp.body import load_params
from smplxpp.core.spread import spread
from tests.formats.foreign import as_world, gsply_splats, pygltflib_splats, usd_splats, webavatar_splats

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
    """Frame of its motion."""
    params: Path | None = None
    """Motion for WebAvatar's npz; by default the bundle's."""
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
            self._webavatar(player, Path(folder) / "a.npz")
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

    def _webavatar(self, player: AvatarPlayer, path: Path) -> None:
        """Print a row a pose of WebAvatar's npz: where it is the student, and along the motion."""
        Export(self.source, out=path, format="webavatar", json=True).run()
        motion = player.motion if self.params is None else load_params(self.params)
        assert motion is not None
        poses = {"best": typical_pose(player)} | {str(k): motion.frame(k) for k in spread(range(len(motion)), 5)}
        for name, params in poses.items():
            posed = player.pose(params)
            camera = fit_cameras(posed.means.astype(float), directions=[VIEWS["front"]], height=640)[0]
            image, alpha = player.draw(camera, background=_WHITE)
            angles = skeleton_body(player.bundle).axis_angles(params)[0]
            splats = webavatar_splats(path, angles, params.transl[0])
            away = 1e3 * np.linalg.norm(splats.means - posed.means, axis=1)
            other = Splatter().draw(as_world(splats), camera, background=_WHITE)[0]
            psnr, (half, most) = _psnr(image, other, alpha), np.percentile(away, [50, 100])
            print(f"webavatar {name:4} {path.stat().st_size / 1e6:5.2f} MB  {psnr:6.1f} dB  {half:.1f}, {most:.1f} mm")


def _psnr(image: np.ndarray, other: np.ndarray, alpha: np.ndarray) -> float:
    """PSNR where the person is."""
    difference = np.clip(image, 0.0, 1.0) - np.clip(other, 0.0, 1.0)
    return float(-10.0 * np.log10(max(np.square(difference[alpha > 1 / 255]).mean(), 1e-20)))


if __name__ == "__main__":
    tyro.cli(ExportsBenchmark).run()
