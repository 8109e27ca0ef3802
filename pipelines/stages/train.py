"""The training of a run: fit, teacher, bake and compensation, each a stage that is made once."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from avatar.losses.perceptual import load_metric
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.training.engine.loop import Progress
from avatar.training.engine.photometric_task import PhotometricConfig
from avatar.training.engine.processes import Distributed
from avatar.training.presets import TrainingPreset, with_local_shapes
from avatar.training.refinement.config import RefineConfig
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import (
    BAKE_STAGE,
    CLOTH_STAGE,
    COMPENSATE_STAGE,
    FIT_STAGE,
    PARAMS,
    REFINE_STAGE,
    TEACHER_STAGE,
    TEMPLATE,
)
from pipelines.runs.stage import StageRecord, is_finished, read_manifest, require_stage
from pipelines.stages.bake import BakeStage
from pipelines.stages.cloth import ClothConfig, ClothStage, why_none
from pipelines.stages.compensate import CompensateStage
from pipelines.stages.fit import FitStage
from pipelines.stages.held_out import refuse_seen
from pipelines.stages.models import ModelStage, Trainer, TrainOptions
from pipelines.stages.refine import refine
from pipelines.stages.scene import TrainInputs, TrainScene, open_scene
from pipelines.stages.teacher import TeacherStage
from pipelines.stages.usable import normal_maps
from smplxpp.capture import Capture
from smplxpp.core.errors import InputError
from smplxpp.core.validation import require_known
from smplxpp.template.template import BODY_PART

log = logging.getLogger(__name__)
Shapes = Literal["full", "local", "pruned"]
STEPS = ("refine", "fit", "teacher", "cloth", "bake", "compensate")
"""The steps of a training in their order, as the command line calls them."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What is trained.

    Attributes:
        preset: configurations of all stages.
        refine: how poses are refined first; None: they are not.
        teacher: bake from a teacher; False: from the photographs alone.
        perceptual: metric of the perceptual term: "lpips", "st-lpips" or "none".
        blend_shapes: "full": every Gaussian has its own columns (the paper); "local": 256 parts of the Gaussians have
            coefficients of their own, and 16 columns; "pruned": full, and the compact file keeps those that fit.
        max_megabytes: of the compact file of a pruned student.
        cloth: which clothes are simulated in new motion; None: none is.
    """

    preset: TrainingPreset
    refine: RefineConfig | None = None
    teacher: bool = True
    perceptual: str = "none"
    blend_shapes: Shapes = "full"
    max_megabytes: float = 20.0
    cloth: ClothConfig | None = field(default_factory=ClothConfig)

    @property
    def shapes(self) -> BlendShapeConfig:
        """The blend shapes of the student."""
        shapes = self.preset.blend_shapes
        return with_local_shapes(shapes) if self.blend_shapes == "local" else shapes

    @property
    def max_bytes(self) -> float | None:
        """The compact file has at most as many bytes; None where it has all blend shapes."""
        return 1e6 * self.max_megabytes if self.blend_shapes == "pruned" else None


def model_stages(config: TrainConfig) -> dict[str, ModelStage]:
    """The stages of a training by their steps."""
    preset = config.preset
    fit = FitStage(name=FIT_STAGE, config=preset.fit)
    teacher = TeacherStage(name=TEACHER_STAGE, gaussians=fit, networks=preset.networks.teacher, config=preset.teacher)
    cloth = None
    if config.teacher and config.cloth is not None:
        cloth = ClothStage(name=CLOTH_STAGE, teacher=teacher, config=config.cloth)
    bake = BakeStage(
        name=BAKE_STAGE,
        source=teacher if config.teacher else fit,
        cloth=cloth,
        student=preset.student(),
        config=preset.bake,
    )
    compensate = CompensateStage(
        name=COMPENSATE_STAGE,
        student=bake,
        teacher=teacher if config.teacher and preset.compensate.init_from_track else None,
        cloth=cloth,
        shapes=config.shapes,
        config=preset.compensate,
        max_bytes=config.max_bytes,
    )
    stages: dict[str, ModelStage] = {"fit": fit}
    if config.teacher:
        stages["teacher"] = teacher
        if cloth is not None:
            stages["cloth"] = cloth
    return {**stages, "bake": bake, "compensate": compensate}


def train(
    run: Path,
    inputs: TrainInputs,
    scene: TrainScene,
    config: TrainConfig,
    options: TrainOptions,
    together: Distributed,
    *,
    steps: tuple[str, ...] = STEPS,
) -> dict[str, StageRecord]:
    """Train what is missing of a run, in the order of the steps; every stage that stands is skipped.

    A training that was interrupted, or that the limit of time ended, goes on where it was.

    Args:
        scene: opened with the parameters that stand; opened anew where poses are refined first.
        steps: of `STEPS`, in this order; the stages of those before the first must stand.

    Returns:
        Records by step, up to the first that is not finished.

    Raises:
        InputError: an earlier stage is missing or unfinished or saw what is held out, a checkpoint is of another
            training, memory or disk ran out, or training diverged; checkpoints and finished stages stay.
    """
    if "compensate" in steps and not scene.template.body.num_expressions:
        raise InputError(
            "template",
            expected="a body with expressions, which drive the head's blend shapes",
            received="none",
            remedy="build the template on the open body or on SMPL-X, or stop with --until bake",
        )
    if "cloth" in steps and config.cloth is not None and config.cloth.parts:
        names = [name for name in scene.template.part_names if name != BODY_PART]
        require_known("loose parts", config.cloth.parts, names)
        load_params_of_run(run)
    _tell_of_clothes(run, scene, config, steps)
    records: dict[str, StageRecord] = {}
    how = config.refine
    if "refine" in steps and how is not None:
        begin = time.monotonic()
        records["refine"] = together.run_on_rank0(lambda: _refined(run, inputs, how, options))
        scene = together.run_on_rank0(lambda: open_scene(run, inputs))
        left = options.max_seconds - (time.monotonic() - begin)
        options = replace(options, max_seconds=together.run_on_rank0(lambda: max(0.0, left)))
    _tell_of_normals(scene.capture, config, steps)
    metric = load_metric(config.perceptual, device=together.device)
    trainer = Trainer(run, scene, options, together, scale=inputs.scale, perceptual=metric)
    stages = model_stages(config)
    by_hand = together.run_on_rank0(lambda: _fit_by_hand(run, scene, stages["fit"]))
    if by_hand is not None:
        trainer.take(stages["fit"], by_hand)
    for step in steps:
        if step not in stages:
            continue
        if records and not trainer.seconds_left():
            break
        records[step] = by_hand if step == "fit" and by_hand is not None else trainer.make(stages[step])
        if not records[step].finished:
            break
    return records


def _refined(run: Path, inputs: TrainInputs, config: RefineConfig, options: TrainOptions) -> StageRecord:
    """Refine the poses of the training frames, and show the percentage done in a bar."""
    with options.bar(REFINE_STAGE, 0) as report:

        def show(step: str, share: float) -> None:
            report(Progress(round(100 * share), 100, 0.0, 0.0))

        return refine(run, inputs, config, force=options.force, progress=show)


def _tell_of_clothes(run: Path, scene: TrainScene, config: TrainConfig, steps: tuple[str, ...]) -> None:
    """Warn before all work where a preset that follows the surface cannot simulate: loose clothes look worse then."""
    follows = config.teacher and config.preset.teacher.track is not None
    if config.cloth is None or not follows or not {"teacher", "cloth"} & set(steps):
        return
    known = (run / PARAMS).is_file()
    why = why_none(scene.template, config.cloth, pose_known=known, followed=follows, fps=scene.capture.fps)
    if why is not None:
        log.warning("loose clothes: %s", why)


def _tell_of_normals(capture: Capture, config: TrainConfig, steps: tuple[str, ...]) -> None:
    """Say once what a loss with a normal term goes without."""
    trainings = [getattr(config.preset, name) for name in ("teacher", "bake", "compensate") if name in steps]
    there, views = normal_maps(capture)
    if there == views or not any(training.weights.normal for training in trainings):
        return
    if there:
        log.info("%d of %d training views have a normal map: the loss has no normal term in the others", there, views)
    elif config.teacher and config.preset.teacher.track is not None and any(t.surface_normals for t in trainings):
        log.info("capture %s has no normal maps: those of followed clothes stand for them", capture.name)
    else:
        log.info("capture %s has no normal maps: the loss has no normal term", capture.name)


def _fit_by_hand(run: Path, scene: TrainScene, fit: ModelStage) -> StageRecord | None:
    """The fit of this template that the user made, which is never replaced.

    Raises:
        InputError: it saw a camera or a frame that this training holds out.
    """
    manifest = read_manifest(run / fit.name)
    if manifest is None or manifest["inputs"].get(TEMPLATE) != scene.digests[TEMPLATE]:
        return None
    numbers = manifest["numbers"]
    if not (numbers.get("by_hand") and is_finished(manifest)):
        return None
    anew = f"fit without them (smplxpp fit), or delete {run / fit.name}"
    refuse_seen(run, (fit.name,), scene.capture.splits, anew=anew)
    record = require_stage(run, fit.name, remedy=f"fit it anew (smplxpp fit), or delete {run / fit.name}")
    log.info(
        "%s: taken as it stands, %s Gaussians, %s iterations; delete it to have the preset's",
        fit.name,
        numbers.get("gaussians"),
        numbers.get("iterations"),
    )
    return record


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
