"""What codes are worth: a student's null code, the trained code of a frame, and a code fitted to that frame offline.

    python -m benchmarks.frame_codes --run RUN --capture DIR [--frames 3] [--steps 40] [--no-store]

A code is fitted to photographs of the cameras that training saw, everything else of the student standing still, and
measured in the held-out cameras: for frames of the training, whose own code is left aside, and for held-out ones, where
it is what driving offline could come to at best, as no driver knows photographs. Loose clothes are where the field has
them. PSNR of the person, dB.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Annotated

import torch
import tyro

from avatar.data.sequence import AvatarSequence, MeasuredView
from avatar.losses.reconstruction import ReconstructionWeights, Target, reconstruction_loss
from avatar.metrics.view_quality import view_quality
from avatar.models.model_file import load_avatar
from avatar.models.student import Student
from avatar.render.avatar_view import render_view
from avatar.rig.rig import Motion
from benchmarks.machine import store_results
from smplxpp.capture import open_capture
from smplxpp.template.template import Template

WEIGHTS = ReconstructionWeights(perceptual=0.0, normal=0.0, alpha=0.1)
RATE, CAMERAS = 0.05, 4


@dataclass(frozen=True)
class FrameCodesBenchmark:
    """Measure all codes."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run."""
    capture: Path
    """Folder of its capture."""
    frames: int = 3
    """Frames of each kind."""
    steps: int = 40
    """Steps of Adam a code."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        template = Template.load(self.run_folder / "60_assemble" / "smplxpp.npz")
        sequence = AvatarSequence(open_capture(self.capture), template)
        student = load_avatar(self.run_folder / "90_compensate" / "student.safetensors", sequence.rig)
        assert isinstance(student, Student) and student.codes is not None
        student.requires_grad_(False)
        by_frame: dict[tuple[str, int], list[MeasuredView]] = {}
        for item in sequence.measured_views(self.frames):
            by_frame.setdefault((item.kind, item.frame), []).append(item)
        rows: dict[str, dict[str, list[float]]] = {"novel_view": {}, "novel_pose": {}}
        for (kind, frame), items in by_frame.items():
            for name, psnr in measure(student, sequence, frame, items, self.steps).items():
                rows[kind].setdefault(name, []).append(psnr)
            print(kind, frame, {name: round(values[-1], 3) for name, values in rows[kind].items()}, flush=True)
        figures = {
            kind: {name: {"mean": mean(values), "frames": values} for name, values in of_kind.items()}
            for kind, of_kind in rows.items()
        }
        print(json.dumps(figures, indent=1))
        if self.store:
            command = f"python -m benchmarks.frame_codes --run {self.run_folder.name} --capture {self.capture.name}"
            store_results(
                f"frame_codes_{self.capture.name}", f"{command} --frames {self.frames} --steps {self.steps}", figures
            )


def measure(
    student: Student, sequence: AvatarSequence, frame: int, items: list[MeasuredView], steps: int
) -> dict[str, float]:
    """Return the mean decibels of a frame's held-out views by code."""
    plain = sequence.rig.motion(sequence.params(frame))
    out = {"null code": quality(student, plain, items, sequence)}
    if frame in student.frames:
        out["trained code"] = quality(student, replace(plain, frame=frame), items, sequence)
    assert student.codes is not None
    slot = student.frames[0]
    # The slot's frame is one that training saw; this pose counts as what it is.
    known = 1.0 if student.pose_gate is None else float(student.pose_gate(plain.pose))
    fitted = replace(plain, frame=slot, known=known)
    kept = student.codes.codes.detach().clone()
    student.codes.codes = torch.nn.Parameter(kept.clone())
    with torch.no_grad():
        student.codes.codes[0] = student.codes([None])[0]
    fit(student, fitted, sequence, frame, steps)
    out["fitted code"] = quality(student, fitted, items, sequence)
    out["length of the fitted code"] = float(student.codes.codes[0].detach().norm())
    student.codes.codes = torch.nn.Parameter(kept, requires_grad=False)
    return out


def fit(student: Student, motion: Motion, sequence: AvatarSequence, frame: int, steps: int) -> None:
    """Fit the code in the first row to the frame's photographs."""
    assert student.codes is not None
    codes = student.codes.codes
    optimiser = torch.optim.Adam([codes], lr=RATE)
    chosen = sequence.train_cameras[:: max(1, len(sequence.train_cameras) // CAMERAS)]
    views = [sequence.view(name, frame) for name in chosen]
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = RATE * (1.0 - step / steps)
        view = views[step % len(views)]
        posed = student(motion, view.position[None])
        rendering = render_view(posed, 0, view, sequence.background)
        target = Target(view.composited(sequence.background), view.opacity())
        loss = reconstruction_loss(rendering, target, WEIGHTS)[0]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


@torch.no_grad()
def quality(student: Student, motion: Motion, items: list[MeasuredView], sequence: AvatarSequence) -> float:
    """Return the mean PSNR of the person over views."""
    values = []
    for item in items:
        posed = student(motion, item.view.position[None])
        rendering = render_view(posed, 0, item.view, sequence.background)
        figures = view_quality(item.view, rendering.image, rendering.alpha, sequence.background, head=None)
        values.append(figures.psnr)
    return mean(values)


if __name__ == "__main__":
    tyro.cli(FrameCodesBenchmark).run()
