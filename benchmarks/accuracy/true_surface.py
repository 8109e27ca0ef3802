"""Measure what a capture's cameras can show: Gaussians and photographs on its true surfaces, in held-out views.

    python -m benchmarks true_surface --run RUN --capture DIR

Every figure of a student has the errors of its surface in it, and those of few cameras. Here Gaussians without a field
are fitted to all training frames on surfaces that are given: the one that the RUN's teacher tracked, the same with one
garment after the other put where it truly is, and the whole template on the truth. The last row tells about what a
student of as many Gaussians can reach in this capture, the differences which surface costs what; a student on the
tracked surface has a field and blend shapes, too, which correct some of it. Beside it the simplest thing: photographs
of a frame's training cameras laid on its true surface, black where none of them sees it. No row is a result of ours.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from avatar.data.one_frame import PosedViews
from avatar.data.sequence import AvatarSequence, camera_centers_of
from avatar.data.views import View, read_views
from avatar.metrics.view_quality import view_quality
from avatar.models.model_file import load_avatar
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rendering.avatar_view import render_view
from avatar.training.fit.fit import FitConfig, FitScene, fit_gaussians
from avatar.training.presets import training_preset
from benchmarks.support.results import store_results
from benchmarks.support.same_points import SamePoints
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import TEACHER
from pipelines.stages.scene import TrainInputs, open_scene
from smplxpp.core import InputError
from smplxpp.core.spread import spread_inside
from smplxpp.raster import rasterize_mesh

WITHIN = 12e-3
"""Metres from the truth in the reference frame within which a vertex takes its place there in all others.

Vertices farther away (the inside of folded hems, teeth) are carried along by their nearest neighbour.
"""
HIDDEN_BEHIND = 5e-3
"""Metres behind what a photograph shows, seen straight on, from which a point counts as hidden in it."""
LEAST_COSINE = 0.1
"""Cosine between normal and view below which a photograph shows nothing of a point."""


@dataclass(frozen=True)
class TrueSurface:
    """Fit, measure, store."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run whose teacher tracked the surface."""
    capture: Path
    """Folder of its capture, with true surfaces whose vertices are the same points in all frames."""
    iterations: int = 3000
    """Steps of each fit, of one view."""
    preset: str = "cpu"
    """Whose Gaussians and rates are used."""
    name: str = ""
    """Name of the stored file; by default that of the capture."""

    def run(self) -> None:
        """Print all rows; what is done is stored."""
        bench = _Bench(self.run_folder, self.capture)
        config = replace(training_preset(self.preset).fit, iterations=self.iterations, evaluations=1)
        splits = bench.capture.splits
        figures: dict[str, Any] = {
            "protocol": bench.capture.protocol or "exact",
            "training_cameras": len(splits.train_cameras),
            "training_frames": len(splits.train_frames),
            "iterations": self.iterations,
            "gaussians": config.sampling.count,
            "rows": {"photographs on the true surface": bench.photographs()},
        }
        print(figures["rows"], flush=True)
        parts = bench.template.cloth_parts
        whole = np.ones(len(bench.template.vertices), dtype=bool)
        moved = {"tracked surface": ~whole}
        moved |= {f"tracked surface, {part} on the truth": bench.vertices_of(part) for part in parts}
        for name, true in {**moved, "true surface": whole}.items():
            figures["rows"][f"Gaussians on the {name}"] = row = bench.row(config, true)
            print(f"{name:44s} {row}", flush=True)
            command = f"python -m benchmarks true_surface --run RUN --capture DIR --iterations {self.iterations}"
            command += f" --preset {self.preset}"
            store_results(f"true_surface_{self.name or bench.capture.name}", command, figures)


class _Bench:
    def __init__(self, run: Path, folder: Path) -> None:
        scene = open_scene(run, TrainInputs(folder))
        self.capture, self.template = scene.capture, scene.template
        self.sequence = AvatarSequence(scene.capture, scene.template)
        self.rig = self.sequence.rig
        teacher = load_avatar(run / TEACHER, self.rig)
        if not isinstance(teacher, TeacherAvatar) or teacher.track is None:
            raise InputError("run", expected="a teacher that tracked the surface", received="none")
        self.track = teacher.track
        every = np.arange(len(scene.template.vertices))
        same = SamePoints.found(scene, load_params_of_run(run).frame(0), every, within=WITHIN)
        if same is None:
            raise InputError("capture", expected="true surfaces of training frames", received="none")
        self.same = same
        # For each vertex the row of the nearest one, in the T-pose, whose place on the truth is known.
        self.nearest = cKDTree(scene.template.vertices[same.own]).query(scene.template.vertices)[1]

    def vertices_of(self, part: str) -> Bool[np.ndarray, " V"]:
        """Return a mask of the vertices of a part."""
        mask = np.zeros(len(self.template.vertices), dtype=bool)
        mask[self.template.faces[self.template.part_faces(part)]] = True
        return mask

    def row(self, config: FitConfig, true: Bool[np.ndarray, " V"]) -> dict[str, Any]:
        """Fit Gaussians to all training frames with some vertices on the truth; dB of training and held-out views."""
        splits, background = self.capture.splits, self.capture.recording.background or (0.0, 0.0, 0.0)
        posed = [self._posed(frame, splits.train_cameras, true) for frame in splits.train_frames]
        scene = FitScene(self.template, posed[0].vertices, posed[0].views, (), background, posed[1:])
        with tempfile.TemporaryDirectory() as folder:
            found = fit_gaussians(scene, config, Path(folder))
        student = Student(StudentConfig(field=None), self.rig, found.gaussians, ())
        held_out = [self._posed(frame, splits.novel_view_cameras, true) for frame in splits.train_frames]
        poses = [self._posed(frame, splits.novel_view_cameras, true) for frame in splits.novel_pose_frames]
        return {
            **self._measured("training", student, config.eps2d, spread_inside(posed, 5)),
            **self._measured("novel_views", student, config.eps2d, held_out),
            # New poses have no track: what is not on the truth hangs as skinning has it.
            **self._measured("novel_poses", student, config.eps2d, poses),
        }

    def photographs(self) -> dict[str, Any]:
        """Lay the photographs of each frame's training cameras on its true surface; dB of held-out views."""
        splits, found = self.capture.splits, []
        for frame in splits.train_frames:
            truth = self.capture.truth_mesh(frame)
            if truth is None:
                raise InputError("capture", expected=f"a true surface of frame {frame}", received="none")
            background = self.sequence.background
            shown = [self.sequence.whole_view(camera, frame) for camera in splits.train_cameras]
            depths = [rasterize_mesh(truth, view.camera).depth for view in shown]
            for camera in splits.novel_view_cameras:
                view = self.sequence.whole_view(camera, frame)
                seen = rasterize_mesh(truth, view.camera)
                points = seen.interpolate(truth.faces, truth.vertices)[seen.mask]
                normals = seen.interpolate(truth.faces, truth.vertex_normals)[seen.mask]
                photographs = zip(shown, depths, strict=True)
                laid = [_photographed(points, normals, one, depth, background) for one, depth in photographs]
                total = sum(weights for weights, _ in laid)[:, None].clamp(min=1e-12)
                image = background.expand(*seen.mask.shape, 3).clone()
                image[torch.from_numpy(seen.mask)] = sum(weights[:, None] * colors for weights, colors in laid) / total
                alpha = torch.from_numpy(seen.mask.astype(np.float32))
                found.append(view_quality(view, image, alpha, background, head=None).psnr)
        return _summary("novel_views", found)

    def _posed(self, frame: int, cameras: Iterable[str], true: Bool[np.ndarray, " V"]) -> PosedViews:
        """Return a frame's vertices, those of `true` on the true surface, and its views under names of their own."""
        tracked = self.track.displacements(frame) if frame in self.track.row else None
        vertices = self.rig.skin_to_numpy(self.sequence.pose(frame), tracked)
        if true.any():
            truth = self.capture.truth_mesh(frame)
            if truth is None or len(truth.vertices) != self.same.vertices:
                raise InputError("capture", expected=f"the same true surface in frame {frame}", received="another")
            apart = (self.same.of(truth) - vertices[self.same.own])[self.nearest]
            vertices = vertices + np.where(true[:, None], apart, 0.0)
        views = read_views(self.capture, frame, tuple(cameras))
        named = [replace(view, camera=replace(view.camera, name=f"{view.name} {frame}")) for view in views]
        return PosedViews(vertices, named)

    @torch.no_grad()
    def _measured(self, name: str, student: Student, eps2d: float, sets: Iterable[PosedViews]) -> dict[str, Any]:
        found = []
        for one in sets:
            pose = self.rig.pose_from_vertices(one.vertices)
            for view in one.views:
                posed = student(pose, camera_centers_of([view]))
                seen = render_view(posed, 0, view, self.sequence.background, eps2d=eps2d)
                found.append(view_quality(view, seen.image, seen.alpha, self.sequence.background, head=None).psnr)
        return _summary(name, found)


def _photographed(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    view: View,
    depth: Float[np.ndarray, "H W"],
    background: Tensor,
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 3"]]:
    """Return how well a photograph shows points of a surface, and the colours that it shows there."""
    camera = view.camera
    screen = camera.screen_from_world(points)
    away = camera.position - points
    cosine = np.einsum("nd,nd->n", normals, away) / np.linalg.norm(away, axis=1)
    cosine /= np.maximum(np.linalg.norm(normals, axis=1), 1e-9)
    column, row = (np.rint(screen[:, k] - 0.5).astype(np.int64) for k in (0, 1))
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (cosine > LEAST_COSINE)
    at = row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)
    inside &= screen[:, 2] < depth[at] + HIDDEN_BEHIND / np.maximum(cosine, LEAST_COSINE)
    # `grid_sample` has -1 and 1 at the picture's borders.
    grid = torch.from_numpy(2.0 * screen[:, :2] / (camera.width, camera.height) - 1.0).float()[None, None]
    image = view.composited(background).permute(2, 0, 1)[None]
    colors = functional.grid_sample(image, grid, mode="bilinear", align_corners=False)[0, :, 0].T
    # The sixth power of the cosine: the photographs that see a point best decide.
    return torch.from_numpy(np.where(inside, cosine**6, 0.0)).float(), colors


def _summary(name: str, found: list[float]) -> Mapping[str, Any]:
    return {name: round(mean(found), 2), f"{name}_worst": round(min(found), 2), f"{name}_images": len(found)}


if __name__ == "__main__":
    tyro.cli(TrueSurface, prog="python -m benchmarks true_surface").run()
