"""Write the results of a training into its stage: models, previews, figures, checks."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from avatar.baselines.avatar_base import Baseline
from avatar.data.sequence import AvatarSequence
from avatar.metrics.speed import parameter_counts
from avatar.metrics.view_quality import CONVENTION
from avatar.models.model_file import save_avatar
from avatar.models.student import Student
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.training.engine.loop import METRICS_FILE, TENSORBOARD_FOLDER, Progress
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.engine.resources import peak_memory
from avatar.training.engine.session import BACK, JOINT, PRETRAIN, TRACK, Session
from avatar.training.tracking.follow import SEAMS_FILE, SIMULATED_FILE
from pipelines.runs import gates
from pipelines.runs.layout import KINDS, kind_name
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import CLOTHED, Trainer
from smplxpp.cloth.quality import all_checks, quality_from
from smplxpp.core.checks import Check
from smplxpp.core.files import read_json

TRACK_BACK = f"{TRACK}/{BACK}"
TRACKING = {TRACK: "track_metrics.jsonl", TRACK_BACK: "track_back_metrics.jsonl", JOINT: "joint_metrics.jsonl"}
BEFORE = {**TRACKING, PRETRAIN: "pretrain_metrics.jsonl"}
"""Log files of what precedes a training, by their folder within the session's."""


def keep_logs(work: Path, folder: Path) -> None:
    """Copy logs and previews of a training into its stage; tracking and pretraining keep logs of their own."""
    for name in ("previews", TENSORBOARD_FOLDER):
        if (work / name).is_dir():
            shutil.copytree(work / name, folder / name)
    for part, name in (("", METRICS_FILE), *BEFORE.items()):
        source = work / part / METRICS_FILE
        if source.is_file():
            shutil.copyfile(source, folder / name)
    for name in (SIMULATED_FILE, SEAMS_FILE):
        if (work / TRACK / name).is_file():
            shutil.copyfile(work / TRACK / name, folder / name)


def write_model(path: Path, model: TeacherAvatar | Student) -> dict[str, Any]:
    """Write a model and return the size of its file in bytes."""
    return {"bytes": {path.name: save_avatar(path, model)}}


def training_output(
    trainer: Trainer,
    session: Session,
    folder: Path,
    model: TeacherAvatar | Student | Baseline,
    done: Progress,
    write: Callable[[], Mapping[str, Any]],
) -> StageOutput:
    """Write the results of a training into its stage: logs, the model, numbers, checks. Only rank 0 writes.

    Args:
        trainer: the trainer of the run.
        session: the session whose logs are kept.
        folder: folder of the stage.
        model: the trained model.
        done: the progress at which training ended.
        write: function that writes the model files and returns numbers on them.
    """
    if not trainer.together.first:
        return StageOutput()
    keep_logs(session.folder, folder)
    numbers = {**write(), "processes": trainer.together.world_size}
    return _output(folder, model, done, trainer.sequence(CLOTHED), numbers, overlap=trainer.scene.overlap)


def _output(
    folder: Path,
    model: TeacherAvatar | Student | Baseline,
    done: Progress,
    sequence: AvatarSequence,
    numbers: Mapping[str, Any],
    *,
    overlap: float,
) -> StageOutput:
    """Collect numbers and checks of a stage whose logs are in `folder`.

    Args:
        folder: folder of the stage.
        model: the trained model.
        done: the progress at which training ended.
        sequence: the capture with the person's template.
        numbers: numbers on the written files.
        overlap: IoU of the template's silhouettes and the masks.
    """
    # First and last evaluation of the log: the start and the result.
    evaluations = [line for line in read_metrics(folder / METRICS_FILE) if line["kind"] == "evaluation"]
    # None while tracking or pretraining: nothing of the training itself has been measured.
    start, end = (evaluations[0], evaluations[-1]) if evaluations else ({}, {})
    # Tracking and pretraining have logs of their own, whose times are reported apart.
    before = {part: read_metrics(folder / name) for part, name in BEFORE.items()}
    seconds = {part: lines[-1]["seconds"] if lines else 0.0 for part, lines in before.items()}
    # Without held-out cameras the "novel" views are training views, and are named so.
    held_out = bool(sequence.capture.splits.novel_view_cameras)
    found = {kind: end[kind] for kind in KINDS if kind in end}
    # Figures for the manifest: the model's size, the course of the training, and its quality per kind of views.
    everything = {
        **numbers,
        "gaussians": len(model.gaussians),
        "parameters": parameter_counts(model),
        "iterations": done.iterations,
        "iterations_done": done.iteration,
        "finished": done.finished,
        "seconds_of_steps": done.seconds,
        "iterations_per_second": done.iteration / done.seconds if done.seconds else 0.0,
        "peak_memory": peak_memory(str(sequence.device)),
        "training_frames": len(sequence.train_frames),
        "training_cameras": len(sequence.train_cameras),
        "held_out_cameras": held_out,
        "normals": _normals(sequence, folder),
        "simulated_clothes": read_json(folder / SIMULATED_FILE) if (folder / SIMULATED_FILE).is_file() else [],
        "seams": read_json(folder / SEAMS_FILE) if (folder / SEAMS_FILE).is_file() else [],
        "convention": CONVENTION,
        "seconds_of_tracking": sum(seconds[part] for part in TRACKING),
        **_followed(model),
        "seconds_of_pretraining": seconds[PRETRAIN],
        "iterations_before": sum(lines[-1]["iteration"] for lines in before.values() if lines),
        "measured_at": end.get("iteration"),
        "start": {kind: start[kind] for kind in KINDS if kind in start},
        **found,
    }
    return StageOutput(_checks(everything, overlap), everything)


def _followed(model: TeacherAvatar | Student | Baseline) -> dict[str, Any]:
    """Return the expected error of a teacher's tracked clothes and the drift of tracking there and back, mm."""
    track = model.track if isinstance(model, TeacherAvatar) else None
    if track is None or track.sigma is None:
        return {}
    return {"followed": {f"{name}_mm": 1e3 * metres for name, metres in track.errors_of_clothes().items()}}


def _normals(sequence: AvatarSequence, folder: Path) -> str:
    """Return the source of the loss's normals: "maps" of the capture, the tracked "surface", or "none"."""
    if sequence.normal_maps:
        return "maps"
    return "surface" if any("normal" in line for line in read_metrics(folder / METRICS_FILE)) else "none"


def _checks(numbers: Mapping[str, Any], overlap: float) -> list[Check]:
    """Check the figures of a training against their gates."""
    # The silhouettes tell wrong inputs from a failed training.
    checks = [
        gates.SILHOUETTE.check(
            "template's silhouette on the masks",
            overlap,
            explanation="mean over some training views; low: another pose, or other cameras",
        ),
    ]
    # Tracking forwards and back must return to the start; the distance is the drift.
    if "drift_mm" in numbers.get("followed", {}):
        checks.append(gates.DRIFT.check("clothes followed back to the first frame", numbers["followed"]["drift_mm"]))
    # Segments that were tracked side by side must meet; those that did not were tracked again after their neighbours.
    if numbers["seams"]:
        again = [seam for seam in numbers["seams"] if seam["in_sequence"]]
        widest = max([seam["p95_mm"] for seam in numbers["seams"] if not seam["in_sequence"]], default=0.0)
        told = (
            f"of {len(numbers['seams'])} seams, 95th percentile; {len(again)} segments tracked after their neighbours"
        )
        checks.append(gates.SEAM.check("clothes where segments of the tracking meet", widest, explanation=told))
    # The simulation that predicted the tracked frames must not tear.
    checks += all_checks([quality_from(one) for one in numbers["simulated_clothes"]], "prediction")
    # Check each measured kind of views: quality, gain since the start, loss by compression.
    for kind, gate in gates.PSNR.items():
        if kind not in numbers:
            continue
        name, figures = kind_name(kind, held_out=numbers["held_out_cameras"]), numbers[kind]
        checks += [
            gate.check(f"{name}: PSNR of the person", figures["psnr"]),
            gates.SSIM.check(f"{name}: SSIM", figures["ssim"]),
        ]
        if kind in numbers["start"]:
            gain = figures["psnr"] - numbers["start"][kind]["psnr"]
            checks.append(gates.GAIN.check(f"{name}: gain of PSNR since the start", gain))
        if kind in numbers.get("compact", {}):
            loss = figures["psnr"] - numbers["compact"][kind]["psnr"]
            checks.append(gates.LOST_BY_COMPRESSION.check(f"{name}: PSNR lost in the compact file", loss))
    done = numbers["iterations_done"] / numbers["iterations"]
    checks.append(
        gates.ITERATIONS.check(
            "iterations done",
            done,
            explanation="below 1: the limit of time ended it; the same command continues",
        )
    )
    return checks
