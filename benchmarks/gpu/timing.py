"""Time warm steps of a training's stages, and a student's frames: plain, in half precision, as a CUDA graph.

The parts of a frame that a graph can hold are written out here without what asks the GPU for an answer: checks of
triangles without area, and the row of a frame's code. gsplat sorts into lists of unknown length, so that drawing stays
outside of the graph.
"""

from __future__ import annotations

import copy
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from avatar.gaussians.binding import world_from_frames_reference
from avatar.gaussians.colors import view_colors
from avatar.gaussians.frames import MIN_EDGE, TriangleFrames
from avatar.gaussians.tensor_operations import quat_from_matrix
from avatar.models.student import Student
from avatar.rendering import rasterize
from avatar.rig.rig import Pose
from avatar.training.engine.loop import LoopConfig, Progress
from avatar.training.tracking.track import TrackTask
from smplxpp.core.camera import Camera

MOVING = ("body_pose", "expression", "jaw", "rest", "world_from_rest", "root_from_world")
"""Fields of a `Pose` that change from frame to frame."""
WARM_UP = 3


@dataclass(frozen=True, eq=False)
class Drawable:
    """The tensors of one frame that the rasteriser takes."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


def plain_frames(vertices: Tensor, faces: Tensor) -> TriangleFrames:
    """The frames of triangles that all have an area."""
    corners = vertices[faces]
    v1, v2, v3 = corners.unbind(-2)
    cross = torch.linalg.cross(v2 - v1, v3 - v1)
    toward = 0.5 * (v2 + v3) - v1
    n = cross / cross.norm(dim=-1, keepdim=True).clamp_min(1e-20)
    q = toward / toward.norm(dim=-1, keepdim=True).clamp_min(1e-20)
    rotations = torch.stack([n, q, torch.linalg.cross(n, q)], -1)
    lengths = ((v2 - v1).norm(dim=-1) + (v3 - v1).norm(dim=-1) + (v3 - v2).norm(dim=-1)) / 3.0
    return TriangleFrames(corners, rotations, quat_from_matrix(rotations), lengths.clamp_min(MIN_EDGE))


class Deformer:
    """The work of a student between a pose and the rasteriser, its networks in `dtype`.

    Args:
        student: with a field and blend shapes.
        dtype: of the field, its codes and the blend shapes; geometry and colours stay in float32.
    """

    def __init__(self, student: Student, dtype: torch.dtype = torch.float32) -> None:
        assert student.field is not None and student.codes is not None and student.blend_shapes is not None
        self.rig, self.bound, self.dtype = student.rig, student.gaussians(), dtype
        self.field = copy.deepcopy(student.field).to(dtype)
        self.shapes = copy.deepcopy(student.blend_shapes).to(dtype)
        self.code = student.codes.codes[:1].detach().to(dtype)

    @torch.no_grad()
    def __call__(self, pose: Pose, camera_center: Tensor) -> Drawable:
        """The Gaussians of a pose as a camera at (1, 3) metres sees them."""
        body_pose = pose.body_pose[None].to(self.dtype)
        vertices = self.rig.skin(pose, self.field(body_pose, self.code)[0].float())
        frames = plain_frames(vertices, self.rig.faces)
        jaw = pose.jaw[None].to(self.dtype) if self.shapes.config.jaw else None
        z = self.shapes.coefficients(pose.expression[None].to(self.dtype), body_pose, jaw)
        du, dc = self.shapes(z)
        bound = replace(self.bound, offset=self.bound.offset + du[0].float(), dc=self.bound.dc + dc[0].float())
        world = world_from_frames_reference(bound, frames)
        colors = view_colors(bound, frames, world.means, camera_center)[0]
        return Drawable(world.means, world.quats, world.scales, world.opacities, colors)


class Replayed:
    """A deformer recorded once as a CUDA graph, and replayed for every frame."""

    def __init__(self, deformer: Deformer, pose: Pose, camera_center: Tensor) -> None:
        self.pose = replace(pose, **{name: getattr(pose, name).clone() for name in MOVING})
        self.center = camera_center.clone()
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):  # what is set up at a first call must not be part of the graph
            for _ in range(WARM_UP):
                deformer(self.pose, self.center)
        torch.cuda.current_stream().wait_stream(aside)
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.out = deformer(self.pose, self.center)

    def __call__(self, pose: Pose, camera_center: Tensor) -> Drawable:
        for name in MOVING:
            getattr(self.pose, name).copy_(getattr(pose, name))
        self.center.copy_(camera_center)
        self.graph.replay()
        return self.out


def draw(frame: Drawable, camera: Camera, device: torch.device) -> Tensor:
    """(H, W, 3) of a frame on black, in [0, 1]."""
    viewmat, K = (torch.tensor(m, dtype=torch.float32, device=device) for m in (camera.cam_from_world, camera.K))
    image, _, _ = rasterize(
        frame.means,
        frame.quats,
        frame.scales,
        frame.opacities,
        frame.colors[None],
        viewmat[None],
        K[None],
        camera.width,
        camera.height,
        eps2d=0.1,
        check=False,
    )
    return image[0].clamp(0.0, 1.0)


def frames_a_second(
    deform: Callable[[Pose, Tensor], Drawable], poses: Sequence[Pose], camera: Camera, *, pictures: int
) -> dict[str, float]:
    """Median milliseconds of deformation and drawing, and of both as frames a second; poses are at hand."""
    device = poses[0].body_pose.device
    center = torch.tensor(camera.position[None], dtype=torch.float32, device=device)

    # CUDA works asynchronously: wait for it before each reading of the clock.
    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    times = []
    with torch.no_grad():
        for pose in itertools.islice(itertools.cycle(poses), WARM_UP + pictures):
            begin = now()
            frame = deform(pose, center)
            deformed = now()
            draw(frame, camera, device)
            times.append((deformed - begin, now() - deformed))
    # The first pictures compile kernels and fill caches.
    times = times[WARM_UP:]
    return {
        "deform_ms": 1e3 * median(deform for deform, _ in times),
        "render_ms": 1e3 * median(render for _, render in times),
        "fps": 1.0 / median(sum(both) for both in times),
    }


def largest_difference_mm(one: Drawable, other: Drawable) -> float:
    """Return the largest distance of a Gaussian between two frames."""
    return 1e3 * float((one.means - other.means).norm(dim=-1).max())


class EnoughError(Exception):
    """The last stage that was asked for has been timed."""


@dataclass
class Probe:
    """Stands for `run_training`: times warm steps of each stage and hands its task on as if it had ended.

    Attributes:
        device: "cuda" or "cpu".
        seconds: of timed steps a stage.
        last: name of the last stage that is timed; None: all.
        told: called after every stage.
        found: figures by stage: warm steps a second, seconds of the first ones, GiB of the GPU at most, kernels a step
            and the share of a step in which the GPU computes.
    """

    device: str
    seconds: float
    last: str | None = None
    told: Callable[[dict[str, Any]], None] = lambda found: None
    found: dict[str, Any] = field(default_factory=dict)

    def __call__(self, task: Any, config: LoopConfig, folder: Path, **_: Any) -> Progress:
        """Time the stage of a task."""
        name, profiled = type(task).__name__.removesuffix("Task"), 2
        # Frames are followed in whole numbers, because their first steps are of smaller images.
        whole = task.track_config.steps if isinstance(task, TrackTask) else 1
        first = min(max(whole, WARM_UP), max(config.iterations - profiled - 1, 1))
        if self.device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        begin = self._now()
        for k in range(first):
            task.step(k)
        cold, begin, done = self._now() - begin, self._now(), 0
        while first + done < config.iterations - profiled:
            task.step(first + done)
            done += 1
            if done % whole == 0 and time.perf_counter() - begin > self.seconds:
                break
        took = self._now() - begin
        each = took / max(done, 1)
        row: dict[str, Any] = {"steps_a_second": 1.0 / each if done else None, "timed": done, "first_seconds": cold}
        if self.device == "cuda":
            row["gib"] = torch.cuda.max_memory_allocated() / 2**30
        self.found[name] = row | self._profiled(task, range(first + done, first + done + profiled), each)
        self.told(self.found)
        if name == self.last:
            raise EnoughError
        return Progress(config.iterations, config.iterations, took, 1.0 / each if done else 0.0)

    def _now(self) -> float:
        if self.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def _profiled(self, task: Any, steps: range, seconds: float) -> dict[str, Any]:
        """Return what the GPU does in a step, of which `seconds` were timed without a profiler."""
        kinds = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (self.device == "cuda")
        with profile(activities=kinds) as seen:
            for k in steps:
                task.step(k)
            self._now()
        # Rows of kernels have time of the device alone; those of calls repeat it.
        rows = [one for one in seen.key_averages() if one.self_device_time_total and not one.self_cpu_time_total]
        busy = sum(one.self_device_time_total for one in rows) / len(steps)
        longest = sorted(rows, key=lambda one: -one.self_device_time_total)[:5]
        calls = sum(one.count for one in seen.key_averages() if one.key.startswith("aten::"))
        return {
            "busy_share": 1e-6 * busy / seconds if seconds else None,
            "kernels": sum(one.count for one in rows) / len(steps),
            "calls": calls / len(steps),
            "longest_us": {one.key[:60]: round(one.self_device_time_total / len(steps)) for one in longest},
        }


@contextmanager
def probed(probe: Probe) -> Iterator[None]:
    """Time the stages of trainings in the block instead of running them to their end."""
    with (
        mock.patch("avatar.training.engine.session.run_training", probe),
        mock.patch("avatar.training.fit.fit.run_training", probe),
    ):
        yield
