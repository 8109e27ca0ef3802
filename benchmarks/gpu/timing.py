"""Time warm steps of a training's stages, and a student's frames a second from parameters to pictures."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any
from unittest import mock

import torch
from torch.profiler import ProfilerActivity, profile

from avatar.models.student import CompiledStudent
from avatar.rendering.avatar_view import render_view
from avatar.rig.rig import PosedAvatar
from avatar.runtime import AvatarPlayer
from avatar.training.engine.loop import LoopConfig, Progress
from avatar.training.tracking.track import TrackTask
from smplxpp.core import BodyParams
from smplxpp.core.camera import Camera

WARM_UP = 3


def frames_a_second(
    student: CompiledStudent, params: Sequence[BodyParams], camera: Camera, *, pictures: int
) -> dict[str, float]:
    """Median milliseconds from parameters to Gaussians and of drawing, and of both as frames a second."""
    device = student.rig.device
    black = torch.zeros(3, device=device)

    # CUDA works asynchronously: wait for it before each reading of the clock.
    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    times = []
    with torch.no_grad():
        for one in itertools.islice(itertools.cycle(params), WARM_UP + pictures):
            begin = now()
            posed = student(one, camera.position)
            placed = now()
            render_view(posed, 0, camera, black).image.clamp(0.0, 1.0)
            times.append((placed - begin, now() - placed))
    # The first pictures compile kernels and fill caches.
    times = times[WARM_UP:]
    return {
        "deform_ms": 1e3 * median(deform for deform, _ in times),
        "render_ms": 1e3 * median(render for _, render in times),
        "fps": 1.0 / median(sum(both) for both in times),
    }


def played(player: AvatarPlayer, params: Sequence[BodyParams], camera: Camera, *, pictures: int) -> dict[str, float]:
    """Median milliseconds of a player from parameters to the picture in the CPU's memory, and frames a second."""
    times = []
    for one in itertools.islice(itertools.cycle(params), WARM_UP + pictures):
        begin = time.perf_counter()
        player.pose(one)
        player.draw(camera)
        times.append(time.perf_counter() - begin)
    whole = median(times[WARM_UP:])
    return {"ms": 1e3 * whole, "fps": 1.0 / whole}


def largest_difference_mm(one: PosedAvatar, other: PosedAvatar) -> float:
    """Return the largest distance of a Gaussian between two poses."""
    return 1e3 * float((one.gaussians.means - other.gaussians.means).norm(dim=-1).max())


class EnoughError(Exception):
    """The last stage that was asked for has been timed."""


@dataclass
class Probe:
    """Stands for `run_training`: times warm steps of each stage and hands its task on as if it had ended.

    Attributes:
        device: "cuda" or "cpu".
        seconds: of timed steps a stage.
        last: name of the last stage that is timed; None: all.
        profiled: steps that are profiled, after the timed ones.
        told: called after every stage.
        found: figures by stage: warm steps a second, seconds of the first ones, GiB of the GPU at most, kernels a step
            and the share of a step in which the GPU computes.
    """

    device: str
    seconds: float
    last: str | None = None
    profiled: int = 2
    told: Callable[[dict[str, Any]], None] = lambda found: None
    found: dict[str, Any] = field(default_factory=dict)

    def __call__(self, task: Any, config: LoopConfig, folder: Path, **_: Any) -> Progress:
        """Time the stage of a task."""
        name, profiled = type(task).__name__.removesuffix("Task"), self.profiled
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
        averages = seen.key_averages()
        rows = [one for one in averages if one.self_device_time_total and not one.self_cpu_time_total]
        busy = sum(one.self_device_time_total for one in rows) / len(steps)
        longest = sorted(rows, key=lambda one: -one.self_device_time_total)[:5]
        calls = sum(one.count for one in averages if one.key.startswith("aten::"))
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
