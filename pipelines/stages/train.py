"""Stages 80 to 90: teacher, bake and compensation on a run's template; resumed, skipped, recorded as stages."""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.bound_file import load_bound
from avatar.losses.perceptual import load_metric
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.model_file import load_avatar
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.rig.posed import AvatarModel
from avatar.training.engine.loop import Progress
from avatar.training.engine.photometric_task import PhotometricConfig
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import explain_resource_errors
from avatar.training.presets import LOCAL, TrainingPreset
from avatar.training.train import Session, bake, compensate, fit_teacher
from pipelines.runs.digests import code_digest, sha256_file
from pipelines.runs.lock import own_run_folder
from pipelines.runs.stage import StageOutput, StageRecord, read_manifest, run_stage, stage_key
from pipelines.stages.build_config import (
    BAKE_STAGE,
    BAKED,
    COMPENSATE_STAGE,
    FIT_STAGE,
    GAUSSIANS,
    TEACHER,
    TEACHER_STAGE,
    TEMPLATE,
)
from pipelines.stages.fit import fit
from pipelines.stages.train_inputs import TrainInputs, TrainScene
from pipelines.stages.train_results import keep_logs, preview_writer, stage_output, write_model, write_student
from smplxpp.core.atomic import atomic_write_text
from smplxpp.core.errors import InputError

log = logging.getLogger(__name__)
OWN_FIT = "train.json"
"""Names the reference fit in a run that a training made: one that the user made is never replaced."""
ONE_STEP = 1e-9
"""Seconds: a training that is begun takes a step."""
Shapes = Literal["full", "local", "pruned"]
Bar = Callable[[str, int], AbstractContextManager[Callable[[Progress], None]]]


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What is trained.

    Attributes:
        preset: configurations of all stages.
        teacher: bake from a teacher; False: from the photographs alone.
        perceptual: metric of the perceptual term: "lpips", "st-lpips" or "none".
        blend_shapes: "full": every Gaussian has its own columns (the paper); "local": 256 parts of the Gaussians have
            coefficients of their own, and 16 columns; "pruned": full, and the compact file keeps those that fit.
        max_megabytes: of the compact file of a pruned student.
    """

    preset: TrainingPreset
    teacher: bool = True
    perceptual: str = "none"
    blend_shapes: Shapes = "full"
    max_megabytes: float = 20.0

    def shapes(self, expression_size: int) -> BlendShapeConfig:
        """Blend shapes of a template with so many expressions."""
        local = LOCAL if self.blend_shapes == "local" else {}
        return replace(self.preset.blend_shapes, expression_size=expression_size, **local)


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """How training runs; nothing in it changes what comes out.

    Attributes:
        stages: of "fit", "teacher", "bake" and "compensate" in this order; those before the first must stand.
        max_seconds: stop after as long with a checkpoint and what there is.
        force: train anew even what stands.
        tensorboard: log for TensorBoard into the folders of the stages.
        bar: called with a stage's name and iterations; shows its progress.
    """

    stages: tuple[str, ...] = ("fit", "teacher", "bake", "compensate")
    max_seconds: float = float("inf")
    force: bool = False
    tensorboard: bool = False
    bar: Bar = field(default=lambda name, total: nullcontext(lambda progress: None))


@dataclass(frozen=True, eq=False)
class Training:
    """A run, what it is trained on and how, as every stage needs it."""

    run: Path
    inputs: TrainInputs
    scene: TrainScene
    config: TrainConfig
    options: TrainOptions
    together: Distributed
    deadline: float

    @property
    def device(self) -> str:
        """ "cpu" or "cuda"."""
        return self.together.device.split(":")[0]

    def seconds_left(self) -> float:
        """The same on every process; 0 when time is over."""
        return self.together.run_on_rank0(lambda: max(0.0, self.deadline - time.monotonic()))


def train(
    run: Path, inputs: TrainInputs, scene: TrainScene, config: TrainConfig, options: TrainOptions, together: Distributed
) -> dict[str, StageRecord]:
    """Train what is missing of a run, in the order of the stages; every stage that stands is skipped.

    A training that was interrupted, or that `max_seconds` ended, goes on where it was.

    Returns:
        Records by the stage's name in `options.stages`, up to the first that is not finished.

    Raises:
        InputError: an earlier stage is missing or unfinished, a checkpoint is of another training, memory or disk ran
            out, or training diverged; checkpoints and finished stages stay.
    """
    if "compensate" in options.stages and not scene.template.expression_basis.shape[2]:
        raise InputError(
            "template",
            expected="a body with expressions, which drive the head's blend shapes",
            received="none",
            remedy="build the template on the open body or on SMPL-X, or stop with --until bake",
        )
    training = Training(run, inputs, scene, config, options, together, time.monotonic() + options.max_seconds)
    steps = {"fit": _fit, "teacher": _teacher, "bake": _bake, "compensate": _compensate}
    records: dict[str, StageRecord] = {}
    for name in options.stages:
        if name == "teacher" and not config.teacher:
            continue
        if records and not training.seconds_left():
            break
        records[name] = steps[name](training)
        if not records[name].manifest["numbers"]["finished"]:
            break
    return records


def _fit(training: Training) -> StageRecord:
    return training.together.run_on_rank0(lambda: _fit_alone(training))


def _fit_alone(training: Training) -> StageRecord:
    """The reference fit of the preset, or the one that the user made."""
    run, config = training.run, training.config.preset.fit
    folder, mark = run / FIT_STAGE, run / OWN_FIT
    manifest = read_manifest(folder)
    if manifest is not None and manifest["inputs"].get(TEMPLATE) == training.scene.digests[TEMPLATE]:
        numbers = manifest["numbers"]
        if numbers["finished"] and _own_fit(mark) != manifest["key"]:
            log.info(
                "%s: taken as it stands, %s Gaussians, %s iterations; delete it to have the preset's",
                FIT_STAGE,
                f"{numbers['gaussians']:,}",
                f"{numbers['iterations']:,}",
            )
            return StageRecord(folder, manifest, ran=False)
    with training.options.bar("fit", config.iterations) as progress:
        record = fit(
            run,
            training.inputs.of_frame(training.scene.frame),
            config,
            device=training.device,
            max_seconds=max(training.deadline - time.monotonic(), ONE_STEP),
            force=training.options.force,
            progress=progress,
        )
    atomic_write_text(mark, json.dumps({"fit": record.manifest["key"]}) + "\n")
    return record


def _own_fit(mark: Path) -> str | None:
    try:
        return json.loads(mark.read_text())["fit"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _teacher(training: Training) -> StageRecord:
    preset, needs = training.config.preset, (GAUSSIANS,)
    gaussians = load_bound(_require(training, *needs), faces=training.scene.template.faces)
    config = preset.teacher
    if config.track is not None:
        config = replace(config, track=replace(config.track, reference=training.scene.built_frame, seed=config.seed))

    def work(sequence: AvatarSequence, session: Session) -> tuple[AvatarModel, Progress]:
        return fit_teacher(sequence, gaussians, preset.networks.teacher, config, session)

    return _stage(
        training,
        TEACHER_STAGE,
        config,
        {"networks": preset.networks.teacher},
        needs,
        work,
        lambda folder, model, sequence, session: write_model(folder / Path(TEACHER).name, model),
    )


def _bake(training: Training) -> StageRecord:
    config, preset = training.config, training.config.preset
    needs = (TEACHER,) if config.teacher else (GAUSSIANS,)
    path = _require(training, *needs)

    def work(sequence: AvatarSequence, session: Session) -> tuple[AvatarModel, Progress]:
        teacher = load_avatar(path, sequence.rig) if config.teacher else None
        gaussians = (
            load_bound(path, faces=sequence.rig.template.faces) if teacher is None else (teacher.gaussians.snapshot())
        )
        return bake(sequence, gaussians, preset.student(), preset.bake, session, teacher=teacher)

    return _stage(
        training,
        BAKE_STAGE,
        preset.bake,
        {"student": preset.student()},
        needs,
        work,
        lambda folder, model, sequence, session: write_model(folder / Path(BAKED).name, model),
    )


def _compensate(training: Training) -> StageRecord:
    config, preset = training.config, training.config.preset
    shapes = config.shapes(training.scene.template.expression_basis.shape[2])
    needs = (BAKED, TEACHER) if config.teacher and preset.compensate.init_from_track else (BAKED,)
    path, *teachers = (_require(training, file) for file in needs)
    max_bytes = 1e6 * config.max_megabytes if config.blend_shapes == "pruned" else None

    def work(sequence: AvatarSequence, session: Session) -> tuple[AvatarModel, Progress]:
        teacher = load_avatar(teachers[0], sequence.rig) if teachers else None
        student = load_avatar(path, sequence.rig)
        return compensate(sequence, student, shapes, preset.compensate, session, teacher=teacher)

    return _stage(
        training,
        COMPENSATE_STAGE,
        preset.compensate,
        {"blend_shapes": shapes, "max_bytes": max_bytes},
        needs,
        work,
        lambda folder, model, sequence, session: write_student(
            folder, model, sequence, preset.compensate, max_bytes=max_bytes, context=session.context
        ),
    )


def _require(training: Training, file: str) -> Path:
    """A model of an earlier stage, finished."""
    stage = file.split("/")[0]
    manifest = read_manifest(training.run / stage)
    there = (training.run / file).is_file() and manifest is not None
    if not there or not manifest["numbers"]["finished"]:
        numbers = manifest["numbers"] if there else {}
        raise InputError(
            f"run {training.run}",
            expected=f"a finished {stage}",
            received=f"{numbers['iterations_done']} of {numbers['iterations']} iterations of it" if there else "none",
            remedy="give the same command without --stage, which trains what is missing",
        )
    return training.run / file


def _stage(
    training: Training,
    name: str,
    config: PhotometricConfig,
    parts: Mapping[str, Any],
    needs: Sequence[str],
    work: Callable[[AvatarSequence, Session], tuple[AvatarModel, Progress]],
    write: Callable[[Path, AvatarModel, AvatarSequence, Session], Mapping[str, Any]],
) -> StageRecord:
    """Train one stage unless it stands; the first process writes, the others train with it.

    Args:
        config: of the training. parts: the rest of its configuration. needs: files of the run that it starts from.
        work: trains on all processes. write: writes the models into a folder and gives numbers on them.
    """
    together, run, scene = training.together, training.run, training.scene
    metric = load_metric(training.config.perceptual, device=together.device) if config.weights.perceptual else None
    key_config = {
        "training": config,
        **parts,
        "device": training.device,
        "scale": training.inputs.scale,
        "perceptual": None if metric is None else metric.name,
    }
    digests = {
        **{file: sha256_file(run / file) for file in needs},
        **scene.digests,
        "code": code_digest("smplxpp", "avatar"),
        "torch": version("torch"),
    }
    folder = run / f"{name}_work"
    session = Session(
        folder,
        stage_key(config=key_config, inputs=digests),
        metric,
        together,
        max(training.seconds_left(), ONE_STEP),
        tensorboard=training.options.tensorboard,
        preview=preview_writer(scene.capture, folder),
    )

    def trained(session: Session) -> tuple[AvatarModel, Progress, AvatarSequence]:
        sequence = AvatarSequence(scene.capture, scene.template, device=together.device)
        return (*work(sequence, session), sequence)

    def first(temporary: Path) -> StageOutput:
        together.run_on_rank0(lambda: True)
        with training.options.bar(name, config.iterations) as report:
            model, done, sequence = trained(replace(session, report=report))
        with explain_resource_errors(run):
            keep_logs(folder, temporary)
            numbers = {**write(temporary, model, sequence, session), "processes": together.world_size}
            return stage_output(temporary, model, done, sequence, numbers, overlap=scene.overlap)

    if not together.first:
        if together.run_on_rank0(bool):
            trained(session)
        return together.run_on_rank0(_nothing)
    with own_run_folder(run, (name, "report")):
        if training.options.force:
            shutil.rmtree(folder, ignore_errors=True)
        before = read_manifest(run / name)
        unfinished = before is not None and before.get("numbers", {}).get("finished") is False
        record = run_stage(
            run,
            name,
            first,
            config=key_config,
            inputs=digests,
            seed=config.seed,
            force=training.options.force or unfinished,
        )
        if not record.ran:
            together.run_on_rank0(lambda: False)
        if record.manifest["numbers"]["finished"]:
            shutil.rmtree(folder, ignore_errors=True)
    return together.run_on_rank0(lambda: record)


def _nothing() -> Any:
    """For the processes that only hear what the first one says."""
    raise AssertionError


def with_perceptual(preset: TrainingPreset) -> TrainingPreset:
    """The preset with the paper's weight of the perceptual term where it has none."""
    weight = ReconstructionWeights().perceptual
    return _each(
        preset,
        lambda config: {"weights": replace(config.weights, perceptual=config.weights.perceptual or weight)},
    )


def with_batch(preset: TrainingPreset, items: int | None = None, *, least: int = 1) -> TrainingPreset:
    """The preset with `items` poses in a step of every training (None: its own), and at least `least`."""
    return _each(preset, lambda config: {"poses_per_step": max(least, items or config.poses_per_step)})


def _each(preset: TrainingPreset, changes: Callable[[PhotometricConfig], Mapping[str, Any]]) -> TrainingPreset:
    """The preset with changes of the three trainings."""
    trainings = {name: getattr(preset, name) for name in ("teacher", "bake", "compensate")}
    return replace(preset, **{name: replace(config, **changes(config)) for name, config in trainings.items()})
