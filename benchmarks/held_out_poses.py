"""Why a student gains or loses in poses that training did not show: other surfaces in its field's place, part by part.

    python -m benchmarks.held_out_poses --run RUN --capture DIR

The student of RUN draws held-out frames of its capture with its own field, with a field that learned the followed
surface anew at the rate of `benchmarks.motion_predictors`, on skinning, and on the true surface; Gaussians trained on
skinning draw them beside it, where the RUN's ablation has them. The truth is for measuring, and for its own row.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor

from avatar.data.sequence import camera_centers_of
from avatar.losses.psnr import psnr_from_mse
from avatar.metrics.view_quality import view_quality
from avatar.models.model_file import load_avatar
from avatar.models.student import Student
from avatar.render.avatar_view import render_view
from avatar.rig.rig import Motion
from benchmarks.machine import store_results
from benchmarks.motion_codes import Bench, Displacements
from benchmarks.motion_predictors import LearnConfig
from pipelines.runs.layout import STUDENT
from smplxpp.segment.labels import find_label_set

OWN = "student"


@dataclass(frozen=True)
class HeldOutPoses:
    """Draw, measure, store."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run whose teacher followed the surface."""
    capture: Path
    """Folder of its capture, with true surfaces whose vertices are the same points in all frames."""
    cameras: tuple[str, ...]
    """That look."""
    every: int = 2
    """Every n-th of the held-out frames with a true surface."""
    learn: LearnConfig = field(default_factory=LearnConfig)
    pictures: Path | None = None
    """Folder for the pictures of the frame in which the student is worst: photograph, then row by row."""
    name: str = ""
    """Of the stored file; by default that of the capture."""

    @torch.no_grad()
    def run(self) -> None:
        """Print and store all rows."""
        bench = Bench(self.run_folder, self.capture, self.learn)
        frames = bench.held_out[:: self.every]
        found: dict[str, list[dict[str, float]]] = {}
        seen: dict[tuple[str, str, int], Tensor] = {}
        for name, model, surface in _rows(bench, frames):
            found[name] = []
            for frame in frames:
                motion = _moved(bench.sequence.motion(frame).without_cloth(), surface.get(frame))
                for camera in self.cameras:
                    figures, seen[name, camera, frame] = _drawn(bench, model, motion, camera, frame)
                    found[name].append(figures)
            print(name, _means(found[name]), flush=True)
        figures = {"held-out frames": len(frames), "cameras": list(self.cameras), "protocol": bench.protocol}
        figures["rows"] = {name: _means(rows) for name, rows in found.items()}
        if self.pictures is not None:
            worst = frames[int(np.argmin([row["PSNR"] for row in found[OWN][:: len(self.cameras)]]))]
            view = bench.sequence.whole_view(self.cameras[0], worst).composited(bench.sequence.background)
            strip = torch.cat([view, *(seen[name, self.cameras[0], worst] for name in found)], dim=1)
            Image.fromarray((255 * strip.clamp(0, 1)).byte().numpy()).save(self.pictures / f"frame_{worst:06d}.png")
        command = f"python -m benchmarks.held_out_poses --run RUN --capture DIR --cameras {' '.join(self.cameras)}"
        path = store_results(f"held_out_poses_{self.name or bench.sequence.capture.name}", command, figures)
        print(f"stored {path.name}")


def _rows(bench: Bench, frames: list[int]) -> Iterator[tuple[str, Student, Displacements]]:
    """Name, student without a field, and the surfaces on which it draws."""
    student = load_avatar(bench.folder / STUDENT, bench.rig).eval()
    own = {frame: student.displacements(bench.sequence.motion(frame).without_code()) for frame in frames}
    with torch.enable_grad():
        anew = bench.field("pose", bench.followed, list(bench.followed), frames)
    student.field = None
    yield OWN, student, own
    yield "its Gaussians, field learned anew", student, anew
    yield "its Gaussians on skinning", student, {}
    yield "its Gaussians on the true surface", student, {f: bench.track.cage(c) for f, c in bench.true(frames).items()}
    path = bench.folder / "ablation" / "lbs" / "student.safetensors"
    if path.is_file():
        yield "LBS Gaussians", load_avatar(path, bench.rig).eval(), {}


def _moved(motion: Motion, displacements: Tensor | None) -> Motion:
    return motion if displacements is None else replace(motion, rest=motion.rest + displacements)


def _drawn(bench: Bench, model: Student, motion: Motion, camera: str, frame: int) -> tuple[dict[str, float], Tensor]:
    """PSNR of the person and of each label's pixels, and the picture."""
    view, background = bench.sequence.whole_view(camera, frame), bench.sequence.background
    drawn = render_view(model(motion, camera_centers_of([view])), 0, view, background)
    image = drawn.image.clamp(0, 1)
    figures = {"PSNR": view_quality(view, image, drawn.alpha, background, head=None).psnr}
    wrong = (image - view.composited(background)).square().mean(-1).numpy()
    labels = bench.capture.labels(camera, frame)
    for number, name, ours in find_label_set(bench.capture.label_set).classes if labels is not None else ():
        if ours != "background" and (labels == number).sum() > 200:
            figures[name] = psnr_from_mse(float(wrong[labels == number].mean()))
    return figures, image


def _means(rows: list[dict[str, float]]) -> dict[str, Any]:
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: round(float(np.mean([row[name] for row in rows if name in row])), 2) for name in names}


if __name__ == "__main__":
    tyro.cli(HeldOutPoses, prog="python -m benchmarks.held_out_poses").run()
