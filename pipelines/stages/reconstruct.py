"""The stage that reconstructs frames of a capture; `smplxpp.build.reconstruct` does the work."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.code import sha256_file
from pipelines.runs.layout import RECONSTRUCT_STAGE
from pipelines.runs.stage import Stage, StageRecord, run_stage
from pipelines.stages.build_config import ReconstructInputs, save_reconstruct
from smplxpp.body import load_body
from smplxpp.build.reconstruct import (
    Maker,
    check_masks,
    config_of,
    frames_read,
    open_photographs,
    reconstruct_frame,
    reconstruction_output,
    surface_maker,
    usable_cameras,
    usable_frames,
    write_surface,
)
from smplxpp.capture import Capture
from smplxpp.capture.recording import TURNTABLE
from smplxpp.core import GeometryWarning, InputError, ProgressCallback, StageOutput, ignore_progress
from smplxpp.core.files import as_object, atomic_folder, jsonable, read_json
from smplxpp.reconstruct import Reconstruction

FrameMaker = Callable[..., tuple[Reconstruction, dict[str, Any]]]
"""`surface(frame=..., progress=...)`: the surface of a frame and its numbers."""
_SHARES = {"masks": 0.0, "hull": 0.1, "photographs": 0.2, "colours": 0.9}
"""Progress within a frame, from 0 to 1, at which each step begins."""


@dataclass(frozen=True)
class Method:
    """A method of surface reconstruction that replaces the plane sweep.

    Attributes:
        make: function that reconstructs the surface of one frame.
        code: modules that implement it, part of the stage's key.
        choices: its settings, part of the stage's key.
    """

    make: Maker
    code: tuple[str, ...]
    choices: Mapping[str, Any]


def reconstruct_capture(
    run: Path,
    inputs: ReconstructInputs,
    *,
    method: Method | None = None,
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> StageRecord:
    """Reconstruct the frames, unless the stage is up to date, in a run whose lock the caller holds.

    Frames that were finished before an interruption are kept. A frame that fails is skipped and listed in
    `reconstruction.json`, unless it is the only one.

    Args:
        run: folder of the run.
        inputs: capture, frames and settings.
        method: method that replaces the plane sweep.
        force: reconstruct again even if the stage is up to date.
        progress: called with the name of the current step and its share done.

    Raises:
        InputError: unusable inputs, or no frame that could be reconstructed.
    """
    # Check all inputs first: a missing mask must not end a sequence after hours.
    capture = open_photographs(inputs)
    cameras = usable_cameras(capture, inputs.hold_out)
    frames = usable_frames(capture, inputs.frames)
    check_masks(capture, cameras, frames)
    config = config_of(inputs)
    # The key: cameras and photographs, the settings, and the code that makes the surface.
    body = load_body(inputs.body) if capture.kind == TURNTABLE else None
    digests = photograph_digests(capture, cameras, frames_read(capture, frames))
    if body is not None:
        if method is not None:
            raise InputError(
                "--method", expected="cameras that see one moment", received="a person who turns before one camera"
            )
        digests |= pose_digests(capture, inputs.body)
    if inputs.mesh is not None:
        if len(frames) != 1:
            raise InputError("--mesh", expected="one --frame, the mesh's", received=f"{len(frames)} frames")
        digests["mesh"] = sha256_file(inputs.mesh)
    stage = Stage(
        name=RECONSTRUCT_STAGE,
        config={
            "reconstruct": config,
            "method": None if method is None else method.choices,
            "frames": frames,
            "cameras": cameras,
        },
        inputs=digests,
        code=(__name__, *(() if method is None else method.code)),
        resumable=True,
    )
    # The record is written before the work, so that an interrupted run knows its inputs.
    save_reconstruct(run, inputs)
    # Finished frames lie in the work folder, whose name contains the key. A changed setting therefore starts from none.
    state = run / stage.work_name
    make = surface_maker(inputs) if method is None else method.make
    surface = partial(reconstruct_frame, capture, cameras, make=make, body=body)
    work = partial(
        _work, state=state, capture=capture, cameras=cameras, frames=frames, surface=surface, progress=progress
    )
    return run_stage(run, stage, work, force=force)


def _work(
    folder: Path,
    *,
    state: Path,
    capture: Capture,
    cameras: tuple[str, ...],
    frames: tuple[int, ...],
    surface: FrameMaker,
    progress: ProgressCallback,
) -> StageOutput:
    """Write `scan_FFFFFF.ply`, `scan_FFFFFF.npz` of every frame, and `reconstruction.json`."""
    found: dict[int, dict[str, Any]] = {}
    notes: dict[int, str] = {}
    # One folder for each frame keeps finished work. A frame that fails is noted and the loop continues.
    for k, frame in enumerate(frames):

        def report(what: str, share: float, k: int = k, frame: int = frame) -> None:
            # Photographs are the only step that reports its own progress; they fill 0.2 to 0.9.
            done = _SHARES.get(what, 0.0) + (0.7 * share if what == "photographs" else 0.0)
            progress(f"{frame}: {what}", (k + done) / len(frames))

        made = state / f"frame_{frame:06d}"
        # The folder appears at once when its frame is complete, so that its existence means finished.
        if not made.is_dir():
            try:
                _keep_frame(made, frame, surface, report)
            except InputError as error:
                # A single frame that fails has no result at all.
                if len(frames) == 1:
                    raise
                notes[frame] = str(error)
                warnings.warn(f"frame {frame} left out: {error}", GeometryWarning, stacklevel=2)
                continue
        found[frame] = as_object(read_json(made / "numbers.json"), subject=f"numbers of frame {frame}")
    if not found:
        raise InputError(
            "reconstruction",
            expected="a surface of at least one frame",
            received=f"none of {len(frames)}: {next(iter(notes.values()))}",
        )
    # Copy instead of moving: an interruption during the copy must not lose frames.
    for frame in found:
        for name in ("scan.ply", "scan.npz"):
            path = state / f"frame_{frame:06d}" / name
            shutil.copyfile(path, folder / f"scan_{frame:06d}{path.suffix}")
    content = {
        "cameras": list(cameras),
        "held_out": [name for name in capture.cameras if name not in cameras],
        "frames": {str(frame): numbers for frame, numbers in found.items()},
        "absent": {str(frame): words for frame, words in notes.items()},
    }
    (folder / "reconstruction.json").write_text(json.dumps(jsonable(content), indent=1) + "\n")
    return reconstruction_output(found, notes, cameras)


def _keep_frame(made: Path, frame: int, surface: FrameMaker, progress: ProgressCallback) -> None:
    """Reconstruct a frame and keep it in a folder: the scan, arrays for each vertex, and numbers."""
    result, numbers = surface(frame=frame, progress=progress)
    # Write into a temporary folder and rename it, see `_work`.
    with atomic_folder(made) as temporary:
        write_surface(temporary / "scan.ply", result)
        np.savez_compressed(
            temporary / "scan.npz",
            confidence=result.confidence,
            seen=result.seen.astype(np.int16),
            hull_vertices=result.hull.vertices.astype(np.float32),
            hull_faces=result.hull.faces.astype(np.int32),
        )
        (temporary / "numbers.json").write_text(json.dumps(jsonable(numbers)) + "\n")


def pose_digests(capture: Capture, body: Path | None) -> dict[str, str]:
    """Return SHA-256 of the poses of a turning person, and of the body file that they are for."""
    poses = hashlib.sha256()
    for frame in usable_frames(capture, None):
        params = capture.params(frame)
        if params is not None:
            for name, values in sorted(params.as_dict().items()):
                poses.update(name.encode() + np.asarray(values).tobytes())
    digests = {"capture/params": poses.hexdigest()}
    return digests if body is None else digests | {"body": sha256_file(body)}


def photograph_digests(capture: Capture, cameras: tuple[str, ...], frames: tuple[int, ...]) -> dict[str, str]:
    """Return SHA-256 of the cameras, and of images' and masks' names and sizes, because a sequence has gigabytes."""
    rig, files = hashlib.sha256(), hashlib.sha256()
    for name in cameras:
        camera = capture.cameras[name]
        # Intrinsics and poses are hashed by content, because a calibration may change under the same name.
        rig.update(f"{name} {camera.width} {camera.height}".encode())
        rig.update(camera.K.tobytes() + camera.cam_from_world.tobytes())
    for frame in frames:
        for name in cameras:
            for kind in ("image", "mask"):
                path: Path | None = capture.file(name, frame, kind)
                if path is not None:
                    files.update(f"{kind} {name} {frame} {path.name} {path.stat().st_size}\n".encode())
    return {
        "capture/cameras": rig.hexdigest(),
        "capture/names and sizes of images and masks": files.hexdigest(),
    }
