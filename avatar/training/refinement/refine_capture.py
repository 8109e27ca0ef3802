"""Refinement of a whole capture: training frames, held-out frames apart, and the files that later trainings read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data.sequence import AvatarSequence, SequenceConfig
from avatar.gaussians.tensor_file import save_bound
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.refine import Refinement, refine_held_out, refine_poses
from avatar.training.scene import TrainScene, with_cameras
from smplxpp.capture import Capture, read_cameras
from smplxpp.capture.sources import find_params
from smplxpp.capture.writers import write_plain_cameras_json
from smplxpp.core import ARRAY_NAMES, BodyParams, InputError, ProgressCallback, ignore_progress
from smplxpp.core.files.array_file import write_arrays
from smplxpp.register import BodyState
from smplxpp.template.template import Template

PARAMS_FILE, HELD_OUT_PARAMS_FILE, CAMERAS_FILE = "params.npz", "params_held_out.npz", "cameras.json"
GAUSSIANS_FILE = "gaussians.safetensors"
TRAINING_STATE, HELD_OUT_STATE = "training_frames.npz", "held_out_frames.npz"


@dataclass(frozen=True, eq=False)
class RefinedCapture:
    """Poses of a capture after refinement.

    Attributes:
        sequence: the capture that was refined, with the corrected cameras if there are any.
        training: refinement of the training frames.
        held_out: refinement of the held-out frames, for evaluations alone; None where there was none.
    """

    sequence: AvatarSequence
    training: Refinement
    held_out: Refinement | None

    def figures(self) -> dict[str, Any]:
        """Return what the refinements changed, as JSON values."""
        out = {"training": refinement_figures(self.training)}
        return out if self.held_out is None else {**out, "held_out": refinement_figures(self.held_out)}


def refine_capture(
    scene: TrainScene,
    config: RefineConfig,
    folder: Path,
    *,
    held_out: bool = True,
    work: Path | None = None,
    progress: ProgressCallback = ignore_progress,
    stop: Callable[[], bool] = lambda: False,
    device: str = "cpu",
) -> RefinedCapture:
    """Refine the poses of a capture on the photographs of its training cameras, and write them.

    `params.npz` has a row for each frame: training frames are refined, all others keep what they had. `cameras.json`
    has the training cameras if they were corrected too. `params_held_out.npz` has the held-out frames refined as well,
    on training cameras alone and with everything else as the training frames left it; no model is trained with it.
    `gaussians.safetensors` has the colours that the refinement learned.

    Args:
        scene: opened with the parameters that refinement begins with.
        config: choices of the refinement.
        folder: an existing folder for the files.
        held_out: whether held-out frames are refined too.
        work: folder of the state, from which the same call continues after a kill, and which any number of processes
            that make it at the same time share; None: none is kept.
        progress: called with the share of the frames' evaluations that are done.
        stop: asked after every pass and every chunk of frames.
        device: where pictures are drawn and compared, see `refine_poses`.

    Raises:
        InputError: a frame without parameters or photographs.
        RefinementStoppedError: `stop` returned True; the same call continues.
    """
    sequence = AvatarSequence(scene.capture, scene.template, SequenceConfig(normals=False), device=device)
    if work is not None:
        work.mkdir(parents=True, exist_ok=True)
    training, apart_state = (None, None) if work is None else (work / TRAINING_STATE, work / HELD_OUT_STATE)
    found = refine_poses(sequence, config, reference=scene.frame, state=training, progress=progress, stop=stop)
    capture, template = scene.capture, scene.template
    if found.cameras:
        sequence.capture = with_cameras(capture, found.cameras)
    apart = None
    if held_out and capture.splits.novel_pose_frames:
        apart = refine_held_out(sequence, found.gaussians, config, state=apart_state, stop=stop)
    # Nothing is written before everything is computed: half a refinement may not pass for one.
    _write_params(folder / PARAMS_FILE, _rows(capture, template, [found]))
    if found.cameras:
        corrected = {name: replace(capture.cameras[name], cam_from_world=pose) for name, pose in found.cameras.items()}
        write_plain_cameras_json(folder / CAMERAS_FILE, corrected)
    if apart is not None:
        _write_params(folder / HELD_OUT_PARAMS_FILE, _rows(capture, template, [found, apart]))
    save_bound(found.gaussians, folder / GAUSSIANS_FILE)
    return RefinedCapture(sequence, found, apart)


def with_refined_poses(capture: Capture, folder: Path) -> Capture:
    """Return a capture with the parameters, and the cameras if there are any, that `refine_capture` wrote."""
    refined = find_params(folder / PARAMS_FILE, body=None)
    capture = replace(capture, recording=replace(capture.recording, params=refined))
    if (folder / CAMERAS_FILE).is_file():
        poses = {camera.name: camera.cam_from_world for camera in read_cameras(folder / CAMERAS_FILE)}
        capture = with_cameras(capture, poses)
    return capture


def refinement_figures(found: Refinement) -> dict[str, Any]:
    """Return what a refinement changed: loss, turn and shift of every frame, and the turn of every joint."""
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
    """Return parameters by frame: refined ones, or those of the capture with the hands' mean pose added."""
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
        # Frames may have different numbers of coefficients; shorter ones are filled with zeros, which change nothing.
        width = max(getattr(row, name).shape[1] for row in rows.values())
        arrays[name] = np.full((max(rows) + 1, width), np.nan)
        for frame, row in rows.items():
            value = getattr(row, name)[0]
            arrays[name][frame] = np.pad(value, (0, width - len(value)))
    arrays["flat_hand_mean"] = np.asarray(np.bool_(True))
    if first.fps is not None:
        arrays["fps"] = np.asarray(np.float64(first.fps))
    write_arrays(path, arrays)
