"""The training of a run: fit, teacher, bake and compensation, each a stage that is made once."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path

from avatar.losses.perceptual_weights import load_metric
from avatar.training.engine.loop import Progress
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import check_memory
from avatar.training.recipe import STEPS, Recipe, check_training, memory_on, note_missing_normals
from avatar.training.refinement.config import RefineConfig
from avatar.training.scene import TrainScene
from pipelines.runs import layout
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import PARAMS, TEMPLATE
from pipelines.runs.stage import StageRecord, is_finished, read_manifest, require_stage
from pipelines.stages.bake import BakeStage
from pipelines.stages.cloth import ClothStage
from pipelines.stages.compensate import CompensateStage
from pipelines.stages.fit import FitStage
from pipelines.stages.models import ModelStage, Trainer, TrainOptions
from pipelines.stages.refine import help_refine, refine
from pipelines.stages.scene import TrainInputs, open_scene, refuse_seen
from pipelines.stages.teacher import TeacherStage

log = logging.getLogger(__name__)


def model_stages(config: Recipe) -> dict[str, ModelStage]:
    """Return the model stages of a training, by the name of their step."""
    preset = config.preset
    # Stages refer to the stages that they read, which makes a graph: fit -> teacher -> cloth -> bake -> compensate.
    fit = FitStage(name=layout.FIT_STAGE, config=preset.fit)
    teacher = TeacherStage(
        name=layout.TEACHER_STAGE, gaussians=fit, networks=preset.networks.teacher, config=preset.teacher
    )
    cloth = None
    # Garments are calibrated on the cloth that the teacher tracked; without a teacher there are none.
    if config.teacher and config.cloth is not None:
        cloth = ClothStage(name=layout.CLOTH_STAGE, teacher=teacher, config=config.cloth)
    bake = BakeStage(
        name=layout.BAKE_STAGE,
        source=teacher if config.teacher else fit,
        cloth=cloth,
        student=preset.student(),
        config=preset.bake,
    )
    # Blend shapes start from the teacher's tracked surface, if the preset asks for it.
    compensate = CompensateStage(
        name=layout.COMPENSATE_STAGE,
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
    config: Recipe,
    options: TrainOptions,
    together: Distributed,
    *,
    steps: tuple[str, ...] = STEPS,
) -> dict[str, StageRecord]:
    """Train the missing stages of a run, in the order of the steps, and skip those that are up to date.

    A training that was interrupted, or that reached its time limit, resumes from its checkpoint.

    Args:
        run: folder of the run.
        inputs: sources of the views.
        scene: the opened scene, without refined poses where they are refined now; then it is opened again.
        config: configuration of all stages.
        options: limits and display.
        together: processes that train together.
        steps: a subsequence of `STEPS`; stages before the first one must be finished.

    Returns:
        Records by step, up to the first that is not finished.

    Raises:
        InputError: an earlier stage is missing or unfinished or saw what is held out, a checkpoint is of another
            training, memory or disk ran out, or training diverged; checkpoints and finished stages stay.
    """
    # Refuse a training that cannot succeed before anything is written.
    check_training(scene, config, steps, pose_known=(run / PARAMS).is_file())
    if together.device.startswith("cuda"):
        check_memory(memory_on(scene.capture, config, steps), together.device)
    if "cloth" in steps and config.cloth is not None and config.cloth.parts:
        load_params_of_run(run)  # parts that the user named are simulated, so their pose has to be readable
    records: dict[str, StageRecord] = {}
    how = config.refine
    # Refinement changes poses and cameras, so that the scene is opened again. Its time counts against the limit, which
    # rank 0 measures for all.
    if "refine" in steps and how is not None:
        begin, start = time.monotonic(), scene
        records["refine"] = _refined(run, inputs, start, how, options, together)
        if not records["refine"].finished:
            return records
        scene = together.run_on_all(lambda: open_scene(run, inputs, before=start), lambda opened: opened.digests)
        left = options.max_seconds - (time.monotonic() - begin)
        options = replace(options, max_seconds=together.run_on_rank0(lambda: max(0.0, left)))
    # Models of one run share the trainer: its scene, metric and deadline.
    note_missing_normals(scene.capture, config, steps)
    metric = load_metric(config.perceptual, device=together.device)
    trainer = Trainer(run, scene, options, together, scale=inputs.scale, perceptual=metric)
    stages = model_stages(config)
    # A fit made by `smplxpp fit` has another key than the preset's, but takes its place.
    by_hand = together.run_on_rank0(lambda: _fit_by_hand(run, scene, stages["fit"]), kinds=(StageRecord,))
    if by_hand is not None:
        trainer.take(stages["fit"], by_hand)
    for step in steps:
        if step not in stages:
            continue
        # Out of time: stop between stages, but never before the first.
        if records and not trainer.seconds_left():
            break
        records[step] = by_hand if step == "fit" and by_hand is not None else trainer.make(stages[step])
        if not records[step].finished:
            break
    return records


def _refined(
    run: Path,
    inputs: TrainInputs,
    scene: TrainScene,
    config: RefineConfig,
    options: TrainOptions,
    together: Distributed,
) -> StageRecord:
    """Refine the poses of the training frames, with all processes, and show the percentage done in a bar."""
    until = time.monotonic() + options.max_seconds

    def stop() -> bool:
        return time.monotonic() > until

    def whole() -> StageRecord:
        with options.bar(layout.REFINE_STAGE, 0) as report:

            def show(step: str, share: float) -> None:
                report(Progress(round(100 * share), 100, 0.0, 0.0))

            return refine(
                run, inputs, config, scene=scene, force=options.force, progress=show, stop=stop, device=together.device
            )

    # Processes share the chunks of a long take, see `Board`; the first one ends the stage.
    if len(scene.capture.splits.train_frames) > config.chunk_frames and together.world_size > 1 and not options.force:
        together.run_on_rank0(lambda: help_refine(run, inputs, config, scene=scene, stop=lambda: True))
        together.share_out(
            range(together.world_size),
            lambda _: help_refine(run, inputs, config, scene=scene, stop=stop, device=together.device),
        )
    return together.run_on_rank0(whole, kinds=(StageRecord,))


def _fit_by_hand(run: Path, scene: TrainScene, fit: ModelStage) -> StageRecord | None:
    """Return the record of a fit that the user made for this template; it is never replaced. None without one.

    Raises:
        InputError: it saw a camera or a frame that this training holds out.
    """
    # A fit of another template has Gaussians bound to other triangles.
    manifest = read_manifest(run / fit.name)
    if manifest is None or manifest["inputs"].get(TEMPLATE) != scene.digests[TEMPLATE]:
        return None
    numbers = manifest["numbers"]
    if not (numbers.get("by_hand") and is_finished(manifest)):
        return None
    remedy = f"fit without them (smplxpp fit), or delete {run / fit.name}"
    refuse_seen(run, (fit.name,), scene.capture.splits, remedy=remedy)
    record = require_stage(run, fit.name, remedy=f"fit again (smplxpp fit), or delete {run / fit.name}")
    log.info(
        "%s: taken as it stands, %s Gaussians, %s iterations; delete it to have the preset's",
        fit.name,
        numbers.get("gaussians"),
        numbers.get("iterations"),
    )
    return record
