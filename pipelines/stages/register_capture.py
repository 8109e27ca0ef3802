"""Stage 05: the body registered to all frames of a capture, or to a scan."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.code import sha256_file
from pipelines.runs.layout import LANDMARKS_FILE, LOCATE_STAGE, REGISTER_STAGE
from pipelines.runs.stage import Stage, StageOutput, StageRecord, run_stage
from pipelines.stages.observe import Observed, observe
from pipelines.stages.register_config import RegisterInputs, save_register
from pipelines.stages.registration import registration_checks, stacked_rows, summary
from smplxpp.body import BodyModel, load_body
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.files.json_file import jsonable
from smplxpp.register import RegisterConfig, follow, lost_frames, register


def register_capture(
    run: Path,
    inputs: RegisterInputs,
    *,
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> StageRecord:
    """Register the body, unless the stage stands, and keep the stage in a run that the caller owns.

    Landmarks that lie in the run, placed by hand on the reference frame's scan, are observations too.

    Raises:
        InputError: inputs that nothing can be registered to, or not a single frame that was.
    """
    config = RegisterConfig(seed=inputs.seed)
    body = load_body(inputs.body)
    placed, located = run / LANDMARKS_FILE, run / LOCATE_STAGE
    observed = observe(
        inputs,
        body,
        landmarks=placed if placed.exists() else None,
        located=located if (located / "manifest.json").exists() else None,
    )
    digests = dict(observed.digests)
    if inputs.body is not None:
        digests["body"] = sha256_file(inputs.body)
    observations = observed.observations
    choices = {
        "register": config,
        "frames": observations.frames,
        "shape_frames": observations.shape_frames,
        "reference": inputs.frame,
        "start": observations.initial is not None,
        "scans": {"units": inputs.units, "up": inputs.up, "label_set": inputs.label_set},
    }
    stage = Stage(name=REGISTER_STAGE, config=choices, inputs=digests, code=(__name__,))
    save_register(run, inputs)
    work = partial(_work, observed=observed, inputs=inputs, body=body, config=config, progress=progress)
    return run_stage(run, stage, work, force=force)


def _work(
    folder: Path,
    *,
    observed: Observed,
    inputs: RegisterInputs,
    body: BodyModel,
    config: RegisterConfig,
    progress: ProgressCallback,
) -> StageOutput:
    """Write `params.npz`, `initial.npz`, `confidence.npz` and `registration.json`."""
    observations = observed.observations
    lost: tuple[str, ...] = ()
    if observed.found is not None and not observations.keypoints:
        initial = follow(body, observations, observed.found, at=inputs.frame, config=config, progress=progress)
        lost = lost_frames(body, observations, initial, at=inputs.frame)
        observations = replace(observations, initial=initial)
    fit = register(body, observations, config, progress=progress)
    if not fit.frames:
        raise InputError(
            "registration",
            expected="a body in at least one frame",
            received=f"none in {len(observations.frames)} frames: {'; '.join(fit.notes) or 'nobody was seen'}",
            remedy="look at the inputs with `smplxpp capture check`",
        )
    _save(folder / "params.npz", stacked_rows(fit.frames, fit.params))
    if observations.initial is not None:
        _save(folder / "initial.npz", stacked_rows(observations.frames, observations.initial))
    np.savez(
        folder / "confidence.npz",
        frames=np.array(fit.frames),
        joint_names=np.array(body.joint_names),
        confidence=fit.confidence,
    )
    problems = (*observed.all_problems(), *fit.notes, *lost)
    content = summary(body, observations, fit, problems)
    (folder / "registration.json").write_text(json.dumps(jsonable(content), indent=1) + "\n")
    medians = {
        when: {name: float(np.nanmedian(values)) for name, values in found.items() if np.isfinite(values).any()}
        for when, found in content["residuals"].items()
    }
    shape_frames = observations.shape_frames or observations.frames
    numbers = {
        "frames": len(fit.frames),
        "absent": content["absent"],
        "residuals": medians,
        "problems": len(problems),
        "seen": {"cameras": list(observations.cameras), "frames": list(shape_frames)},
    }
    return StageOutput(registration_checks(observations, fit), numbers)


def _save(path: Path, arrays: dict[str, Any]) -> None:
    np.savez_compressed(path, **arrays)
