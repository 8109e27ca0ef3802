"""Time a picture of the torch student and of the runtime without torch, by part, on one thread.

    python -m benchmarks runtime --run RUN [--repeats 20] [--no-store]

A picture is a new pose and a view of 512x512 from the front. Both take turns in one process, picture by picture.
Times are those of the processor, which other work on the machine disturbs little; the least of all pictures counts.
Parts: pose (joints and expression; torch: and blended transforms of all vertices), field (displacements), blend
(blend shapes), world (skinning, frames of triangles, transform to the world; torch: and colours), draw (the picture;
runtime: and colours). Rows: the run's own student, and students of its sizes with Gaussians as sampled on the
template before any training.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from avatar.data.views import View
from avatar.export.bundle import BundleExtras, write_bundle
from avatar.gaussians.binding import world_from_frames
from avatar.gaussians.colors import view_colors
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.model_file import load_avatar
from avatar.models.student import Student
from avatar.rendering.avatar_view import render_view
from avatar.rig.rig import PosedAvatar, Rig
from avatar.runtime import AvatarPlayer
from avatar.runtime.player import PARTS
from benchmarks.support.results import store_results
from pipelines.runs import layout
from smplxpp.core import BodyParams, Camera
from smplxpp.template.template import Template

SIDE, SAMPLED = 512, (15_000, 220_000)


@dataclass(frozen=True)
class RuntimeBenchmark:
    """Time both."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run."""
    repeats: int = 20
    """Pictures of each."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        figures: dict[str, object] = {}
        for name, student in students_of(self.run_folder).items():
            for implementation, parts in compare(student, self.repeats).items():
                figures[f"{name} Gaussians, {implementation}"] = parts
        print(json.dumps(figures, indent=1))
        if self.store:
            store_results("runtime", f"python -m benchmarks runtime --run {self.run_folder.name}", figures)


def students_of(run_folder: Path) -> dict[str, Student]:
    """Return a run's student, then students of its sizes with other numbers of Gaussians, by name."""
    rig = Rig(Template.load(run_folder / layout.TEMPLATE))
    trained = load_avatar(run_folder / layout.STUDENT, rig)
    assert isinstance(trained, Student)
    students = {f"trained, {len(trained.gaussians)}": trained}
    return students | {f"sampled, {count}": sampled(trained, count) for count in SAMPLED}


def sampled(like: Student, count: int) -> Student:
    """Make a student of the same sizes with other Gaussians; its networks are as they start."""
    bound = sample_on_mesh(like.rig.template, SamplingConfig(count=count))
    known = None if like.pose_gate is None else like.pose_gate.poses
    return Student(like.config, like.rig, bound, like.frames, known_poses=known).eval()


def compare(student: Student, repeats: int) -> dict[str, dict[str, float]]:
    """Return the least milliseconds of each part and of their sum, with torch and without."""
    torch.set_num_threads(1)
    camera = from_the_front(student.rig.template)
    poses = poses_of(student)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.avatar"
        write_bundle(path, student, BundleExtras(name="benchmark"))
        begin = time.process_time()
        player = AvatarPlayer(path, threads=1, clock=time.process_time)
        loading, size = 1e3 * (time.process_time() - begin), path.stat().st_size
    drawn = torch_pictures(student, camera)
    best = {implementation: dict.fromkeys((*PARTS, "all"), float("inf")) for implementation in ("torch", "runtime")}
    for k in range(repeats):
        params = poses.frame(k % len(poses))
        player.pose(params)
        player.draw(camera)
        for implementation, seconds in (("runtime", dict(player.seconds)), ("torch", drawn(params))):
            seconds["all"] = sum(seconds.values())
            best[implementation] = {part: min(ms, 1e3 * seconds[part]) for part, ms in best[implementation].items()}
    best["runtime"] |= {"load": loading, "megabytes": size / 1e6}
    best["runtime"]["times as fast"] = best["torch"]["all"] / best["runtime"]["all"]
    return best


def torch_pictures(student: Student, camera: Camera) -> Callable[[BodyParams], dict[str, float]]:
    """Return what draws a pose with torch and gives the seconds of its parts."""
    size = (camera.height, camera.width)
    view = View(camera, torch.zeros(*size, 3, dtype=torch.uint8), torch.zeros(size, dtype=torch.uint8))
    background, rig = torch.zeros(3), student.rig

    @torch.no_grad()
    def picture(params: BodyParams) -> dict[str, float]:
        times = [time.process_time()]
        pose = rig.pose(params)
        times.append(time.process_time())
        moved = student.displacements(pose)
        times.append(time.process_time())
        bound = student.compensated(pose)
        times.append(time.process_time())
        vertices = rig.skin(pose, moved)
        frames = triangle_frames(vertices, rig.faces)
        world = world_from_frames(bound, frames)
        colors = view_colors(bound, frames, world.means, view.position[None])
        times.append(time.process_time())
        render_view(PosedAvatar(vertices, world, colors, bound, moved), 0, view, background)
        times.append(time.process_time())
        return {part: b - a for part, a, b in zip(PARTS, times, times[1:], strict=False)}

    return picture


def poses_of(student: Student) -> BodyParams:
    """Poses that training saw, or the T-pose."""
    if student.pose_gate is None:
        return BodyParams.rest(betas=0)
    theta = student.pose_gate.poses.double().numpy()
    still = BodyParams.rest(betas=0).select(np.zeros(len(theta), dtype=np.int64))
    full = still.full_pose.copy()
    full[:, 1:22] = theta.reshape(-1, 21, 3)
    return BodyParams.from_full_pose(full, betas=still.betas, expression=still.expression, transl=still.transl)


def from_the_front(template: Template) -> Camera:
    """Return a camera that has the person from head to toe."""
    low, high = template.vertices.min(axis=0), template.vertices.max(axis=0)
    middle = 0.5 * (low + high)
    return Camera.look_at(eye=middle + [0.0, 0.0, 3.5], target=middle, fov_y_deg=36.0, width=SIDE, height=SIDE)


if __name__ == "__main__":
    tyro.cli(RuntimeBenchmark).run()
