"""Stage 83: find loose clothes, cut them for simulation and calibrate them on the surface that the teacher tracked."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from avatar.data.sequence import AvatarSequence
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rig.rig import Rig
from avatar.training.engine.loop import Progress
from avatar.training.engine.session import Session
from avatar.training.loose_clothes import ClothConfig, LooseClothes, Outlines, find_garments, with_simulated
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import GARMENTS, PARAMS
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import ModelStage, Trainer
from smplxpp.cloth import Garment
from smplxpp.cloth.calibrate import Calibration
from smplxpp.cloth.garment_file import load_garments, save_garments
from smplxpp.cloth.quality import all_checks
from smplxpp.core.checks import Check
from smplxpp.template.template import Template

ClothMode = Literal["simulate", "field", "skin"]
"""What moves loose clothes: a simulation, a student's own field, or skinning alone."""


@dataclass(frozen=True, kw_only=True)
class ClothStage(ModelStage):
    """Garments of the template's loose parts.

    Attributes:
        teacher: stage of the teacher, on whose tracked surface the garments are calibrated.
        config: parts to examine, and settings of the calibration.
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
        known = (trainer.run / PARAMS).is_file()
        return {**trainer.scene.digests, **({PARAMS: sha256_file(trainer.run / PARAMS)} if known else {})}

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        begin = time.monotonic()
        teacher = trainer.model(self.teacher)
        # Without a teacher that tracked the cloth there is no surface to calibrate the simulation on.
        track = teacher.track if isinstance(teacher, TeacherAvatar) else None
        reference = None
        # Loose parts are found from the reference pose, without the shape offsets that the template already contains.
        # Parts named by the user need that pose, so that reading it may fail here with its own message.
        if (trainer.run / PARAMS).is_file() or self.config.parts is not None:
            reference = load_params_of_run(trainer.run).frame(0).without_shape()
        found = find_garments(
            trainer.sequence(self.ground),
            reference,
            self.config,
            track,
            report=lambda done, total: session.report(Progress(done, total, 0.0, 0.0)),
        )
        save_garments(folder / self.file, found.garments)
        # The keys about iterations are those of every training stage, so that progress and resuming read them alike.
        numbers = {
            "loose": [garment.part for garment in found.garments],
            "particles": {garment.part: len(garment.particles) for garment in found.garments},
            "calibration": {one.part: _numbers_of(one, found.outlines.get(one.part)) for one in found.calibrations},
            "notes": found.notes,
            "mean": {},
            "iterations": self.iterations,
            "iterations_done": self.iterations,
            "seconds_of_steps": time.monotonic() - begin,
            "finished": True,
        }
        return StageOutput(_checks(found), numbers)

    def read(self, path: Path, rig: Rig) -> list[Garment]:
        return load_garments(path, rig.template)


def clothed_sequence(trainer: Trainer, ground: str, cloth: ModelStage | None) -> AvatarSequence:
    """Return the capture; garments of a finished stage are simulated in poses that are new or count as new."""
    return with_simulated(trainer.sequence(ground), [] if cloth is None else trainer.model(cloth))


def simulated_parts(run: Path, template: Template) -> list[Garment]:
    """Read the garments of a run; none where it has not looked for any."""
    path = run / GARMENTS
    return load_garments(path, template) if path.is_file() else []


def _numbers_of(one: Calibration, outlines: Outlines | None) -> dict[str, Any]:
    """Return the figures of a part as JSON values, in the units of the report."""
    return {
        "moves": one.moves,
        "fitted": one.fitted,
        "drag_per_s": one.drag,
        "drag_spread": one.drag_spread,
        "pin_depth_mm": 1e3 * one.pin_depth,
        "pin_spread_mm": None if one.pin_spread is None else 1e3 * one.pin_spread,
        "outlines": None if outlines is None else asdict(outlines),
        "skinned_mm": 1e3 * one.skinned,
        "simulated_mm": 1e3 * one.simulated,
        "frames": one.frames,
        "quality": None if one.quality is None else one.quality.as_dict(),
    }


def _checks(found: LooseClothes) -> list[Check]:
    """Return checks of each simulated part: its outline against that of skinning, and whether its simulation holds."""
    measured = {one.part: found.outlines[one.part] for one in found.garments if one.part in found.outlines}
    simulated = [one.quality for one in found.calibrations if one.part in measured and one.quality is not None]
    return all_checks(simulated, "training frames") + [
        Check(
            f"{part}: wrong outline with it simulated",
            # 1e-9 keeps a perfect outline under skinning from dividing by zero.
            value=outlines.simulated / max(outlines.skinned, 1e-9),
            unit="of skinning's",
            warn=1.0,
            fail=2.0,
            explanation=f"1 - IoU of silhouettes and masks in {outlines.views} training views",
        )
        for part, outlines in measured.items()
    ]
