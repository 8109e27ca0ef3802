"""Measure the distance of the tracked surface to the truth, by frame rate.

    python -m benchmarks followed_surface --run RUN --capture DIR --every 1 2 3

The tracking of a preset follows the loose part of a RUN's template through every n-th training frame of its capture,
from the RUN's own Gaussians and poses. The benchmark measures the distance of the part's points to their true places
("vertexwise"), its surface, pictures of held-out cameras, the error that the tracking expects with its rank correlation
(Spearman's) to the true one, and the drift of tracking back to the first frame. The truth is used for measuring alone.
The influence of the skirt's pattern was measured once, on repainted photographs (docs/research.md).
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from avatar.data.sequence import AvatarSequence, camera_centers_of
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.tensor_file import load_bound
from avatar.metrics.surface_quality import mean_surface, surface_quality
from avatar.metrics.view_quality import view_quality
from avatar.models.tracked_surface import Track, TrackedAvatar
from avatar.rendering.avatar_view import render_view
from avatar.training.engine.session import Session
from avatar.training.presets import training_preset
from avatar.training.tracking.config import TrackConfig
from avatar.training.tracking.follow import follow_surface
from benchmarks.support.results import store_results
from benchmarks.support.same_points import SamePoints
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import GAUSSIANS
from pipelines.stages.scene import TrainInputs, open_scene
from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.spread import spread_inside

SAMPLES = 30_000
LOOKED_AT = 6
"""Frames whose held-out views are rendered."""


@dataclass(frozen=True)
class FollowedSurface:
    """Follow, measure, store."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Run with a template and a fit."""
    capture: Path
    """Folder of its capture, with true surfaces whose vertices are the same points in all frames."""
    every: tuple[int, ...] = (1, 2, 3)
    """One row each: every n-th training frame is followed."""
    preset: str = "cpu"
    part: str = "lower"
    """Label of the measured part."""
    seconds: float | None = None
    """Track the frames of the first seconds only; None: all."""
    levels: int | None = None
    """Number of the preset's image sizes to use, from the coarsest; None: all."""
    simulate: tuple[bool, ...] = (True, False)
    """With simulated clothes as the forecast of each frame, and without."""
    held: tuple[float, ...] = ()
    """Weights of what pictures do not tell where it was foreseen, in the place of the preset's; one row each."""
    back: bool = False
    """Go back to the first frame too and measure the drift."""
    name: str = ""
    """Name of the stored file; by default that of the capture."""

    def run(self) -> None:
        """Print all rows; what is done is stored."""
        bench = Bench(self.run_folder, self.capture, self.part)
        config = training_preset(self.preset).teacher.track
        if config is None:
            raise InputError("preset", expected="one that follows the surface", received=self.preset)
        config = replace(config, levels=config.levels[: self.levels], back=self.back)
        figures: dict[str, Any] = {
            "protocol": bench.protocol,
            "preset": self.preset,
            "part": self.part,
            "halvings": [level.halvings for level in config.levels],
            "rows": {},
        }
        for every, simulate, held in product(self.every, self.simulate, self.held or (config.prior_weight,)):
            own = replace(config, simulate=simulate, prior_weight=held)
            row = bench.row(own, every, seconds=self.seconds)
            name = f"photographs, every {every}, {'foreseen' if simulate else 'carried on'}"
            name += f", held {held:g}" if self.held else ""
            figures["rows"][name] = row
            print(f"{name:44s} {row}", flush=True)
            store_results(f"followed_surface_{self.name or bench.capture.name}", self._command(), figures)

    def _command(self) -> str:
        words = [f"--every {' '.join(map(str, self.every))}"]
        words += [f"--{name} {value}" for name, value in (("seconds", self.seconds), ("levels", self.levels)) if value]
        words += ["--held " + " ".join(f"{held:g}" for held in self.held)] if self.held else []
        words += ["--back"] if self.back else []
        words += ["--simulate " + " ".join(map(str, self.simulate)), f"--preset {self.preset} --part {self.part}"]
        return " ".join(["python -m benchmarks followed_surface --run RUN --capture DIR", *words])


class Bench:
    """A run's scene, opened once.

    Args:
        run: with template and fit. folder: of the capture. part: that is measured.
    """

    def __init__(self, run: Path, folder: Path, part: str) -> None:
        scene = open_scene(run, TrainInputs(folder))
        self.scene, self.capture, self.part = scene, scene.capture, part
        self.protocol = scene.capture.protocol or "exact"
        self.gaussians = load_bound(run / GAUSSIANS, faces=scene.template.faces)
        own = np.unique(scene.template.faces[scene.template.part_faces(part)])
        same = SamePoints.found(scene, load_params_of_run(run).frame(0), own)
        if same is None:
            raise InputError("capture", expected="true surfaces of training frames", received="none")
        self.same = same

    def row(self, config: TrackConfig, every: int, *, seconds: float | None = None) -> dict[str, Any]:
        """Follow every n-th training frame of the first `seconds`, or of all, and measure the result."""
        frames = self.capture.splits.train_frames[::every]
        if seconds is not None:
            last = frames[0] + seconds * (self.capture.fps or 1.0)
            frames = tuple(frame for frame in frames if frame <= last)
        capture = replace(self.capture, splits=replace(self.capture.splits, train_frames=frames))
        sequence, gaussians = AvatarSequence(capture, self.scene.template), self.gaussians
        config = replace(config, reference=self.scene.built_frame)
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            track, _ = follow_surface(sequence, gaussians, config, Session(Path(folder)))
        each = (time.perf_counter() - begin) / len(frames)
        return {
            **self.measured(sequence, track, gaussians),
            "frames": len(frames),
            "seconds_a_frame": round(each, 2),
        }

    def measured(self, sequence: AvatarSequence, track: Track, gaussians: BoundGaussians) -> dict[str, Any]:
        """Distances of the part to the truth, mm, over the frames, and the expected ones; dB of held-out cameras."""
        from scipy.stats import spearmanr  # importing it takes half a second

        rig, apart, worst, found = sequence.rig, {}, {}, []
        true, expected = [], []
        for frame in sequence.train_frames[1:]:
            truth = self.capture.truth_mesh(frame)
            if truth is None:
                continue
            # Compare the same point on both surfaces, so that sliding along the cloth counts too.
            vertices = rig.skin_to_numpy(sequence.pose(frame), track.displacements(frame))
            wrong = 1e3 * np.linalg.norm(vertices[self.same.own] - self.same.of(truth), axis=1)
            true.append(wrong)
            expected.append(1e3 * track.expected_error(frame).numpy()[self.same.own])
            apart[frame], worst[frame] = float(wrong.mean()), float(np.percentile(wrong, 95))
            mesh = TriangleMesh(vertices, rig.template.faces)
            found.append(surface_quality(mesh, rig.template.vertex_labels, truth, samples=SAMPLES).labels[self.part])
        surface = mean_surface(found)
        # Spearman's rank correlation: whether vertices with a large expected error have a large true one.
        latest = max(apart, key=lambda frame: apart[frame])
        return {
            "vertexwise": round(mean(apart.values()), 2),
            "vertexwise_p95": round(mean(worst.values()), 1),
            "worst_frame": latest,
            "vertexwise_there": round(apart[latest], 1),
            "expected": round(float(np.mean(expected)), 2),
            "rank_correlation": round(float(spearmanr(np.concatenate(expected), np.concatenate(true))[0]), 2),
            **self._drift(track, true),
            "p2s": _rounded(surface.p2s),
            "truth_to_mesh": _rounded(surface.truth_to_mesh),
            "psnr": round(self._psnr(sequence, track, gaussians), 2),
        }

    def _drift(self, track: Track, true: list[np.ndarray]) -> dict[str, float]:
        """Return the mean drift after tracking back, mm, and its rank correlation with the error; empty without it."""
        from scipy.stats import spearmanr  # importing it takes half a second

        if track.drift is None:
            return {}
        drift = 1e3 * track.cage(track.drift[:, None])[:, 0].numpy()[self.same.own]
        correlation = float(spearmanr(drift, np.mean(true, axis=0))[0])
        return {"drift": round(float(drift.mean()), 2), "drift_rank_correlation": round(correlation, 2)}

    @torch.no_grad()
    def _psnr(self, sequence: AvatarSequence, track: Track, gaussians: BoundGaussians) -> float:
        """Mean dB over held-out views of some training frames, of the fit's Gaussians on the surface."""
        avatar = TrackedAvatar(sequence.rig, gaussians, track.cage.count)
        found = []
        for frame in spread_inside(sequence.train_frames, LOOKED_AT):
            avatar.controls.copy_(track.controls[track.row[frame]])
            for camera in self.capture.splits.novel_view_cameras:
                view = sequence.whole_view(camera, frame)
                posed = avatar(sequence.pose(frame), camera_centers_of([view]))
                seen = render_view(posed, 0, view, sequence.background)
                quality = view_quality(view, seen.image, seen.alpha, sequence.background, head=None)
                found.append(quality.psnr)
        return mean(found)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


if __name__ == "__main__":
    tyro.cli(FollowedSurface, prog="python -m benchmarks followed_surface").run()
