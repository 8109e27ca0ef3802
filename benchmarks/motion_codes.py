"""What can be learned of a surface from motion: poses, their past, latents with dynamics, beside simulated cloth.

    python -m benchmarks.motion_codes --run RUN --capture DIR

Predictors learn the surface that the teacher of RUN followed through its training frames, and are asked about frames
that they did not see: the capture's held-out ones, and blocks of training frames, each left out once. Measured are
points of the template, each against where it truly is. The truth is for measuring alone, but for rows that say that
they learned from it: these show what the followed surface takes away.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from typing import Annotated, Any, get_args

import numpy as np
import torch
import tyro
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.data.cloth_motion import ClothMotions
from avatar.data.sequence import AvatarSequence
from avatar.metrics.surface_quality import mean_surface, surface_quality
from avatar.models.model_file import load_avatar
from avatar.models.networks.local_pose import joint_steps, seen_joints
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.training.student.regress_poses import fit_pose_regression
from benchmarks.followed_surface import SamePoints
from benchmarks.machine import store_results
from benchmarks.motion_predictors import Drive, LearnConfig, MotionFeatures, Predictor, learn, ridge
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import STUDENT
from pipelines.stages.cloth import followed_particles
from pipelines.stages.scene import TrainInputs, open_scene
from smplxpp.cloth import Garment, cut_garment
from smplxpp.cloth.calibrate import calibrate
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.spread import spread

SAMPLES = 20_000
RIDGES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
Displacements = dict[int, Tensor]
"""(V, 3) by frame, metres along the axes of the T-pose."""


@dataclass(frozen=True)
class MotionCodes:
    """Learn, measure, store."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run whose teacher followed the surface."""
    capture: Path
    """Folder of its capture, with true surfaces whose vertices are the same points in all frames."""
    loose: tuple[str, ...] = ()
    """Parts that are simulated, beside; fitted to the followed surface."""
    surface_frames: int = 8
    """Held-out frames on which P2S is measured."""
    blocks: int = 4
    """Of training frames, each left out once; 0: none is."""
    learn: LearnConfig = field(default_factory=LearnConfig)
    from_truth: bool = True
    """Rows that learn from the truth too."""
    name: str = ""
    """Of the stored file; by default that of the capture."""

    def run(self) -> None:
        """Print and store all rows."""
        bench = Bench(self.run_folder, self.capture, self.learn)
        held_out, folds = bench.held_out, bench.folds(self.blocks)
        figures: dict[str, Any] = {
            "protocol": bench.protocol,
            "learned from": f"{len(bench.followed)} followed frames",
            "held-out frames": len(held_out),
            "blocks": f"{len(folds)} of {len(folds[0][1]) if folds else 0} frames with a true surface",
            "followed surface in its own frames": bench.measured(bench.of_track(), list(bench.followed)),
            "skinning in the same frames": bench.measured({}, list(bench.followed)),
            "rows": {},
        }
        for name, predict in bench.rows(self.loose, from_truth=self.from_truth):
            begin = time.process_time()
            row = bench.measured(predict(list(bench.followed), held_out), held_out, surface=self.surface_frames)
            seconds = time.process_time() - begin
            if not name.startswith(("student", "learned from the truth")):
                apart = [bench.measured(predict(train, test), test) for train, test in folds]
                row |= {f"{key}, left out": [one[key] for one in apart] for key in (apart[0] if apart else ())}
            figures["rows"][name] = {**row, "seconds": round(seconds, 1)}
            print(f"{name:44s} {figures['rows'][name]}", flush=True)
        command = "python -m benchmarks.motion_codes --run RUN --capture DIR"
        path = store_results(f"motion_codes_{self.name or bench.sequence.capture.name}", command, figures)
        print(f"stored {path.name}")


Predict = Callable[[Sequence[int], Sequence[int]], Displacements]


class Bench:
    """A run's scene, and what is known of it.

    Args:
        run: with a teacher. folder: of the capture. config: how predictors learn.
    """

    def __init__(self, run: Path, folder: Path, config: LearnConfig) -> None:
        scene = open_scene(run, TrainInputs(folder))
        self.capture, self.config, self.folder = scene.capture, config, run
        self.sequence = AvatarSequence(scene.capture, scene.template)
        self.rig, self.protocol = self.sequence.rig, scene.capture.protocol or "exact"
        teacher = load_avatar(run / "80_teacher" / "teacher.safetensors", self.rig)
        if not isinstance(teacher, TeacherAvatar) or teacher.track is None or scene.capture.fps is None:
            raise InputError(
                "run",
                expected="a teacher that followed the surface, frames a second",
                received="one of them is missing",
            )
        self.track = teacher.track
        self.reference = load_params_of_run(run).frame(0)
        self.same = {
            part: SamePoints.found(scene, self.reference, part) for part in scene.template.part_names if part != "body"
        }
        frames = list(scene.capture.frames)
        self.first, self.fps = frames[0], scene.capture.fps
        poses = BodyParams.concatenate([self.sequence.params(frame).without_shape() for frame in frames])
        self.features = MotionFeatures(poses, self.fps)
        self.followed = {frame: self.track.controls[self.track.row[frame]] for frame in sorted(self.track.row)}
        self.held_out = [f for f in scene.capture.splits.novel_pose_frames if self._truth(f) is not None]
        steps = torch.tensor(seen_joints(scene.template, 3))
        self._at_controls = (
            self.rig.vertices[self.track.cage.vertices],
            self.rig.cloth_mask[self.track.cage.vertices],
            steps[self.track.cage.vertices],
        )

    def folds(self, blocks: int) -> list[tuple[list[int], list[int]]]:
        """Frames to learn from and frames to ask about, for each block of followed frames that is left out."""
        out = []
        for block in np.array_split(np.array(list(self.followed)), blocks) if blocks else ():
            test = [frame for frame in block.tolist() if self._truth(frame) is not None]
            out.append(([frame for frame in self.followed if frame not in set(block.tolist())], test))
        return out

    def of_track(self) -> Displacements:
        """The followed surface itself."""
        return {frame: self.track.cage(controls) for frame, controls in self.followed.items()}

    def rows(self, loose: Sequence[str], *, from_truth: bool) -> Iterator[tuple[str, Predict]]:
        """Name and predictor of each row."""
        yield "skinning", lambda train, test: {}
        yield "mean of the training frames", self._mean
        yield "ridge, pose", lambda train, test: self._ridge(self.features.pose, train, test)
        yield "ridge, history", lambda train, test: self._ridge(self.features.history, train, test)
        yield "the students' regression", lambda train, test: self._regression(self.followed, train, test)
        for drive in get_args(Drive):
            yield f"field, {drive}", lambda train, test, drive=drive: self.field(drive, self.followed, train, test)
        yield "student's field", self._student
        if loose:
            motions = self._simulated(loose)
            yield f"simulated: {' '.join(loose)}", lambda train, test: self._with_cloth(motions, {}, test)
            yield (
                f"simulated: {' '.join(loose)}; the rest: field, pose",
                lambda train, test: self._with_cloth(motions, self.field("pose", self.followed, train, test), test),
            )
        if from_truth:
            yield (
                "learned from the truth: ridge, pose",
                lambda train, test: self._ridge(self.features.pose, train, test, self.true(train)),
            )
            yield (
                "learned from the truth: the students' regression",
                lambda train, test: self._regression(self.true(train), train, test),
            )
            for drive in get_args(Drive):
                yield (
                    f"learned from the truth: field, {drive}",
                    lambda train, test, drive=drive: self.field(drive, self.true(train), train, test),
                )

    def measured(self, found: Displacements, frames: Sequence[int], *, surface: int = 0) -> dict[str, Any]:
        """Mean distance of each part's points to their places, mm; on `surface` of the frames P2S too."""
        apart: dict[str, list[float]] = {part: [] for part in self.same}
        surfaces, template = [], self.rig.template
        for frame in frames:
            truth = self._truth(frame)
            if truth is None:
                continue
            vertices = self.rig.places(self.sequence.motion(frame).without_cloth(), found.get(frame))
            for part, same in self.same.items():
                wrong = np.linalg.norm(vertices[same.own] - same.of(truth), axis=1)
                apart[part].append(1e3 * float(wrong.mean()))
            if frame in spread(frames, surface):
                mesh = TriangleMesh(vertices, template.faces)
                surfaces.append(surface_quality(mesh, template.vertex_labels, truth, samples=SAMPLES))
        out: dict[str, Any] = {part: round(mean(values), 2) for part, values in apart.items()}
        if surfaces:
            whole = mean_surface(surfaces)
            out["P2S"] = round(whole.p2s, 2)
            out |= {f"P2S {name}": round(q.p2s, 2) for name, q in whole.labels.items() if q.p2s is not None}
        return out

    def _truth(self, frame: int) -> TriangleMesh | None:
        return self.capture.truth_mesh(frame)

    def _row(self, frame: int) -> int:
        return frame - self.first

    def _spread(self, controls: Tensor, test: Sequence[int]) -> Displacements:
        return {frame: self.track.cage(each) for frame, each in zip(test, controls, strict=True)}

    def _mean(self, train: Sequence[int], test: Sequence[int]) -> Displacements:
        level = torch.stack([self.followed[frame] for frame in train]).mean(0)
        return self._spread(level.expand(len(test), -1, -1), test)

    def _ridge(
        self,
        features: Tensor,
        train: Sequence[int],
        test: Sequence[int],
        known: Mapping[int, Tensor] | None = None,
    ) -> Displacements:
        """Ridge regression on `known`, else on what was followed; its amount leaves blocks of frames out."""
        known = self.followed if known is None else known
        x, y = (
            features[[self._row(frame) for frame in train]],
            torch.stack([known[frame] for frame in train]).flatten(1),
        )
        wrong = dict.fromkeys(RIDGES, 0.0)
        for block in np.array_split(np.arange(len(train)), 5):
            kept = np.setdiff1d(np.arange(len(train)), block)
            for amount in RIDGES:
                wrong[amount] += float((ridge(x[kept], y[kept], x[block], amount) - y[block]).square().sum())
        best = min(wrong, key=lambda amount: wrong[amount])
        found = ridge(x, y, features[[self._row(frame) for frame in test]], best)
        return self._spread(found.unflatten(1, (-1, 3)), test)

    def _regression(self, known: Mapping[int, Tensor], train: Sequence[int], test: Sequence[int]) -> Displacements:
        """What students show in new poses (`fit_pose_regression`), of the surfaces `known`."""
        at, template = self.track.cage.vertices.numpy(), self.rig.template
        regression, _ = fit_pose_regression(
            self.features.pose[[self._row(frame) for frame in train]].numpy(),
            torch.stack([known[frame] for frame in train]).numpy(),
            template.vertices[at],
            joint_steps(template)[at],
            template.vertex_labels[at],
        )
        return self._spread(regression(self.features.pose[[self._row(frame) for frame in test]]), test)

    def field(
        self, drive: Drive, known: Mapping[int, Tensor], train: Sequence[int], test: Sequence[int]
    ) -> Displacements:
        """What a field with a drive, which learned `known` of the frames `train`, says of the frames `test`."""
        torch.manual_seed(self.config.seed)
        rows = [self._row(frame) for frame in train]
        predictor = Predictor(drive, *self._at_controls, self.features, rows)
        learn(predictor, {self._row(frame): known[frame] for frame in train}, self.config)

        with torch.no_grad():
            found = predictor([self._row(frame) for frame in test], [False] * len(test))
        return self._spread(found, test)

    def _student(self, train: Sequence[int], test: Sequence[int]) -> Displacements:
        student = load_avatar(self.folder / STUDENT, self.rig)
        with torch.no_grad():
            return {frame: student.displacements(self.sequence.motion(frame).without_code()) for frame in test}

    def _simulated(self, loose: Sequence[str]) -> ClothMotions:
        """The parts, fitted to all followed frames, along the whole motion from its first frame."""
        garments: list[Garment] = []
        for part in loose:
            garment = cut_garment(self.rig.template, part, self.reference.without_shape())
            followed = followed_particles(self.sequence, self.track, garment, self.fps)
            fitted, found = calibrate(self.rig.template, garment, followed)
            print(f"    {found}", flush=True)
            garments.append(fitted)
        motions = ClothMotions(
            self.rig.template, garments, params=self.capture.params, frames=self.capture.frames, fps=self.fps
        )
        motions.simulate(list(self.capture.frames))
        return motions

    def _with_cloth(self, motions: ClothMotions, rest: Displacements, test: Sequence[int]) -> Displacements:
        plain = {frame: self.sequence.motion(frame).without_cloth() for frame in test}
        clothed = {frame: self.rig.with_cloth(plain[frame], motions.shape(frame)) for frame in test}
        return {frame: self.rig.displaced(clothed[frame], rest.get(frame)) for frame in test}

    def true(self, frames: Sequence[int]) -> Mapping[int, Tensor]:
        """Displacements that put the control points where they truly are; those whose place is not known move as the
        nearest one of their part that is."""
        control = self.track.cage.vertices
        nearest = self._nearest_known()
        out = {}
        for frame in frames:
            motion, truth = self.sequence.motion(frame), self._truth(frame)
            if truth is None:
                raise InputError("capture", expected=f"a true surface of frame {frame}", received="none")
            moved = torch.zeros(len(self.rig.vertices), 3)
            for same in self.same.values():
                turn, way = motion.world_from_rest[same.own, :, :3], motion.world_from_rest[same.own, :, 3]
                place = torch.tensor(same.of(truth), dtype=torch.float32)
                moved[same.own] = torch.linalg.solve(turn, place - way) - motion.rest[same.own]
            out[frame] = moved[nearest][control]
        return out

    def _nearest_known(self) -> np.ndarray:
        """(V,) of each vertex the nearest one of its part in the T-pose whose true place is known, else itself."""
        template = self.rig.template
        found = np.arange(len(template.vertices))
        for part, same in self.same.items():
            of_part = np.flatnonzero(template.vertex_part == template.part_names.index(part))
            if len(same.own):
                found[of_part] = same.own[cKDTree(template.vertices[same.own]).query(template.vertices[of_part])[1]]
        return found


if __name__ == "__main__":
    tyro.cli(MotionCodes, prog="python -m benchmarks.motion_codes").run()
