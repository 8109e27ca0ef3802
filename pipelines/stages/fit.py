"""Stage 70: fit Gaussians that are bound to the template's triangles to the views of one frame, or of a turn."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data.one_frame import frames_beside
from avatar.data.views import View
from avatar.formats import write_splat_ply
from avatar.gaussians import BoundGaussians, load_bound, save_bound
from avatar.metrics.view_quality import CONVENTION, mean_quality
from avatar.rig.rig import Rig
from avatar.training.engine.loop import METRICS_FILE
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.engine.session import Session
from avatar.training.fit.fit import FitConfig, FitResult, fit_gaussians, fit_scene
from avatar.training.scene import silhouette_overlap
from pipelines.runs import gates
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import TEMPLATE
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import GROUNDS, ModelStage, Trainer
from smplxpp.core.spread import spread
from smplxpp.figures.drawings import write_strip

PREVIEWED_TRAINING_VIEWS = 3


@dataclass(frozen=True, kw_only=True)
class FitStage(ModelStage):
    """Gaussians fitted to one frame's photographs.

    Attributes:
        config: configuration of the fit.
        by_hand: whether `smplxpp fit` makes it; a training takes such a fit as it is.
    """

    file = "gaussians.safetensors"
    alone = True

    config: FitConfig
    by_hand: bool = False

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        return {}

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        splits, capture = trainer.scene.capture.splits, trainer.scene.capture
        return {
            "fit": self.config,
            "frame": trainer.scene.frame,
            "train": splits.train_cameras,
            "held_out": splits.novel_view_cameras,
            "background": capture.recording.background or (0.0, 0.0, 0.0),
        }

    def inputs(self, trainer: Trainer) -> Mapping[str, str]:
        """Return digests of the template and of everything that the fit reads from the capture, by content."""
        scene, capture = trainer.scene, trainer.scene.capture

        def of(*arrays: np.ndarray) -> str:
            digest = hashlib.sha256()
            for array in arrays:
                digest.update(np.ascontiguousarray(array).tobytes())
            return digest.hexdigest()

        out = {TEMPLATE: scene.digests[TEMPLATE], "capture/pose": of(_posed(trainer))}
        beside = frames_beside(capture, scene.frame)
        for frame in beside:
            params = capture.params(frame)
            out[f"capture/pose {frame}"] = "" if params is None else of(scene.template.pose(params)[0])
        # A fit reads few frames, so that the content of each file can be hashed (a training hashes names and sizes).
        for name in (*capture.splits.train_cameras, *capture.splits.novel_view_cameras):
            camera = capture.cameras[name]
            out[f"capture/{name} camera"] = of(camera.K, camera.cam_from_world)
            if name in capture.recording.distortions:
                out[f"capture/{name} lens"] = repr(capture.recording.distortions[name])
            for kind in ("image", "mask"):
                for frame in (scene.frame, *beside):
                    path = capture.file(name, frame, kind)
                    if path is not None:
                        which = f"{kind} {frame}" if frame in beside else kind
                        out[f"capture/{name} {which}"] = sha256_file(path)
        return out

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        # The overlap of silhouettes is measured before the fit, which would hide a wrong pose.
        scene = fit_scene(trainer.scene, GROUNDS[self.ground](trainer.scene.template))
        overlap = silhouette_overlap(scene.template.mesh.with_vertices(scene.vertices), list(scene.train))
        views = {view.name: view for view in (*scene.held_out, *scene.shown)}

        def preview(images: Mapping[str, np.ndarray]) -> None:
            _write_strips(session.folder, images, views, scene.background)

        # The fit keeps checkpoints and previews in the session's folder, where an interrupted one continues.
        result = fit_gaussians(
            scene,
            self.config,
            session.folder,
            key=session.key,
            device=trainer.device,
            max_seconds=session.max_seconds,
            report=session.report,
            preview=preview,
        )
        # Keep the bound Gaussians for later stages, a plain splat file for viewers, and the log.
        save_bound(result.gaussians, folder / self.file)
        write_splat_ply(folder / "splats.ply", result.splats)
        shutil.copyfile(session.folder / METRICS_FILE, folder / METRICS_FILE)
        # Show all held-out views and a few training views.
        held_out = [view.name for view in scene.held_out]
        train = [view.name for view in scene.shown]
        shown = (*held_out, *spread(train, PREVIEWED_TRAINING_VIEWS))
        _write_strips(folder, {name: result.images[name] for name in shown}, views, scene.background)
        # The first evaluation, before any step, is the reference for the gain of PSNR.
        start = next(line for line in read_metrics(folder / METRICS_FILE) if line["kind"] == "evaluation")
        output = _output(result, held_out, train, overlap=overlap, start=start["mean"]["psnr"])
        output.numbers["by_hand"] = self.by_hand
        return output

    def read(self, path: Path, rig: Rig) -> BoundGaussians:
        return load_bound(path, faces=rig.template.faces).to(device=rig.device)


def _posed(trainer: Trainer) -> np.ndarray:
    """Return the (V, 3) vertices of the person's template in the frame's pose, metres."""
    return trainer.scene.template.pose(trainer.scene.reference_params())[0]


def _write_strips(
    folder: Path, images: Mapping[str, np.ndarray], views: Mapping[str, View], background: tuple[float, float, float]
) -> None:
    """Write photograph, rendering and error of each view to `folder/previews/CAM.png`."""
    for name, image in images.items():
        write_strip(folder / "previews" / f"{name}.png", views[name].photograph(background), image)


def _output(result: FitResult, held_out: list[str], train: list[str], *, overlap: float, start: float) -> StageOutput:
    """Make numbers and checks of a fit.

    Args:
        result: Gaussians, images and qualities.
        held_out: names of the held-out views.
        train: names of the training views.
        overlap: IoU of the template's silhouettes and the masks.
        start: PSNR of the same views before the first step, dB.
    """
    done = result.progress
    # Judge on held-out cameras where there are any; otherwise only training views remain.
    shown = held_out or train
    mean = {
        name: mean_quality({v: result.quality[v] for v in names})
        for name, names in (("held_out", held_out), ("train", train))
        if names
    }
    figures = mean["held_out" if held_out else "train"]
    which = "novel" if held_out else "training"
    # Check the inputs (silhouettes), the quality reached, the gain over the start, and the steps done.
    checks = [
        gates.SILHOUETTE.check(
            "template's silhouette on the masks",
            overlap,
            explanation="mean over the training views, before the fit; low: another pose, or other cameras",
        ),
        gates.PSNR["novel_view"].check(
            f"{which} views: PSNR of the person",
            figures["psnr"],
            explanation=f"mean over {len(shown)} cameras, over the union of the silhouettes",
        ),
        gates.SSIM.check(f"{which} views: SSIM", figures["ssim"]),
        gates.GAIN.check(
            f"{which} views: gain of PSNR since the start",
            figures["psnr"] - start,
            explanation="the start: colours of the photographs laid on the template",
        ),
        gates.ITERATIONS.check(
            "iterations done",
            done.iteration / done.iterations,
            explanation="below 1: the limit of time ended it; the same command continues",
        ),
    ]
    # These figures go to the manifest; the report and the command print them.
    numbers = {
        "gaussians": len(result.gaussians),
        "iterations": done.iterations,
        "iterations_done": done.iteration,
        "finished": done.finished,
        "seconds_of_steps": done.seconds,
        "iterations_per_second": done.iteration / done.seconds if done.seconds else 0.0,
        "convention": CONVENTION,
        "mean": mean,
        "held_out": {name: asdict(result.quality[name]) for name in held_out},
        "train": {name: asdict(result.quality[name]) for name in train},
        "heads": {name: result.heads[name] for name in (*held_out, *train)},
    }
    return StageOutput(checks, numbers)
