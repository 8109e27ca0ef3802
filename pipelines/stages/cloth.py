"""Stage 83: which clothes are loose, cut for simulation and fitted to the surface that the teacher followed."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from avatar.data.cloth_motion import ClothMotions
from avatar.data.sequence import AvatarSequence
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import Track
from avatar.rig.rig import Rig
from avatar.training.engine.loop import Progress
from avatar.training.engine.session import Session
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.checks import Check
from pipelines.runs.digests import sha256_file
from pipelines.runs.layout import GARMENTS, PARAMS
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import ModelStage, Trainer
from smplxpp.cloth import Garment, GarmentConfig, cut_garment
from smplxpp.cloth.calibrate import Calibration, CalibrationConfig, Followed, calibrate
from smplxpp.cloth.garment_file import load_garments, save_garments
from smplxpp.core.errors import InputError
from smplxpp.core.labels import CLOTH_LABELS
from smplxpp.core.params import BodyParams
from smplxpp.core.validation import require_known
from smplxpp.template.template import Template

ClothMode = Literal["simulate", "field", "skin"]
"""What moves loose clothes: a simulation, a student's own field, or skinning alone."""


@dataclass(frozen=True, kw_only=True)
class ClothConfig:
    """Which clothes are simulated, and how.

    Attributes:
        parts: by name; None: those whose followed surface leaves skinning and that simulation brings nearer to it.
            Named ones are simulated whatever the measurement says.
        garment: how they are cut. calibration: how they are fitted.
        seed: nothing is drawn; there for the stage.
    """

    parts: tuple[str, ...] | None = None
    garment: GarmentConfig = field(default_factory=GarmentConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    seed: int = 0
    iterations: int = 1


@dataclass(frozen=True, kw_only=True)
class ClothStage(ModelStage):
    """Garments of the template's loose parts.

    Attributes:
        teacher: whose followed surface they are fitted to.
    """

    file = Path(GARMENTS).name
    resumable = False
    alone = True

    teacher: ModelStage
    config: ClothConfig

    @property
    def needs(self) -> Mapping[str, ModelStage]:
        return {"teacher": self.teacher}

    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        return {"cloth": self.config, "fps": trainer.scene.capture.fps}

    def inputs(self, trainer: Trainer) -> Mapping[str, str]:
        return {**trainer.scene.digests, PARAMS: sha256_file(trainer.run / PARAMS)}

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        begin = time.monotonic()
        sequence = trainer.sequence(self.ground)
        teacher = trainer.model(self.teacher)
        track = teacher.track if isinstance(teacher, TeacherAvatar) else None
        reference = load_params_of_run(trainer.run).frame(0).without_shape()
        garments, found, said = find_garments(sequence, reference, self.config, track, session)
        save_garments(folder / self.file, garments)
        numbers = {
            "loose": [garment.part for garment in garments],
            "particles": {garment.part: len(garment.particles) for garment in garments},
            "calibration": {one.part: _numbers_of(one) for one in found},
            "said": said,
            "mean": {},
            "iterations": self.iterations,
            "iterations_done": self.iterations,
            "seconds_of_steps": time.monotonic() - begin,
            "finished": True,
        }
        return StageOutput(_checks(found, garments), numbers)

    def read(self, path: Path, rig: Rig) -> list[Garment]:
        return load_garments(path, rig.template)


def find_garments(
    sequence: AvatarSequence,
    reference: BodyParams,
    config: ClothConfig,
    track: Track | None,
    session: Session,
) -> tuple[list[Garment], list[Calibration], list[str]]:
    """Cut and fit the loose parts of a template.

    Args:
        reference: the pose in which the template's surface is the scan's.
        track: the surface that was followed through the training frames; None: parts go by name, with the defaults.

    Returns:
        The garments, what was found of every part that was looked at, and sentences on what could not be done.
    """
    template, said = sequence.rig.template, []
    clothes = [label.name for label in CLOTH_LABELS if label.name in template.part_names]
    if config.parts is not None:
        require_known("loose parts", config.parts, [name for name in template.part_names if name != "body"])
    wanted = clothes if config.parts is None else list(config.parts)
    if config.parts is None and track is None:
        return [], [], ["nothing was followed through the frames: no part is simulated unless it is named"]
    fps = sequence.capture.fps
    if wanted and track is not None and fps is None:
        return [], [], ["the capture does not say how many frames a second it has: nothing is simulated"]
    garments, found = [], []
    for k, part in enumerate(wanted):
        session.report(Progress(k, len(wanted), 0.0, 0.0))
        try:
            garment = cut_garment(template, part, reference, config.garment)
        except InputError as error:
            said.append(str(error))
            continue
        if track is not None and fps is not None:
            followed = followed_particles(sequence, track, garment, fps)
            fitted, one = calibrate(template, garment, followed, config=config.calibration)
            found.append(one)
            if config.parts is None and not one.loose:
                continue
            garment = fitted
        garments.append(garment)
    return garments, found, said


def followed_particles(sequence: AvatarSequence, track: Track, garment: Garment, fps: float) -> Followed:
    """Where the followed surface has a garment's particles in the training frames; gaps between frames are NaN."""
    frames = np.arange(min(track.row), max(track.row) + 1)
    rig, poses, world = sequence.rig, [], np.full((len(frames), len(garment.particles), 3), np.nan)
    last = None
    for k, frame in enumerate(frames.tolist()):
        params = sequence.capture.params(frame)
        if frame in track.row and params is not None:
            world[k] = rig.places(sequence.motion(frame), track.displacements(frame))[garment.particles]
        last = params if params is not None else last
        assert last is not None  # the first frame is a training frame, which has parameters
        poses.append(last.without_shape())
    return Followed(BodyParams.concatenate(poses), fps, world)


def clothed_sequence(trainer: Trainer, ground: str, cloth: ModelStage | None) -> AvatarSequence:
    """The capture, with the garments of a finished stage simulated in poses that are new or count as new."""
    sequence = trainer.sequence(ground)
    garments = [] if cloth is None else trainer.model(cloth)
    fps = sequence.capture.fps
    if not garments or fps is None:
        return sequence
    return sequence.with_cloth(
        ClothMotions(
            sequence.rig.template, garments, params=sequence.capture.params, frames=sequence.capture.frames, fps=fps
        )
    )


def simulated_parts(run: Path, template: Template) -> list[Garment]:
    """The garments of a run; none where it has not looked for any."""
    path = run / GARMENTS
    return load_garments(path, template) if path.is_file() else []


def _numbers_of(one: Calibration) -> dict[str, Any]:
    return {
        "loose": one.loose,
        "why": one.why,
        "drag_per_s": one.drag,
        "drag_spread": None if np.isnan(one.drag_spread) else one.drag_spread,
        "pin_depth_mm": 1e3 * one.pin_depth,
        "pin_spread_mm": None if np.isnan(one.pin_spread) else 1e3 * one.pin_spread,
        "skinned_mm": 1e3 * one.skinned,
        "simulated_mm": 1e3 * one.simulated,
        "frames": one.frames,
    }


def _checks(found: list[Calibration], garments: list[Garment]) -> list[Check]:
    simulated = {garment.part for garment in garments}
    return [
        Check(
            f"{one.part}: distance of the simulation to the followed surface",
            value=one.simulated / one.skinned,
            unit="of skinning's",
            warn=1.0,
            fail=2.0,
            explanation=one.why,
        )
        for one in found
        if one.part in simulated
    ]
