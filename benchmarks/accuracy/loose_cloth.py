"""Simulate loose clothes in motion that training did not show: distance to the truth, milliseconds a step.

    python -m benchmarks loose_cloth --run RUN --capture DIR

The garments of a trained RUN are simulated along the held-out frames of its capture, each row from its own start, and
held against the true surfaces beside skinning and the student's field. Poses are those that the run itself uses. The
truth is for measuring alone. Chaos: the spread of the simulated surface over starts moved by half a millimetre.
Rows of *fine* clothes have the same garments cut with particles 2 cm apart, in substeps of 1 ms.
`--draws N` also drives the clothes by the run's poses with N draws of a tracker's noise: one draw is luck.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from statistics import mean, median, stdev
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from avatar.data.cloth_motion import ClothMotionConfig, ClothMotions
from avatar.data.sequence import AvatarSequence
from avatar.metrics.surface_quality import SurfaceQuality, mean_surface, surface_quality
from avatar.models.model_file import load_avatar
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rig.rig import Pose
from avatar.training.loose_clothes import seen_particles
from benchmarks.support.results import store_results
from benchmarks.support.same_points import SamePoints
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import GARMENTS, STUDENT, TEACHER
from pipelines.stages.scene import TrainInputs, open_scene
from smplxpp.cloth import ClothDriver, ClothShape, DriverConfig, Garment, SolverConfig, cut_garment
from smplxpp.cloth.garment_file import load_garments
from smplxpp.cloth.poses import CausalSmoother
from smplxpp.core import BodyParams, InputError, TriangleMesh
from smplxpp.synth.tracker import tracker_noise

SAMPLES = 50_000
MOVED = 5e-4
"""Standard deviation, in metres, of the perturbed starts that measure chaos."""
STARTS = 4
SMALL_STEPS = DriverConfig(solver=SolverConfig(substep=1e-3))
"""How fine clothes are stepped: corrections travel an edge a substep, and their edges are shorter."""


@dataclass(frozen=True)
class LooseCloth:
    """Simulate, measure, store."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run with garments in 83_cloth."""
    capture: Path
    """Folder of its capture, with true surfaces of held-out frames."""
    params: Path | None = None
    """Poses that drive the clothes, as a tracker gives them; by default those of the run."""
    draws: int = 0
    """Draws of a tracker's noise (`smplxpp capture degrade`) on the poses, each measured; 2 or more, or none."""
    name: str = ""
    """Name of the stored file; by default that of the capture."""

    def run(self) -> None:
        """Print and store all rows.

        Raises:
            InputError: one draw, or fewer than none.
        """
        if self.draws == 1 or self.draws < 0:
            raise InputError("draws", expected="0 or at least 2: one draw is luck", received=str(self.draws))
        bench = _Bench(self.run_folder, self.capture, self.params)
        figures: dict[str, Any] = {
            "protocol": bench.protocol,
            "frames": list(bench.truths),
            "parts": {
                g.part: {"particles": len(g.particles), "fine": len(f.particles), "drag_per_s": g.config.fabric.drag}
                for g, f in zip(bench.garments, bench.fine, strict=True)
            },
            "rows": {},
        }
        # Each row moves the loose part by another method; its vertices are compared with the true surfaces.
        for name, shapes in bench.rows():
            figures["rows"][name] = bench.measured(shapes)
            print(f"{name:44s} {figures['rows'][name]}", flush=True)
        figures["rows"] |= self._noisy(bench) if self.draws else {}
        # Cloth is chaotic: two simulations of starts that hardly differ bound what any prediction can reach.
        figures["chaos_mm"] = bench.chaos()
        figures["milliseconds"] = bench.times()
        print(figures["chaos_mm"], figures["milliseconds"])
        command = "python -m benchmarks loose_cloth --run RUN --capture DIR"
        command += "" if self.params is None else f" --params {self.params.name}"
        command += f" --draws {self.draws}" if self.draws else ""
        path = store_results(f"loose_cloth_{self.name or bench.sequence.capture.name}", command, figures)
        print(f"stored {path.name}")

    def _noisy(self, bench: _Bench) -> dict[str, dict[str, float | None]]:
        """Rows of `bench` with noise on its poses: every draw's simulation, mean and standard deviation over draws."""
        poses = BodyParams.concatenate([bench.sequence.params(frame) for frame in bench.sequence.capture.frames])
        skinned, simulated = [], {}
        for seed in range(self.draws):
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "noisy.npz"
                tracker_noise(poses, seed=seed, betas=0.0).save(file)
                noisy = _Bench(self.run_folder, self.capture, file)
            shapes = dict(islice(noisy.rows(), 3))
            skinned.append(noisy.measured(shapes["skinning"]))
            row = f"simulated, poses with noise, draw {seed}"
            simulated[row] = noisy.measured(shapes["simulated, cold start 0.7 s before"])
            print(f"{row:44s} {simulated[row]}", flush=True)
        found = {"skinning": skinned, "simulated": [*simulated.values()]}
        return {
            f"{name}, {what} of {self.draws} draws": _over(rows, of)
            for name, rows in found.items()
            for what, of in (("mean", mean), ("standard deviation", stdev))
        } | simulated


class _Bench:
    def __init__(self, run: Path, capture: Path, params: Path | None) -> None:
        scene = open_scene(run, TrainInputs(capture, params, None, (), 1.0, None))
        self.sequence = AvatarSequence(scene.capture, scene.template)
        self.template = scene.template
        self.protocol = scene.capture.protocol or ("as given" if params is None else f"poses of {params.name}")
        self.garments = load_garments(run / GARMENTS, scene.template)
        if not self.garments or scene.capture.fps is None:
            raise InputError("run", expected="loose parts in 83_cloth, frames a second", received="none")
        self.fps = scene.capture.fps
        self.student = load_avatar(run / STUDENT, self.sequence.rig)
        self.fine = [
            cut_garment(scene.template, g.part, g.reference, replace(g.config, spacing=0.02)) for g in self.garments
        ]
        teacher = load_avatar(run / TEACHER, self.sequence.rig) if params is None else None
        self.track = teacher.track if isinstance(teacher, TeacherAvatar) else None
        self.held_out = scene.capture.splits.novel_pose_frames
        truths = {frame: scene.capture.truth_mesh(frame) for frame in self.held_out}
        self.truths = {frame: mesh for frame, mesh in truths.items() if mesh is not None}
        if not self.truths:
            raise InputError("capture", expected="true surfaces of held-out frames", received="none")
        self.label = max(self.garments, key=lambda g: len(g.vertices)).part
        own = np.concatenate([garment.vertices for garment in self.garments])
        self.same = SamePoints.found(scene, load_params_of_run(run).frame(0), own)

    def rows(self) -> Iterator[tuple[str, Mapping[int, Pose]]]:
        """Motions of the measured frames, row by row."""
        plain = {frame: self.sequence.pose(frame) for frame in self.truths}
        yield "skinning", plain
        with torch.no_grad():
            field = {f: self.student.displacements(pose) for f, pose in plain.items()}  # type: ignore[union-attr]
        yield "student's field", {f: _moved(plain[f], field[f]) for f in plain}
        for name, config in (
            ("simulated, cold start 0.7 s before", ClothMotionConfig()),
            ("the same, motion not smoothed", ClothMotionConfig(smoothing=0.0)),
            ("simulated, cold start at the first held-out frame", ClothMotionConfig(pre_roll=0.0)),
            ("simulated from the first frame on", ClothMotionConfig(pre_roll=1e6)),
        ):
            yield name, self._simulated(config)
        fine = ClothMotionConfig(driver=SMALL_STEPS)
        yield "fine, cold start 0.7 s before", self._simulated(fine, self.fine)
        for name, how, garments in (("simulated", ClothMotionConfig(), self.garments), ("fine,", fine, self.fine)):
            if self.track is not None:
                seen = seen_particles(self.sequence, self.track, garments)
                there = self._simulated(how, garments, seen=seen)
                yield f"{name} from where the surface was followed", there
        yield "online: causal filter, from 0.7 s before", self._online()

    def measured(self, poses: Mapping[int, Pose]) -> dict[str, float | None]:
        """Distances of the loose part to the truth, mm, means over the frames."""
        rig, found, apart = self.sequence.rig, [], []
        for frame, truth in self.truths.items():
            vertices = rig.skin(poses[frame]).double().numpy()
            mesh = TriangleMesh(vertices, self.template.faces)
            parts = surface_quality(mesh, self.template.vertex_labels, truth, samples=SAMPLES).labels
            found.append(parts[self.label])
            if self.same is not None and len(truth.vertices) == self.same.vertices:
                apart.append(1e3 * float(np.linalg.norm(vertices[self.same.own] - self.same.of(truth), axis=1).mean()))
        return {**_rounded(mean_surface(found)), "vertexwise": round(mean(apart), 2) if apart else None}

    def chaos(self) -> dict[str, float]:
        """Mean distance of vertices over starts moved by `MOVED` to their mean place, and the starts' number."""
        rng = np.random.default_rng(0)
        surfaces = []
        for _ in range(STARTS):
            shapes = self._rolled(None, rng)
            at = [self.sequence.rig.skin(self._with(frame, shapes[frame])).numpy() for frame in self.truths]
            surfaces.append(np.stack(at)[:, self.garments[0].vertices])
        stacked = np.stack(surfaces)
        spread = np.linalg.norm(stacked - stacked.mean(axis=0), axis=-1).mean()
        return {"starts": STARTS, "moved_mm": 1e3 * MOVED, "spread_mm": round(1e3 * float(spread), 2)}

    def times(self) -> dict[str, float]:
        """Milliseconds of CPU a step, medians: of a frame of the capture, and of 1/30 s."""
        out = {}
        frames = [f for f in self.sequence.capture.frames if self.sequence.capture.params(f) is not None][-24:]
        for name, seconds, garments, how in (
            ("a frame of the capture", 1.0 / self.fps, self.garments, None),
            ("1/30 s", 1.0 / 30.0, self.garments, None),
            ("1/30 s, fine", 1.0 / 30.0, self.fine, SMALL_STEPS),
        ):
            driver = ClothDriver(self.template, garments, how)
            took = []
            for frame in frames:
                params = self.sequence.params(frame)
                posed = self.template.posed_body(params.without_shape())
                begin = time.process_time()
                driver.step(params, seconds, posed=posed)
                took.append(time.process_time() - begin)
            out[name] = round(1e3 * median(took[1:]), 2)
        return out

    def _simulated(
        self, config: ClothMotionConfig, garments: list[Garment] | None = None, **seen: Any
    ) -> dict[int, Pose]:
        capture = self.sequence.capture
        given: dict[str, Any] = {"params": capture.params, "frames": capture.frames, "fps": self.fps}
        clothes = ClothMotions(self.template, garments or self.garments, **given, config=config, **seen)
        clothes.simulate(self.held_out)
        return {frame: self._with(frame, clothes.shape(frame)) for frame in self.truths}

    def _online(self) -> dict[int, Pose]:
        shapes = self._rolled(CausalSmoother(), None)
        return {frame: self._with(frame, shapes[frame]) for frame in self.truths}

    def _rolled(self, smoother: CausalSmoother | None, rng: np.random.Generator | None) -> dict[int, ClothShape]:
        """Shapes by frame as a player makes them, frame by frame, from 0.7 s before the first held-out frame."""
        driver = ClothDriver(self.template, self.garments)
        first = self.held_out[0] - round(0.7 * self.fps)
        shapes, last = {}, None
        for frame in (f for f in self.sequence.capture.frames if first <= f <= self.held_out[-1]):
            params: BodyParams = self.sequence.params(frame)
            seconds = 1.0 / self.fps if last is None else (frame - last) / self.fps
            shapes[frame] = driver.step(params if smoother is None else smoother(params, seconds), seconds)
            if rng is not None and last is None:
                part = self.garments[0].part
                particles = driver.particles(part)
                driver.place(part, particles + rng.normal(scale=MOVED, size=particles.shape).astype(np.float32))
            last = frame
        return shapes

    def _with(self, frame: int, shape: ClothShape) -> Pose:
        return self.sequence.rig.with_cloth(self.sequence.pose(frame), shape)


def _moved(pose: Pose, displacements: torch.Tensor | None) -> Pose:
    return pose if displacements is None else replace(pose, rest=pose.rest + displacements)


def _over(rows: Sequence[Mapping[str, float | None]], of: Callable[[list[float]], float]) -> dict[str, float | None]:
    columns = {key: [value for row in rows if (value := row[key]) is not None] for key in rows[0]}
    return {key: round(of(column), 2) if len(column) == len(rows) else None for key, column in columns.items()}


def _rounded(quality: SurfaceQuality) -> dict[str, float | None]:
    names = ("p2s", "truth_to_mesh", "p95")
    return {name: None if (value := getattr(quality, name)) is None else round(value, 2) for name in names}


if __name__ == "__main__":
    tyro.cli(LooseCloth, prog="python -m benchmarks loose_cloth").run()
