"""How much of swinging cloth a pose can tell: predictors fitted to a followed surface, measured on held-out frames.

    python -m benchmarks.cloth_from_pose --run RUN --capture DIR

The surface that the teacher of RUN followed through the training frames is predicted from poses by ridge regression
and by Gaussian kernels, from more or fewer joints, without and with the poses of the last frames. Settings are chosen
on the held-out frames themselves: the figures are the best that predictors of that kind can show.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Annotated

import torch
import tyro
from torch import Tensor

from avatar.data.sequence import AvatarSequence
from avatar.metrics.surface_quality import surface_quality
from avatar.models.model_file import load_avatar
from avatar.models.student import Student
from benchmarks.machine import store_results
from smplxpp.capture import open_capture
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.template.template import Template

JOINTS = {"hips": (1, 2), "legs and spine": (1, 2, 3, 4, 5, 6), "all joints": tuple(range(1, 22))}
LAGS = {"now": (0,), "last third of a second": (0, 2, 4, 7)}
"""Frames back; those of 20 a second."""
RIDGES, KERNELS = (0.01, 0.03, 0.1, 0.3, 1.0), ((0.4, 0.1), (0.8, 0.1), (0.8, 0.5), (1.6, 0.1))
"""Regularisation; and width in radians with regularisation."""
SAMPLES = 20_000


@dataclass(frozen=True)
class ClothFromPose:
    """Fit and measure predictors."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run whose teacher followed the surface."""
    capture: Path
    """Folder of its capture, with true surfaces of held-out frames."""
    label: str = "lower"
    """Of the cloth."""
    every: int = 2
    """Every n-th held-out frame is measured."""

    def run(self) -> None:
        """Print and store the best of each kind."""
        scene = _Scene(self.run_folder, self.capture, self.label, self.every)
        figures: dict[str, object] = {"skinning alone": scene.distance({}), "frames": list(scene.held_out)}
        for joints, lags in ((a, b) for a in JOINTS for b in LAGS):
            found = {name: scene.distance(predicted) for name, predicted in scene.predictions(joints, lags)}
            best = min(found, key=found.get)
            figures[f"{joints}, {lags}"] = {"p2s_mm": found[best], "predictor": best}
        student = load_avatar(self.run_folder / "90_compensate" / "student.safetensors", scene.rig)
        figures["student"] = scene.distance(scene.of_student(student))
        for name, found in figures.items():
            print(f"{name:48s} {found}")
        command = "python -m benchmarks.cloth_from_pose --run RUN --capture DIR"
        path = store_results(f"cloth_from_pose_{scene.capture.name}", command, figures)
        print(f"stored {path.name}")


class _Scene:
    def __init__(self, run: Path, capture: Path, label: str, every: int) -> None:
        self.capture, self.label = open_capture(capture), label
        self.sequence = AvatarSequence(self.capture, Template.load(run / "60_assemble" / "smplxpp.npz"))
        self.rig = self.sequence.rig
        teacher = load_avatar(run / "80_teacher" / "teacher.safetensors", self.rig)
        if teacher.track is None:
            raise InputError(
                "teacher",
                expected="one that followed the surface first",
                received="no followed surface",
                remedy="train with the preset cpu or demo",
            )
        frames = self.capture.splits.novel_pose_frames[::every]
        meshes = {frame: self.capture.truth_mesh(frame) for frame in frames}
        self.held_out = {frame: mesh for frame, mesh in meshes.items() if mesh is not None}
        self.track, self.trained = teacher.track, list(self.sequence.train_frames)
        if not self.held_out:
            raise InputError("capture", expected="true surfaces of held-out frames", received="none")
        self.poses = {frame: self.sequence.motion(frame).pose for frame in self.capture.frames}

    def distance(self, predicted: dict[int, Tensor]) -> float:
        """Mean P2S of the cloth in mm, with (V, 3) displacements by frame."""
        labels, faces = self.rig.template.vertex_labels, self.rig.faces.numpy()
        distances = []
        for frame, truth in self.held_out.items():
            posed = self.rig.pose(self.sequence.motion(frame), predicted.get(frame)).double().numpy()
            found = surface_quality(TriangleMesh(posed, faces), labels, truth, samples=SAMPLES)
            distances.append(found.labels[self.label].p2s)
        return round(mean(distances), 2)

    def predictions(self, joints: str, lags: str) -> Iterator[tuple[str, dict[int, Tensor]]]:
        """Displacements of the held-out frames by every predictor of a kind."""
        features = {frame: self._features(frame, JOINTS[joints], LAGS[lags]) for frame in self.poses}
        x = torch.stack([features[frame] for frame in self.trained])
        known = torch.stack([self.track.controls[self.track.row[frame]] for frame in self.trained]).flatten(1)
        center, level = x.mean(0), known.mean(0)
        x, y = x - center, known - level
        asked = torch.stack([features[frame] - center for frame in self.held_out])
        identity = torch.eye(len(x))
        for ridge in RIDGES:
            coefficients = torch.linalg.solve(x @ x.T + ridge * identity, y)
            yield f"ridge {ridge:g}", self._spread(asked @ x.T @ coefficients + level)
        for width, ridge in KERNELS:
            coefficients = torch.linalg.solve(_kernel(x, x, width) + ridge * identity, y)
            yield f"kernel {width:g}, {ridge:g}", self._spread(_kernel(asked, x, width) @ coefficients + level)

    def of_student(self, student: Student) -> dict[int, Tensor]:
        """The same of a student's field."""
        with torch.no_grad():
            return {frame: student.displacements(self.sequence.motion(frame)) for frame in self.held_out}

    def _features(self, frame: int, joints: tuple[int, ...], lags: tuple[int, ...]) -> Tensor:
        first = min(self.poses)
        poses = [self.poses[max(first, frame - lag)].view(-1, 3)[[joint - 1 for joint in joints]] for lag in lags]
        return torch.stack(poses).flatten()

    def _spread(self, predicted: Tensor) -> dict[int, Tensor]:
        controls = predicted.unflatten(1, (-1, 3))
        return {frame: self.track.cage(each) for frame, each in zip(self.held_out, controls, strict=True)}


def _kernel(a: Tensor, b: Tensor, width: float) -> Tensor:
    return torch.exp(-torch.cdist(a, b).square() / (2.0 * width**2))


if __name__ == "__main__":
    tyro.cli(ClothFromPose, prog="python -m benchmarks.cloth_from_pose").run()
