"""`smplxpp synth`: a synthetic capture with moving cloth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from pipelines.synth.make_capture import SynthConfig, make_capture
from smplxpp.core.errors import InputError

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"


@dataclass(frozen=True)
class Synth:
    """Options of the command."""

    out: Path
    """Folder to write; it must not exist, or be empty."""
    cameras: int = 12
    """How many; from four on two of them are close-ups of the face, and some of the others are held out."""
    frames: int = 24
    """Length of the performance; the last fifth of the frames is held out."""
    size: int = 640
    """Height of body images in pixels; they are 4/5 as wide, close-ups are square and 3/4 as high."""
    seed: int = 0
    """Seed of the performance, the cameras and all noise."""
    fps: float = 10.0
    """Frames a second."""
    layout: Literal["simple", "actorshq"] = "simple"
    """Ours with everything, or images, masks and cameras in ActorsHQ's folders."""
    quality: int = 95
    """Quality of JPEG images."""
    truth_step: int = 1
    """Truth meshes of every n-th frame."""
    normals_step: int = 1
    """Normal maps of every n-th frame."""
    scan_faces: int = 80_000
    """Size of the reference frame's scan; 0 makes none."""
    person: Path = FIXTURE
    """The person's folder, with geometry/topology.npz."""
    json: bool = False
    """Print the figures as JSON."""

    def run(self) -> dict:
        """Make the capture; returns the figures about it."""
        if self.out.exists() and (not self.out.is_dir() or any(self.out.iterdir())):
            raise InputError(
                "--out",
                expected="a new or an empty folder",
                received=str(self.out),
                remedy="name another, or delete it",
            )
        config = SynthConfig(
            cameras=self.cameras,
            frames=self.frames,
            size=self.size,
            seed=self.seed,
            fps=self.fps,
            layout=self.layout,
            quality=self.quality,
            truth_step=self.truth_step,
            normals_step=self.normals_step,
            scan_faces=self.scan_faces,
        )
        console = Console(stderr=True)
        columns = (TextColumn("{task.description:<8}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console) as bars:
            tasks: dict[str, TaskID] = {}

            def show(what: str, share: float) -> None:
                if what not in tasks:
                    tasks[what] = bars.add_task(what, total=1.0)
                bars.update(tasks[what], completed=share)

            checks = make_capture(self.out, self.person / "geometry" / "topology.npz", config, progress=show)
        console.print(
            f"{self.out}: {config.cameras} cameras, {config.frames} frames",
            highlight=False,
            soft_wrap=True,
            markup=False,
        )
        return {"out": str(self.out), "cameras": config.cameras, "frames": config.frames, "checks": checks}
