"""Stage 66: the poses of the training frames, refined on the photographs of the training cameras."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from avatar.data.sequence import AvatarSequence, SequenceConfig
from avatar.evaluation.input_protocol import TRACKED
from avatar.gaussians.bound_file import save_bound
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.refine import Refinement, refine_held_out, refine_poses
from pipelines.runs import gates
from pipelines.runs.code import TRAINING
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import (
    REFINE_STAGE,
    REFINED_CAMERAS,
    REFINED_HELD_OUT_PARAMS,
    REFINED_PARAMS,
    REGISTERED_PARAMS,
)
from pipelines.runs.stage import Stage, StageOutput, StageRecord, run_stage
from pipelines.stages.params_in_use import params_in_use, params_to_begin_with, told_of_given
from pipelines.stages.refine_pictures import write_pictures
from pipelines.stages.said_of_inputs import SaidOfInputs, path_of_params
from pipelines.stages.scene import TrainInputs, TrainScene, of_protocol, open_cameras, open_scene
from pipelines.stages.usable import with_cameras
from smplxpp.capture import Capture
from smplxpp.capture.writers.metadata import write_plain_cameras_json
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.files.array_file import write_arrays
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import jsonable
from smplxpp.core.params import ARRAY_NAMES, BodyParams
from smplxpp.register.kinematics import BodyState
from smplxpp.template.template import Template

Choice = Literal["auto", "on", "off"]
log = logging.getLogger(__name__)


def wants_refinement(run: Path, inputs: TrainInputs, choice: Choice) -> bool:
    """Whether a training refines poses first: "auto" where parameters are estimated, or were refined before.

    Raises:
        InputError: "off" in a run that holds refined parameters, which everything in it would take.
    """
    stands = params_in_use(run, inputs.params) == run / REFINED_PARAMS
    if choice == "off" and stands:
        raise InputError(
            f"run {run}",
            expected="no refined parameters, with --refine-poses off",
            received=REFINED_PARAMS,
            remedy=f"delete {run / REFINE_STAGE}, or train in another run folder",
        )
    if choice != "auto":
        return choice == "on"
    begins = params_to_begin_with(run, inputs.params)
    if stands or begins == run / REGISTERED_PARAMS:
        return True
    capture = open_cameras(of_protocol(run, inputs))[0]
    # Of these parameters alone, whatever the template was built with.
    return SaidOfInputs.of(capture).given_parameters(path_of_params(capture.recording.params)) == TRACKED


def refine(
    run: Path,
    inputs: TrainInputs,
    config: RefineConfig,
    *,
    held_out: bool = True,
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> StageRecord:
    """Refine the poses of a run's capture, made in one go; skipped while template, capture, code and choices stand.

    `params.npz` has a row for every frame: training frames are refined, all others keep what they had.
    `cameras.json`, if cameras are corrected too, has the training cameras; all that takes the parameters takes it.
    `params_held_out.npz` has the held-out frames refined, too, on training cameras alone and with everything else as
    the training frames left it. Nothing is trained with it: an evaluation can print both.

    Args:
        inputs: with the parameters that refinement begins with. held_out: refine held-out frames apart.
        force: refine even if the stage stands. progress: called with the share of the frames' evaluations.

    Raises:
        InputError: see `open_scene`.
    """
    scene = open_scene(run, inputs, refined=False)
    stage = Stage(
        name=REFINE_STAGE,
        config={"refinement": config, "reference": scene.frame, "scale": inputs.scale, "held_out": held_out},
        inputs=scene.digests,
        code=(__name__,),
        libraries=TRAINING,
        seed=config.seed,
    )
    with own_run_folder(run, (REFINE_STAGE, "report")):
        return run_stage(
            run, stage, lambda folder: _work(scene, inputs, config, folder, progress, held_out=held_out), force=force
        )


def _work(
    scene: TrainScene,
    inputs: TrainInputs,
    config: RefineConfig,
    folder: Path,
    progress: ProgressCallback,
    *,
    held_out: bool,
) -> StageOutput:
    begin = time.perf_counter()
    sequence = AvatarSequence(scene.capture, scene.template, SequenceConfig(normals=False))
    found = refine_poses(sequence, config, reference=scene.frame, progress=progress)
    if found.kept:
        log.warning("frames %s keep their poses: refined ones fit worse", " ".join(map(str, found.kept)))
    capture, template = scene.capture, scene.template
    _write_params(folder / Path(REFINED_PARAMS).name, _rows(capture, template, [found]))
    numbers: dict[str, Any] = {"training": figures(found)}
    if found.cameras:
        corrected = {name: replace(capture.cameras[name], cam_from_world=pose) for name, pose in found.cameras.items()}
        write_plain_cameras_json(folder / Path(REFINED_CAMERAS).name, corrected)
        sequence.capture = with_cameras(capture, found.cameras)
    if held_out and capture.splits.novel_pose_frames:
        apart = refine_held_out(sequence, found.gaussians, config)
        _write_params(folder / Path(REFINED_HELD_OUT_PARAMS).name, _rows(capture, template, [found, apart]))
        numbers["held_out"] = figures(apart)
    save_bound(found.gaussians, folder / "gaussians.safetensors")
    atomic_write_text(folder / "refinement.json", json.dumps(jsonable(numbers), indent=1))
    looks = len(found.frames) * len(found.history)
    splits = capture.splits
    return StageOutput(
        [
            gates.SILHOUETTE.check(
                "template's silhouette on the masks",
                scene.overlap,
                explanation="before refinement, mean over some training views; low: poses too far off to refine",
            ),
            gates.REFINED.check(
                "frames whose photographs fit better than before",
                1.0 - len(found.kept) / len(found.frames),
                explanation="the others keep their poses",
            ),
            gates.REFINED_LOSS.check(
                "loss of the photographs against the start",
                float(found.after.mean() / max(found.before.mean(), 1e-12)),
                explanation="over the pixels of what sits firmly on the body, all training frames and cameras",
            ),
        ],
        {
            **numbers,
            "given": told_of_given(inputs.params),
            "pictures": write_pictures(folder, sequence, found),
            "iterations": looks,
            "iterations_done": looks,
            "finished": True,
            "seconds_of_steps": time.perf_counter() - begin,
            "seen": {"cameras": sorted(splits.train_cameras), "frames": sorted(splits.train_frames)},
        },
    )


def figures(found: Refinement) -> dict[str, Any]:
    """What a refinement changed, as JSON values: loss, turn and shift of every frame, turn of every joint."""
    return {
        "frames": list(found.frames),
        "loss_before": found.before.tolist(),
        "loss_after": found.after.tolist(),
        "turned_degrees": found.turned.mean(axis=1).tolist(),
        "moved_mm": found.moved.tolist(),
        "kept": list(found.kept),
        "joints": dict(zip(found.joints, found.turned.mean(axis=0).tolist(), strict=True)),
        "passes": [vars(one) for one in found.history],
    }


def _rows(capture: Capture, template: Template, found: list[Refinement]) -> Mapping[int, BodyParams]:
    """Parameters of every frame that has any: refined ones, or those of the capture with hands complete."""
    source, rows = capture.recording.params, {}
    assert source is not None, "the scene was opened with parameters"
    for frame in map(int, source.frames()):
        try:
            given = source.read(frame)
        except InputError:
            continue  # a damaged row stays one
        complete = BodyState.of_params(template.body, given).to_params(template.body, fps=given.fps)
        rows[frame] = replace(complete, betas=given.betas)
    for one in found:
        rows |= {frame: one.params.frame(row) for row, frame in enumerate(one.frames)}
    return rows


def _write_params(path: Path, rows: Mapping[int, BodyParams]) -> None:
    """Write stacked parameters, row = frame number; rows of frames without any are NaN, which readers leave out."""
    first = next(iter(rows.values()))
    arrays: dict[str, np.ndarray] = {}
    for name in ARRAY_NAMES:
        width = max(getattr(row, name).shape[1] for row in rows.values())
        arrays[name] = np.full((max(rows) + 1, width), np.nan)
        for frame, row in rows.items():
            value = getattr(row, name)[0]
            arrays[name][frame] = np.pad(value, (0, width - len(value)))
    arrays["flat_hand_mean"] = np.asarray(np.bool_(True))
    if first.fps is not None:
        arrays["fps"] = np.asarray(np.float64(first.fps))
    write_arrays(path, arrays)
