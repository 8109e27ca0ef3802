"""The stage that registers the body to a capture or a scan; `smplxpp.build.register` does the work."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.artefacts import LOCATED_FILES, load_located
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import LANDMARKS_FILE, LOCATE_STAGE, REGISTER_STAGE
from pipelines.runs.stage import MANIFEST, Stage, StageRecord, run_stage
from pipelines.stages.build_config import RegisterInputs, save_register
from smplxpp.body import BodyModel, load_body
from smplxpp.build.observe import Observed, observe
from smplxpp.build.register import register_observed, stacked_rows
from smplxpp.capture import Capture
from smplxpp.core import ARRAY_NAMES, ProgressCallback, StageOutput, ignore_progress
from smplxpp.core.files.json_file import jsonable
from smplxpp.register import Observations, RegisterConfig


def register_capture(
    run: Path,
    inputs: RegisterInputs,
    *,
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> StageRecord:
    """Register the body, unless the stage is up to date, in a run whose lock the caller holds.

    Landmarks in the run, placed by hand on the reference frame's scan, are observations too.

    Args:
        run: folder of the run.
        inputs: observations to register the body to.
        force: register again even if the stage is up to date.
        progress: called with the name of the current step and its share done.

    Raises:
        InputError: inputs without observations, or no frame that could be registered.
    """
    # Collect the observations: keypoints, masks, scans, landmarks and, where a scan was located, its pose.
    config = RegisterConfig(seed=inputs.seed)
    body = load_body(inputs.body)
    placed, located = run / LANDMARKS_FILE, run / LOCATE_STAGE
    observed = observe(
        inputs,
        body,
        landmarks=placed if placed.exists() else None,
        located=partial(load_located, located) if (located / MANIFEST).exists() else None,
    )
    # The key covers contents of small files, and names and sizes of the many large ones.
    digests = observed_digests(observed, inputs, landmarks=placed if observed.placed else None)
    if observed.found is not None:
        digests |= {f"{LOCATE_STAGE}/{file}": sha256_file(located / file) for file in LOCATED_FILES}
    observations = observed.observations
    # Frames are part of the key: a registration of other frames is another result.
    choices = {
        "register": config,
        "frames": observations.frames,
        "shape_frames": observations.shape_frames,
        "reference": inputs.frame,
        "start": observations.initial is not None,
        "scans": {"units": inputs.units, "up": inputs.up, "label_set": inputs.label_set},
    }
    stage = Stage(name=REGISTER_STAGE, config=choices, inputs=digests, code=(__name__,))
    # The record is written before the work, so that an interrupted run knows its inputs.
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
    # Save the fit, the initial parameters it started from (for the report), and the confidence of each joint.
    registration, output = register_observed(observed, body, at=inputs.frame, config=config, progress=progress)
    fit, observations = registration.fit, registration.observations
    _save(folder / "params.npz", stacked_rows(fit.frames, fit.params))
    if observations.initial is not None:
        _save(folder / "initial.npz", stacked_rows(observations.frames, observations.initial))
    np.savez(
        folder / "confidence.npz",
        frames=np.array(fit.frames),
        joint_names=np.array(body.joint_names),
        confidence=fit.confidence,
    )
    (folder / "registration.json").write_text(json.dumps(jsonable(registration.summary), indent=1) + "\n")
    return output


def _save(path: Path, arrays: dict[str, Any]) -> None:
    np.savez_compressed(path, **arrays)


def observed_digests(observed: Observed, inputs: RegisterInputs, *, landmarks: Path | None) -> dict[str, str]:
    """Return SHA-256 by name of everything that a registration reads.

    Masks and label maps count by their names and sizes, because a sequence has gigabytes of them.
    """
    digests = _seen_digests(observed.observations, observed.capture)
    digests |= {f"scan of frame {frame}": sha256_file(path) for frame, path in _files(observed.scans).items()}
    if inputs.body is not None:
        digests["body"] = sha256_file(inputs.body)
    if inputs.shape is not None:
        digests["shape"] = sha256_file(inputs.shape)
    if landmarks is not None:
        digests["landmarks"] = sha256_file(landmarks)
    if isinstance(inputs.labels, Path):
        digests["labels"] = sha256_file(inputs.labels)
    return digests


def _files(scans: Mapping[int, Any]) -> dict[int, Path]:
    return {frame: scan for frame, scan in scans.items() if isinstance(scan, Path)}


def _seen_digests(observations: Observations, capture: Capture | None) -> dict[str, str]:
    """SHA-256 of cameras, keypoints and the fit to start from, and of the names and sizes of masks and label maps."""
    cameras, points, start, files = (hashlib.sha256() for _ in range(4))
    # Hash cameras, keypoints and initial parameters by content: all of them are small.
    for name, camera in observations.cameras.items():
        cameras.update(f"{name} {camera.width} {camera.height}".encode())
        cameras.update(camera.K.tobytes() + camera.cam_from_world.tobytes())
    for name, found in observations.keypoints.items():
        points.update(f"{name} {found.names}".encode())
        for array in (found.frames, found.points, found.confidence):
            points.update(np.ascontiguousarray(array).tobytes())
    if observations.initial is not None:
        for key in ARRAY_NAMES:
            start.update(np.ascontiguousarray(getattr(observations.initial, key)).tobytes())
    # Masks and label maps are large: hash their names and sizes.
    if capture is not None:
        for name in observations.cameras:
            for frame in observations.frames:
                for kind in ("mask", "label"):
                    path = capture.file(name, frame, kind)
                    if path is not None:
                        files.update(f"{kind} {name} {frame} {path.name} {path.stat().st_size}\n".encode())
    return {
        "capture/cameras": cameras.hexdigest(),
        "capture/keypoints": points.hexdigest(),
        "capture/fit to start from": start.hexdigest(),
        "capture/names and sizes of masks and label maps": files.hexdigest(),
    }
