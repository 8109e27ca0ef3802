"""What `smplxpp train` has made with the same choices need not be trained again for the ablation."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avatar.losses.perceptual import PerceptualDistance
from pipelines.ablation.pieces import BakePiece, CompensatePiece, FitPiece, TeacherPiece, fitting
from pipelines.ablation.run import Ablation
from pipelines.runs.digests import sha256_file
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import (
    BAKE_STAGE,
    BAKED,
    COMPENSATE_STAGE,
    FIT_STAGE,
    GAUSSIANS,
    STUDENT,
    TEACHER,
    TEACHER_STAGE,
    TEMPLATE,
)
from pipelines.stages.train_inputs import TrainScene
from smplxpp.core.json_values import jsonable

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Stage:
    """A stage of a run that makes a piece: its file, and the file it was made from."""

    piece: str
    name: str
    file: str
    needs: str | None


STAGES = (
    _Stage("gaussians", FIT_STAGE, GAUSSIANS, None),
    _Stage("teacher", TEACHER_STAGE, TEACHER, GAUSSIANS),
    _Stage("bake", BAKE_STAGE, BAKED, TEACHER),
    _Stage("full", COMPENSATE_STAGE, STUDENT, BAKED),
)


def adopt_trained(
    run: Path, ablation: Ablation, scene: TrainScene, *, scale: float, perceptual: PerceptualDistance | None
) -> list[str]:
    """Take over the stages of a run that were made as the pieces of `Full` are, up to the first that was not.

    Configuration, template, capture, scale, device and the perceptual term have to be the same; the code may have
    changed since, as for the pieces themselves.

    Returns:
        Names of the pieces that were taken.
    """
    common = {"scale": scale, "device": ablation.shop.device}
    metric = {"perceptual": None if perceptual is None else perceptual.name}
    taken = []
    for stage in STAGES:
        path, manifest = run / stage.file, read_manifest(run / stage.name)
        if manifest is None or not path.is_file() or not manifest["numbers"].get("finished"):
            break
        piece = ablation.pieces[stage.piece]
        if isinstance(piece, FitPiece):
            wanted = {**common, "fit": piece.config, "frame": piece.frame, "train": scene.capture.splits.train_cameras}
            own = {**manifest["config"]["fit"], "evaluations": piece.config.evaluations}  # that changes no result
            found, digests = {**manifest["config"], "fit": own}, _of_frame(scene)
        else:
            wanted, found = {**common, **metric, **_choices(piece, ablation)}, manifest["config"]
            digests = {**scene.digests, stage.needs: sha256_file(run / stage.needs)}
        if not (_holds(found, jsonable(wanted)) and _holds(manifest["inputs"], digests)):
            break
        if ablation.record(stage.piece) is None:
            numbers = manifest["numbers"]
            spent = ("seconds_of_steps", "seconds_of_tracking", "seconds_of_pretraining")
            seconds = sum(numbers.get(name, 0.0) for name in spent)
            iterations = numbers["iterations"] + numbers.get("iterations_before", 0)
            ablation.adopt(stage.piece, path, seconds=seconds, iterations=iterations)
            taken.append(stage.piece)
    if taken:
        log.info("ablation: taken from the run: %s", ", ".join(taken))
    return taken


def _of_frame(scene: TrainScene) -> dict[str, str]:
    """Digests of the reference frame by the names that a reference fit gives them."""
    posed = scene.template.pose(scene.capture.params(scene.frame))[0]
    out = {TEMPLATE: scene.digests[TEMPLATE], "capture/pose": hashlib.sha256(posed.tobytes()).hexdigest()}
    for camera in scene.capture.splits.train_cameras:
        for kind in ("image", "mask"):
            path = scene.capture.file(camera, scene.frame, kind)
            if path is not None:
                out[f"capture/{camera} {kind}"] = sha256_file(path)
    return out


def _choices(piece: Any, ablation: Ablation) -> dict[str, Any]:
    """A piece's configuration as the manifest of its stage has it."""
    if isinstance(piece, TeacherPiece):
        return {"training": piece.config, "networks": piece.networks}
    if isinstance(piece, BakePiece):
        return {"training": piece.config, "student": piece.student}
    assert isinstance(piece, CompensatePiece)
    rig = ablation.shop.sequence(piece.ground).rig
    return {"training": piece.config, "blend_shapes": fitting(piece.shapes, rig)}


def _holds(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    return all(found.get(name) == value for name, value in wanted.items())
