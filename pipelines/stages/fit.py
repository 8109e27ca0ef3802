"""Stage 70: views of the reference frame turn the template into Gaussians; resumed, skipped, recorded as a stage."""

from __future__ import annotations

import hashlib
import logging
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data.views import View, read_views
from avatar.export.splats import write_splat_ply
from avatar.gaussians.bound_file import save_bound
from avatar.metrics.view_quality import CONVENTION, mean_quality
from avatar.training.engine.loop import METRICS_FILE, Progress
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.reference_fit.config import FitConfig
from avatar.training.reference_fit.fit import FitResult, FitScene, fit_reference
from pipelines.figures.comparison import write_strip
from pipelines.runs.checks import Check
from pipelines.runs.digests import code_digest, sha256_file
from pipelines.runs.lock import own_run_folder
from pipelines.runs.stage import StageOutput, StageRecord, read_manifest, run_stage, stage_key
from pipelines.stages.build_config import FIT_STAGE, TEMPLATE
from pipelines.stages.train_names import PSNR_FLOORS
from smplxpp.body import load_body
from smplxpp.capture import Capture, open_capture
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template

log = logging.getLogger(__name__)
WORK_FOLDER = f"{FIT_STAGE}_work"
"""Metrics, checkpoint and previews of a fit under way; gone when it is finished."""
PREVIEWED_TRAINING_VIEWS = 3
STANDS_IN_IMAGES = 0.3
"""Overlap of template and masks below which nothing can be learned."""


@dataclass(frozen=True)
class FitInputs:
    """Where a fit takes its views from.

    Attributes:
        capture: folder of any known layout. frame: of its images and parameters.
        params: other parameters than the capture's own. body: what they are for, None for the open body.
        hold_out: names of cameras kept from training; empty: those that the capture's splits hold out.
        scale: of the images, 1 for all pixels.
    """

    capture: Path
    frame: int = 0
    params: Path | None = None
    body: Path | None = None
    hold_out: tuple[str, ...] = ()
    scale: float = 1.0


def fit(
    run: Path,
    inputs: FitInputs,
    config: FitConfig,
    *,
    device: str = "cpu",
    max_seconds: float = float("inf"),
    force: bool = False,
    progress: Callable[[Progress], None] = lambda p: None,
) -> StageRecord:
    """Fit the template of a run to a frame of a capture; skipped while configuration and inputs stand.

    A fit that was interrupted, or that `max_seconds` ended, goes on where it was.

    Args:
        force: fit anew even if the stage stands.
        progress: called after logged steps and evaluations.

    Raises:
        InputError: no template, or a capture that lacks images, masks, cameras or parameters of the frame.
    """
    template_file = run / TEMPLATE
    if not template_file.is_file():
        raise InputError(
            f"run {run}",
            expected=f"a template, {TEMPLATE}",
            received="none",
            remedy="make one with `smplxpp build --capture DIR --out RUN`",
        )
    template = Template.load(template_file)
    capture, train_names, held_out_names = open_views(inputs)
    params = capture.params(inputs.frame)
    if params is None:
        raise InputError(
            f"capture {capture.name}",
            expected=f"body parameters of frame {inputs.frame}",
            received="none",
            remedy="name a file with --params, or convert your fit with `smplxpp params convert`",
        )
    scene = FitScene(
        template,
        template.pose(params)[0],
        read_views(capture, inputs.frame, train_names),
        read_views(capture, inputs.frame, held_out_names),
        capture.recording.background or (0.0, 0.0, 0.0),
    )
    overlap = silhouette_overlap(template.mesh.with_vertices(scene.vertices), scene.train)
    key_config = {
        "fit": config,
        "frame": inputs.frame,
        "scale": inputs.scale,
        "device": device,
        "train": train_names,
        "held_out": held_out_names,
        "background": scene.background,
    }
    digests = {
        TEMPLATE: sha256_file(template_file),
        "code": code_digest("smplxpp", "avatar"),
        "torch": version("torch"),
        **_view_digests(capture, inputs.frame, scene),
    }
    key = stage_key(config=key_config, inputs=digests)
    work = run / WORK_FOLDER
    with own_run_folder(run, (FIT_STAGE, "report")):
        if force:
            shutil.rmtree(work, ignore_errors=True)
        before = read_manifest(run / FIT_STAGE)
        unfinished = before is not None and before.get("numbers", {}).get("finished") is False
        record = run_stage(
            run,
            FIT_STAGE,
            lambda folder: _fit(
                folder,
                work,
                scene,
                config,
                overlap=overlap,
                options={"key": key, "device": device, "max_seconds": max_seconds, "report": progress},
            ),
            config=key_config,
            inputs=digests,
            seed=config.seed,
            force=force or unfinished,
        )
        if record.manifest["numbers"]["finished"]:
            shutil.rmtree(work, ignore_errors=True)
    return record


def open_views(inputs: FitInputs) -> tuple[Capture, tuple[str, ...], tuple[str, ...]]:
    """The capture, and the names of the cameras to train on and of those held out.

    Raises:
        InputError: no frame of this number, or what `open_cameras` refuses.
    """
    capture, train, held_out = open_cameras(inputs)
    if inputs.frame not in capture.frames:
        raise InputError(
            f"capture {capture.name}",
            expected=f"frame {inputs.frame}",
            received=f"frames {capture.frames[0]} to {capture.frames[-1]}",
            remedy="choose another with --frame",
        )
    return capture, train, held_out


def open_cameras(inputs: FitInputs) -> tuple[Capture, tuple[str, ...], tuple[str, ...]]:
    """`open_views` of any frame.

    Raises:
        InputError: unknown cameras, none, or none to train on.
    """
    body = None if inputs.body is None else load_body(inputs.body)
    capture = open_capture(inputs.capture, params=inputs.params, body=body)
    if not capture.cameras or not capture.presence().any():
        raise InputError(
            f"capture {capture.name}",
            expected="cameras and their images",
            received="none",
            remedy="a scan alone makes a template; a fit needs the views: see docs/captures.md",
        )
    unknown = sorted(set(inputs.hold_out) - set(capture.cameras))
    if unknown:
        raise InputError(
            "option hold-out", expected=f"cameras among {', '.join(capture.cameras)}", received=", ".join(unknown)
        )
    if not 0.0 < inputs.scale <= 1.0:
        raise InputError("option scale", expected="a number above 0 and at most 1", received=f"{inputs.scale:g}")
    if inputs.scale != 1.0:
        capture = capture.resized(inputs.scale)
    splits = capture.splits
    held_out = inputs.hold_out or splits.novel_view_cameras
    # Cameras that the splits hold out and the option does not are trained on; those of neither are not.
    known = {*splits.train_cameras, *splits.novel_view_cameras}
    train = tuple(name for name in capture.cameras if name in known and name not in held_out)
    if not train:
        raise InputError("cameras", expected="at least one to train on", received="all held out")
    return capture, train, tuple(held_out)


def silhouette_overlap(posed: TriangleMesh, views: list[View]) -> float:
    """Mean intersection over union of the posed template's silhouette and the masks.

    Raises:
        InputError: so little that template and images do not belong together.
    """
    values = []
    for view in views:
        mask, mesh = view.alpha.numpy() > 127, rasterize_mesh(posed, view.camera).mask
        values.append((mask & mesh).sum() / max((mask | mesh).sum(), 1))
    mean = float(np.mean(values))
    if mean < STANDS_IN_IMAGES:
        raise InputError(
            "template in the images",
            expected="a silhouette on the masks",
            received=f"a mean overlap (IoU) of {mean:.2f} over {len(views)} views",
            remedy="check --frame and --params, and that cameras and template share one world",
        )
    return mean


def _fit(
    folder: Path, work: Path, scene: FitScene, config: FitConfig, *, overlap: float, options: Mapping[str, Any]
) -> StageOutput:
    """Train in `work`, write the results into `folder`."""
    views = {view.name: view for view in (*scene.held_out, *scene.train)}

    def preview(images: Mapping[str, np.ndarray]) -> None:
        for name, image in images.items():
            write_strip(work / "previews" / f"{name}.png", views[name].photograph(scene.background), image)

    result = fit_reference(scene, config, work, preview=preview, **options)
    save_bound(result.gaussians, folder / "gaussians.safetensors")
    write_splat_ply(folder / "splats.ply", result.splats)
    shutil.copyfile(work / METRICS_FILE, folder / METRICS_FILE)
    held_out = [view.name for view in scene.held_out]
    train = [view.name for view in scene.train]
    for name in (*held_out, *_spread(train, PREVIEWED_TRAINING_VIEWS)):
        write_strip(folder / "previews" / f"{name}.png", views[name].photograph(scene.background), result.images[name])
    start = next(line for line in read_metrics(folder / METRICS_FILE) if line["kind"] == "evaluation")
    return _output(result, held_out, train, overlap=overlap, start=start["mean"]["psnr"])


def _output(result: FitResult, held_out: list[str], train: list[str], *, overlap: float, start: float) -> StageOutput:
    """Numbers and checks.

    Args:
        overlap: of the template and the masks. start: PSNR of the same views before the first step, dB.
    """
    done = result.progress
    shown = held_out or train
    mean = {
        name: mean_quality({v: result.quality[v] for v in names})
        for name, names in (("held_out", held_out), ("train", train))
        if names
    }
    figures = mean["held_out" if held_out else "train"]
    which = "held-out" if held_out else "training"
    checks = [
        Check(
            "template's silhouette on the masks",
            overlap,
            "IoU",
            0.95,
            0.8,
            higher_is_better=True,
            explanation="mean over the training views, before the fit; low: another pose, or other cameras",
        ),
        Check(
            f"{which} views: PSNR of the person",
            figures["psnr"],
            "dB",
            *PSNR_FLOORS["novel_view"],
            higher_is_better=True,
            explanation=f"mean over {len(shown)} cameras, over the union of the silhouettes",
        ),
        Check(f"{which} views: SSIM", figures["ssim"], "", 0.9, 0.75, higher_is_better=True),
        Check(
            f"{which} views: gain of PSNR since the start",
            figures["psnr"] - start,
            "dB",
            0.0,
            -1.0,
            higher_is_better=True,
            explanation="the start: colours of the photographs laid on the template",
        ),
        Check(
            "iterations done",
            done.iteration / done.iterations,
            "",
            1.0,
            0.0,
            higher_is_better=True,
            explanation="below 1: the limit of time ended it; the same command goes on",
        ),
    ]
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


def _spread(names: list[str], count: int) -> list[str]:
    """At most `count` names, evenly from first to last."""
    return [names[k] for k in np.unique(np.linspace(0, len(names) - 1, count).round().astype(int))]


def _view_digests(capture: Capture, frame: int, scene: FitScene) -> dict[str, str]:
    """SHA-256 of everything that is read of the capture: images, masks, and numbers as they came out of its files."""

    def of(*arrays: np.ndarray) -> str:
        digest = hashlib.sha256()
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    out = {"capture/pose": of(scene.vertices)}
    for view in (*scene.train, *scene.held_out):
        camera = view.camera
        out[f"capture/{view.name} camera"] = of(camera.K, camera.cam_from_world)
        for kind in ("image", "mask"):
            path = capture.file(view.name, frame, kind)
            if path is not None:
                out[f"capture/{view.name} {kind}"] = sha256_file(path)
    return out
