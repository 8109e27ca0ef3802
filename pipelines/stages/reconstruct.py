"""Stage 02: the surface of the person in frames of a capture, from photographs, cameras and masks alone."""

from __future__ import annotations

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
from pipelines.runs.gates import MASKS_LEFT_OUT, SILHOUETTE, UNSEEN_SURFACE
from pipelines.runs.layout import RECONSTRUCT_STAGE
from pipelines.runs.stage import Stage, StageOutput, StageRecord, run_stage
from pipelines.stages.photographed import (
    check_masks,
    open_photographs,
    photograph_digests,
    photographs,
    unit_cube_of,
    usable_cameras,
    usable_frames,
)
from pipelines.stages.reconstruct_config import ReconstructInputs, save_reconstruct
from smplxpp.capture import Capture
from smplxpp.clean import sanitize
from smplxpp.core.checks import Check
from smplxpp.core.errors import GeometryWarning, InputError, ProgressCallback, ignore_progress
from smplxpp.core.files.atomic import atomic_folder
from smplxpp.core.files.json_file import as_object, jsonable, read_json
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh, write_ply
from smplxpp.reconstruct import (
    PhotoView,
    ReconstructConfig,
    Reconstruction,
    adopt_surface,
    reconstruct,
    silhouette_agreement,
    usable_views,
)
from smplxpp.reconstruct.neus2 import mesh_in_world

Maker = Callable[..., Reconstruction]
"""`make(views, progress=...)`: the surface of a moment."""


@dataclass(frozen=True)
class Method:
    """Another way to a surface than the sweep.

    Attributes:
        make: see `Maker`. code: modules that do its work. choices: what it depends on.
    """

    make: Maker
    code: tuple[str, ...]
    choices: Mapping[str, Any]


_SHARES = {"masks": 0.0, "hull": 0.1, "photographs": 0.2, "colours": 0.9}


def reconstruct_capture(
    run: Path,
    inputs: ReconstructInputs,
    *,
    method: Method | None = None,
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> StageRecord:
    """Reconstruct the frames, unless the stage stands, and keep it in a run that the caller owns.

    Frames that were finished before a kill are not made again. Of several frames, one that cannot be reconstructed is
    named among the problems.

    Args:
        method: makes the surfaces in the place of the sweep.

    Raises:
        InputError: unusable inputs, or not a single frame that could be reconstructed.
    """
    capture = open_photographs(inputs)
    cameras = usable_cameras(capture, inputs.hold_out)
    frames = usable_frames(capture, inputs.frames)
    check_masks(capture, cameras, frames)
    config = ReconstructConfig(
        cell=None if inputs.cell_mm is None else 1e-3 * inputs.cell_mm, dissent=inputs.dissent, refine=inputs.refine
    )
    digests = photograph_digests(capture, cameras, frames)
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
        code=(__name__,) if method is None else (__name__, *method.code),
        resumable=True,
    )
    save_reconstruct(run, inputs)
    state = run / stage.work_name
    make: Maker = partial(_surface, config=config) if inputs.mesh is None else partial(_adopted, inputs=inputs)
    if method is not None:
        make = method.make
    work = partial(_work, state=state, capture=capture, cameras=cameras, frames=frames, make=make, progress=progress)
    return run_stage(run, stage, work, force=force)


def _work(
    folder: Path,
    *,
    state: Path,
    capture: Capture,
    cameras: tuple[str, ...],
    frames: tuple[int, ...],
    make: Maker,
    progress: ProgressCallback,
) -> StageOutput:
    """Write `scan_FFFFFF.ply`, `scan_FFFFFF.npz` of every frame, and `reconstruction.json`."""
    found: dict[int, dict[str, Any]] = {}
    problems: dict[int, str] = {}
    for k, frame in enumerate(frames):

        def told(what: str, share: float, k: int = k, frame: int = frame) -> None:
            done = _SHARES.get(what, 0.0) + (0.7 * share if what == "photographs" else 0.0)
            progress(f"{frame}: {what}", (k + done) / len(frames))

        made = state / f"frame_{frame:06d}"
        if not made.is_dir():
            try:
                _make_frame(made, capture, cameras, frame, make, told)
            except InputError as error:
                if len(frames) == 1:
                    raise
                problems[frame] = str(error)
                warnings.warn(f"frame {frame} left out: {error}", GeometryWarning, stacklevel=2)
                continue
        found[frame] = as_object(read_json(made / "numbers.json"), subject=f"numbers of frame {frame}")
    if not found:
        raise InputError(
            "reconstruction",
            expected="a surface of at least one frame",
            received=f"none of {len(frames)}: {next(iter(problems.values()))}",
        )
    for frame in found:
        for name in ("scan.ply", "scan.npz"):
            path = state / f"frame_{frame:06d}" / name
            shutil.copyfile(path, folder / f"scan_{frame:06d}{path.suffix}")
    content = {
        "cameras": list(cameras),
        "held_out": [name for name in capture.cameras if name not in cameras],
        "frames": {str(frame): numbers for frame, numbers in found.items()},
        "absent": {str(frame): words for frame, words in problems.items()},
    }
    (folder / "reconstruction.json").write_text(json.dumps(jsonable(content), indent=1) + "\n")
    return StageOutput(_checks(list(found.values()), len(frames)), _summary(found, problems, cameras))


def _make_frame(
    made: Path, capture: Capture, cameras: tuple[str, ...], frame: int, make: Maker, progress: ProgressCallback
) -> None:
    views, problems = photographs(capture, cameras, frame)
    result = make(views, progress=progress)
    agreement = silhouette_agreement(result.mesh, [view for view in views if view.name in result.numbers["views"]])
    numbers = {
        **result.numbers,
        "silhouettes": agreement,
        "problems": [*problems, *result.notes],
    }
    with atomic_folder(made) as temporary:
        save_surface(temporary / "scan", result)
        (temporary / "numbers.json").write_text(json.dumps(jsonable(numbers)) + "\n")


def _surface(views: list[PhotoView], *, config: ReconstructConfig, progress: ProgressCallback) -> Reconstruction:
    return reconstruct(views, config, progress=progress)


def _adopted(views: list[PhotoView], *, inputs: ReconstructInputs, progress: ProgressCallback) -> Reconstruction:
    """Another program's surface, in the cameras' world."""
    assert inputs.mesh is not None
    progress("masks", 0.0)
    raw = read_raw_mesh(inputs.mesh)
    usable, _ = usable_views(views)
    mesh, space, shares = mesh_in_world(sanitize(raw.vertices, raw.faces).mesh, usable, unit_cube_of(inputs.capture))
    progress("colours", 0.0)
    result = adopt_surface(mesh, views)
    result.numbers.update(space=space, agreement_by_space=shares)
    return result


def save_surface(path: Path, result: Reconstruction) -> None:
    """Write `path.ply`, a scan with colours, and `path.npz`, what is known of its vertices, and the hull."""
    extra = {"confidence": result.confidence, "seen": result.seen.astype(np.int32)}
    write_ply(path.with_suffix(".ply"), result.mesh, vertex_colors=result.colors, vertex_properties=extra)
    np.savez_compressed(
        path.with_suffix(".npz"),
        confidence=result.confidence,
        seen=result.seen.astype(np.int16),
        hull_vertices=result.hull.vertices.astype(np.float32),
        hull_faces=result.hull.faces.astype(np.int32),
    )


def _checks(frames: list[dict[str, Any]], asked: int) -> list[Check]:
    """The worst frame of each."""
    unseen = max(one["unseen"] for one in frames)
    silhouettes = min(float(np.mean(list(one["silhouettes"].values()))) for one in frames)
    left_out = max(len(one["left_out"]) / (len(one["left_out"]) + len(one["views"])) for one in frames)
    names = sorted({name for one in frames for name in one["left_out"]})
    return [
        SILHOUETTE.check(
            "reconstructed surface on the masks, worst frame", silhouettes, explanation="mean over the views that count"
        ),
        UNSEEN_SURFACE.check(
            "share of the surface that fewer than two cameras see",
            unseen,
            explanation="the silhouettes' alone: under a skirt, between the legs, soles",
        ),
        MASKS_LEFT_OUT.check(
            "share of the masks that were left out",
            left_out,
            explanation=f"contradicted by the others: {', '.join(names)}" if names else "none contradicts the others",
        ),
        Check(
            "frames without a surface",
            float(asked - len(frames)),
            "",
            0.0,
            0.5 * asked,
            explanation="their problems are named in reconstruction.json",
        ),
    ]


def _summary(found: dict[int, dict[str, Any]], problems: dict[int, str], cameras: tuple[str, ...]) -> dict[str, Any]:
    frames = list(found.values())
    return {
        "frames": len(found),
        "absent": sorted(problems),
        "vertices": int(np.mean([one["vertices"] for one in frames])),
        "cell_mm": float(np.mean([one["cell_mm"] for one in frames])),
        "pixel_mm": float(np.mean([one["pixel_mm"] for one in frames])),
        "moved_mm": float(np.mean([one["moved_mm"] for one in frames])),
        "unseen": float(np.mean([one["unseen"] for one in frames])),
        "unsure": float(np.mean([one["unsure"] for one in frames])),
        "problems": len(problems) + sum(len(one["problems"]) for one in frames),
        "seen": {"cameras": list(cameras), "frames": sorted(found)},
    }
