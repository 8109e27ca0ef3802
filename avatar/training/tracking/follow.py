"""Following the surface through a motion: in one go, or in segments that run side by side, and their seams.

Frames of a segment depend on each other, segments do not. Each one begins with the frame in which the template is the
surface, jumps to a run-in of frames that its neighbour has, too, and keeps the frames after it. What both have found
in the last frames of the run-in measures how far the surface jumps at the seam. Segments depend on the settings alone,
so that any number of processes finds the same bits.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.binding import BoundGaussians
from avatar.models.tracked_surface import Track, TrackedAvatar
from avatar.training.engine.loop import METRICS_FILE, Progress
from avatar.training.engine.metrics_log import append_metrics
from avatar.training.engine.processes import Distributed
from avatar.training.engine.session import BACK, Session
from avatar.training.refinement.board import Arrays, Board, RefinementStoppedError
from avatar.training.tracking.config import TrackConfig
from avatar.training.tracking.track import FramesApart, TrackTask, outwards
from smplxpp.core.files.atomic import atomic_write_text

SIMULATED_FILE = "simulated_clothes.json"
"""File in the session's folder: how well the clothes held whose simulation predicts the frames, part by part."""
SEAMS_FILE = "track_seams.json"
"""File in the session's folder: how far neighbouring segments are apart; only of motions that were split."""


@dataclass(frozen=True)
class Segment:
    """Frames that are tracked without those of other segments, in the order in which they are solved.

    Attributes:
        frames: whose results are kept.
        run_in: frames before them, which the segment `before` has, too.
        before: number of the neighbour towards the reference frame; None: the segment that begins there.
    """

    frames: tuple[int, ...]
    run_in: tuple[int, ...] = ()
    before: int | None = None


def segments_of(frames: Sequence[int], config: TrackConfig) -> list[Segment]:
    """Split a motion into segments: one about the reference frame, then equal ones on either side, nearest first."""
    order, most = outwards(frames, config), config.segment_frames
    nearest, first = set(order[:most]), order[0]
    found = [Segment(tuple(order[:most]))]
    for side in (-1, 1):
        # Frames of a side by distance; those after the first segment in equal parts.
        there = [frame for frame in order if (frame - first) * side > 0]
        inside = sum(frame in nearest for frame in there)
        count = math.ceil((len(there) - inside) / most)
        before = 0
        for begin, end in pairwise(np.linspace(inside, len(there), count + 1).round().astype(int).tolist()):
            run_in = tuple(there[max(0, begin - config.run_in) : begin])
            found.append(Segment(tuple(there[begin:end]), run_in, before))
            before = len(found) - 1
    return found


def follow_surface(
    sequence: AvatarSequence, gaussians: BoundGaussians, config: TrackConfig, session: Session
) -> tuple[Track, Progress]:
    """Track the surface through all training frames, and back where `TrackConfig.back` is set.

    Steps have one frame each. Of several processes the first tracks a motion of one segment, and sends its results to
    the others; they share the segments of a longer one.

    Args:
        sequence: the training frames and views.
        gaussians: on the template, fitted to the reference frame; they stay fixed.
        config: of the tracking.
        session: of the training; a stopped tracking continues from its checkpoint.

    Returns:
        The track and the progress of the steps.
    """
    count = min(config.control_points, len(sequence.rig.vertices))
    avatar = TrackedAvatar(sequence.rig, gaussians, count, still_body=config.still_body)
    context = replace(session.context, distributed=None)
    # Forward pass.
    task = TrackTask(sequence, avatar, config, context)
    simulated = task.prediction.simulated
    if simulated is not None and (session.distributed or Distributed()).first:
        quality = [one.as_dict() for one in simulated.quality]
        atomic_write_text(session.folder / SIMULATED_FILE, json.dumps(quality, indent=1))
    segments = segments_of(sequence.train_frames, config)
    if len(segments) == 1:
        progress = session.run_alone(lambda: task, task.config)
    else:
        progress = _Segments(task, segments, session).run()
    _share(task, session)
    if not (config.back and progress.finished and len(sequence.train_frames) > 1):
        return task.track(), progress
    # Backward pass without the finest level, which measures drift.
    backward = TrackTask(sequence, avatar, config.coarse(), context, apart=task.backward())
    after = session.after(progress).within(BACK).run_alone(lambda: backward, backward.config)
    _share(backward, session)
    found = replace(task.track(), drift=task.drift(backward)) if after.finished else task.track()
    return found, replace(after, session_seconds=progress.session_seconds + after.session_seconds)


def _share(task: TrackTask, session: Session) -> None:
    """Send the first process's results to all processes."""
    processes = session.distributed or Distributed()
    first = processes.run_on_rank0(task.found)
    for name, own in task.found().items():
        own.copy_(first[name])


class _Segments:
    """Tracks the segments of a motion, each by whichever process is free, and joins them.

    Args:
        task: of all frames, which takes up what was found.
        segments: of its frames.
        session: of the tracking.

    Attributes:
        compared: last frames of those that are compared; single ones are noisy.
    """

    compared = 4

    def __init__(self, task: TrackTask, segments: Sequence[Segment], session: Session) -> None:
        self.task, self.segments, self.session = task, segments, session
        first = task.order[0]
        # Each segment begins with the reference frame, which shows the error of the Gaussians.
        self.orders = [tuple(dict.fromkeys((first, *one.run_in, *one.frames))) for one in segments]
        self.total = sum(map(len, self.orders)) * task.track_config.steps
        self.end = time.perf_counter() + session.max_seconds
        self.board = Board(session.folder / "segments", lambda: time.perf_counter() >= self.end)
        # Of another key are other results.
        self.name = f"tracked_{session.key[:16]}"
        self.begin = time.perf_counter()

    def run(self) -> Progress:
        """Track all segments; the first process joins them, and tracks those again that miss their neighbours."""
        found: list[Arrays] | None = None
        with suppress(RefinementStoppedError):
            found = self.board.gather(self.name, len(self.segments), self._track)
        # Time may have run out on one process and not on another: what the first one has counts.
        processes = self.session.distributed or Distributed()
        return processes.run_on_rank0(lambda: self._join(found), kinds=(Progress,))

    def _track(self, number: int) -> Arrays:
        """Return displacements and structure tensors of a segment's frames, sorted, and the seconds of its steps."""
        apart = FramesApart(self.orders[number], self.task.prediction)
        task, progress = self._steps(f"segment_{number:03d}", apart)
        if not progress.finished:
            raise RefinementStoppedError(f"stopped in segment {number}")
        arrays = {name: tensor.cpu().numpy() for name, tensor in task.found().items()}
        return {**arrays, "seconds": np.asarray(progress.seconds)}

    def _steps(self, folder: str, apart: FramesApart) -> tuple[TrackTask, Progress]:
        """Track frames apart from the others, from their checkpoint if there is one."""
        task, whole = self.task, self.session
        context = replace(whole.context, distributed=None)
        part = TrackTask(task.sequence, task.avatar, task.track_config, context, apart=apart)
        first = (whole.distributed or Distributed()).first

        def report(progress: Progress) -> None:
            self.board.touch()
            if first:
                whole.report(self._progress(self._done() + progress.iteration, progress.seconds))

        left = max(self.end - time.perf_counter(), 0.0)
        session = replace(whole.within(folder), distributed=None, max_seconds=left, report=report)
        return part, session.run(lambda: part, part.config, keep_end=True)

    def _done(self) -> int:
        """Return the steps of the finished segments, about."""
        finished = len(list(self.board.folder.glob(f"{self.name}_*.npz")))
        return round(finished / len(self.segments) * self.total)

    def _progress(self, iteration: int, seconds: float, *, finished: bool = False) -> Progress:
        spent = time.perf_counter() - self.begin
        iteration = self.total if finished else min(iteration, self.total - 1)
        return Progress(iteration, self.total, seconds, iteration / max(spent, 1e-9), session_seconds=spent)

    def _join(self, found: Sequence[Arrays] | None) -> Progress:
        """Take up what was found, segment after segment outwards; None: time ran out."""
        if found is None:
            return self._progress(self._done(), time.perf_counter() - self.begin)
        seams = list[dict[str, Any]]()
        seconds = sum(float(one["seconds"]) for one in found)
        for number, (segment, order, arrays) in enumerate(zip(self.segments, self.orders, found, strict=True)):
            own = {
                frame: (torch.from_numpy(arrays["solved"][row]), torch.from_numpy(arrays["structure"][row]))
                for row, frame in enumerate(sorted(order))
            }
            if segment.run_in:
                # The neighbour has been taken up before, so that its surface is the one that counts.
                seams.append(self._seam(segment, {frame: one[0] for frame, one in own.items()}))
            self.task.take({frame: own[frame] for frame in segment.frames})
            if segment.run_in and seams[-1]["in_sequence"]:
                again = self._in_sequence(number, {frame: one[0] for frame, one in own.items()})
                seconds += sum(one.seconds for one in again)
                if not again[-1].finished:
                    return self._progress(self.total, seconds)
                seams[-1]["again"] = min(len(again) * self.task.track_config.run_in, len(segment.frames))
        # A line for the log of the tracking; each segment has a log of its own.
        (self.session.folder / METRICS_FILE).unlink(missing_ok=True)
        append_metrics(
            self.session.folder / METRICS_FILE,
            {"kind": "step", "iteration": self.total, "seconds": seconds, "segments": len(self.segments)},
        )
        atomic_write_text(self.session.folder / SEAMS_FILE, json.dumps(seams, indent=1))
        return self._progress(self.total, seconds, finished=True)

    def _seam(self, segment: Segment, own: Mapping[int, Tensor]) -> dict[str, Any]:
        """Return how far a segment's surface is from its neighbour's in frames that both have, at the clothes."""
        assert segment.before is not None
        both = [frame for frame in segment.run_in if frame in self.segments[segment.before].frames]
        mean, highest = self._apart(both, own)
        return {
            "frame": segment.frames[0],
            "frames": len(both[-self.compared :]),
            "mean_mm": mean,
            "p95_mm": highest,
            "in_sequence": highest > 1e3 * self.task.track_config.seam,
        }

    def _apart(self, frames: Sequence[int], own: Mapping[int, Tensor]) -> tuple[float, float]:
        """Return mean and 95th percentile of how far clothes are from where they are now, in the last frames, mm."""
        cage, device = self.task.avatar.cage, self.task.sequence.device
        last = frames[-self.compared :]
        apart = torch.stack([cage(self.task.solved[self.task.row[frame]] - own[frame].to(device)) for frame in last])
        clothes = self.task.sequence.rig.cloth_mask
        distances = apart[:, clothes if bool(clothes.any()) else ~clothes].norm(dim=-1).cpu().numpy()
        return 1e3 * float(distances.mean()), 1e3 * float(np.percentile(distances, 95.0))

    def _in_sequence(self, number: int, own: Mapping[int, Tensor]) -> list[Progress]:
        """Track a segment again after its neighbour, until the surface is where the segment has it, or to its end.

        Returns:
            The progress of each run-in's length of frames; the last one may be unfinished.
        """
        config, frames, done = self.task.track_config, self.segments[number].frames, list[Progress]()
        for begin in range(0, len(frames), config.run_in):
            part = frames[begin : begin + config.run_in]
            task, progress = self._steps(
                f"segment_{number:03d}_in_sequence_{begin:04d}", self._after_those_before(part)
            )
            done.append(progress)
            if not progress.finished:
                break
            self.task.take(task.found_in(part))
            if self._apart(part, own)[1] <= 1e3 * config.seam:
                break
        return done

    def _after_those_before(self, frames: Sequence[int]) -> FramesApart:
        """Return frames as they are tracked after those before them, to the bits of one sequence."""
        # The predictor compares predictions of four frames, each made from the two frames before it.
        needed = 6
        first = self.task.order[0]
        side = [frame for frame in self.task.order if (frame - first) * (frames[0] - first) > 0]
        until = side.index(frames[0])
        known = dict.fromkeys((first, *side[max(0, until - needed) : until]))
        return FramesApart(frames, self.task.prediction, self.task.found_in(tuple(known)))
