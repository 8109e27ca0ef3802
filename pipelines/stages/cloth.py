"""Stage 83: which clothes are loose, cut for simulation and fitted to the surface that the teacher followed."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
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
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import GARMENTS, PARAMS
from pipelines.runs.stage import StageOutput
from pipelines.stages.models import ModelStage, Trainer
from smplxpp.cloth import Garment, GarmentConfig, cut_garment
from smplxpp.cloth.calibrate import Calibration, CalibrationConfig, Followed, calibrate
from smplxpp.cloth.garment_file import load_garments, save_garments
from smplxpp.core.checks import Check
from smplxpp.core.errors import InputError
from smplxpp.core.labels import CLOTH_LABELS
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.spread import spread
from smplxpp.core.validation import require_known
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template

log = logging.getLogger(__name__)

OUTLINE_FRAMES, OUTLINE_CAMERAS = 16, 4
"""Training frames, and cameras of each, whose masks decide whether a part is simulated."""
ClothMode = Literal["simulate", "field", "skin"]
"""What moves loose clothes: a simulation, a student's own field, or skinning alone."""


@dataclass(frozen=True, kw_only=True)
class ClothConfig:
    """Which clothes are simulated, and how.

    Attributes:
        parts: by name; None: those whose followed surface leaves skinning, and with which simulated the person's
            outline in training views is nearer to the masks. Named ones are simulated whatever is measured.
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
        known = (trainer.run / PARAMS).is_file()
        return {**trainer.scene.digests, **({PARAMS: sha256_file(trainer.run / PARAMS)} if known else {})}

    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        begin = time.monotonic()
        sequence = trainer.sequence(self.ground)
        teacher = trainer.model(self.teacher)
        track = teacher.track if isinstance(teacher, TeacherAvatar) else None
        reference = None
        if (trainer.run / PARAMS).is_file() or self.config.parts is not None:
            reference = load_params_of_run(trainer.run).frame(0).without_shape()
        garments, found, outlines, said = find_garments(sequence, reference, self.config, track, session)
        save_garments(folder / self.file, garments)
        numbers = {
            "loose": [garment.part for garment in garments],
            "particles": {garment.part: len(garment.particles) for garment in garments},
            "calibration": {one.part: _numbers_of(one, outlines.get(one.part)) for one in found},
            "said": said,
            "mean": {},
            "iterations": self.iterations,
            "iterations_done": self.iterations,
            "seconds_of_steps": time.monotonic() - begin,
            "finished": True,
        }
        return StageOutput(_checks(outlines, garments), numbers)

    def read(self, path: Path, rig: Rig) -> list[Garment]:
        return load_garments(path, rig.template)


def find_garments(
    sequence: AvatarSequence,
    reference: BodyParams | None,
    config: ClothConfig,
    track: Track | None,
    session: Session,
) -> tuple[list[Garment], list[Calibration], dict[str, Outlines], list[str]]:
    """Cut and fit the loose parts of a template.

    Args:
        reference: the pose in which the template's surface is the scan's; None: nobody knows it.
        track: the surface that was followed through the training frames; None: parts go by name, with the defaults.

    Returns:
        The garments, what was found of every part that was looked at, outlines of those that move, and sentences on
        what could not be done.
    """
    template = sequence.rig.template
    said: list[str] = []
    outlines: dict[str, Outlines] = {}
    if config.parts is not None:
        require_known("loose parts", config.parts, [name for name in template.part_names if name != "body"])
    wanted = _wanted(template, config)
    fps = sequence.capture.fps
    why = why_none(template, config, pose_known=reference is not None, followed=track is not None, fps=fps)
    if why is not None or reference is None:
        return [], [], {}, [] if why is None else [why]
    garments, found = [], []
    for k, part in enumerate(wanted):
        session.report(Progress(k, len(wanted), 0.0, 0.0))
        try:
            garment = cut_garment(template, part, reference, config.garment)
        except InputError as error:
            said.append(str(error))
            log.warning("loose clothes: %s", error)
            continue
        if track is not None and fps is not None:
            followed = followed_particles(sequence, track, garment, fps)
            fitted, one = calibrate(template, garment, followed, config=config.calibration)
            found.append(one)
            garment = fitted
            if one.moves:
                outlines[part] = measure_outlines(sequence, garment, fps)
            if config.parts is None and not (one.moves and outlines[part].better):
                continue
        garments.append(garment)
    return garments, found, outlines, said


def why_none(
    template: Template, config: ClothConfig, *, pose_known: bool, followed: bool, fps: float | None
) -> str | None:
    """Return why no part of the clothes can be simulated, known before anything is trained; None: parts may be.

    Args:
        pose_known: of the scan, in which the template is the surface. followed: the surface is, or will be.
    """
    if not _wanted(template, config):
        return None
    if not pose_known:
        return "the run does not say in which pose its template was scanned: nothing is simulated"
    if config.parts is None and not followed:
        return "nothing was followed through the frames: no part is simulated unless it is named"
    if followed and fps is None:
        return "the capture does not say how many frames a second it has: nothing is simulated"
    return None


def _wanted(template: Template, config: ClothConfig) -> list[str]:
    """The parts to look at: those named, or all clothes."""
    if config.parts is not None:
        return list(config.parts)
    return [label.name for label in CLOTH_LABELS if label.name in template.part_names]


@dataclass(frozen=True)
class Outlines:
    """How far the person's outline is from the masks of training views: 1 - IoU, a mean.

    Attributes:
        skinned: by skinning alone. simulated: with the part simulated. views: how many.
    """

    skinned: float
    simulated: float
    views: int

    @property
    def better(self) -> bool:
        """Whether the simulation is nearer."""
        return self.simulated < self.skinned


def measure_outlines(sequence: AvatarSequence, garment: Garment, fps: float) -> Outlines:
    """Hold a simulated part against the masks of at most `OUTLINE_FRAMES` training frames, some cameras each."""
    rig, capture = sequence.rig, sequence.capture
    motions = ClothMotions(rig.template, [garment], params=capture.params, frames=capture.frames, fps=fps)
    clothed = sequence.with_cloth(motions)
    wrong: dict[bool, list[float]] = {False: [], True: []}
    for turn, frame in enumerate(spread(sequence.train_frames, OUTLINE_FRAMES)):
        for simulated, motion in ((False, sequence.motion(frame)), (True, clothed.as_new_motion(frame))):
            mesh = TriangleMesh(rig.pose(motion).double().cpu().numpy(), rig.template.faces)
            for camera in sequence.cameras(frame, turn, OUTLINE_CAMERAS, 0):
                image = capture.mask(camera, frame)
                if image is None:
                    continue
                mask, drawn = image > 127, rasterize_mesh(mesh, capture.cameras[camera]).mask
                wrong[simulated].append(1.0 - float((mask & drawn).sum() / max((mask | drawn).sum(), 1)))
    return Outlines(float(np.mean(wrong[False])), float(np.mean(wrong[True])), len(wrong[True]))


def followed_particles(sequence: AvatarSequence, track: Track, garment: Garment, fps: float) -> Followed:
    """Where the followed surface has a garment's particles in the training frames; gaps between frames are NaN."""
    frames = np.arange(min(track.row), max(track.row) + 1)
    rig, poses, world = sequence.rig, [], np.full((len(frames), len(garment.particles), 3), np.nan)
    confidence = np.ones(world.shape[:2])
    last = None
    for k, frame in enumerate(frames.tolist()):
        params = sequence.capture.params(frame)
        if frame in track.row and params is not None:
            world[k] = rig.places(sequence.motion(frame), track.displacements(frame))[garment.particles]
            confidence[k] = track.confidence(frame).cpu().numpy()[garment.particles]
        last = params if params is not None else last
        assert last is not None  # the first frame is a training frame, which has parameters
        poses.append(last.without_shape())
    return Followed(BodyParams.concatenate(poses), fps, world, confidence)


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


def _numbers_of(one: Calibration, outlines: Outlines | None) -> dict[str, Any]:
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
    }


def _checks(outlines: Mapping[str, Outlines], garments: list[Garment]) -> list[Check]:
    return [
        Check(
            f"{garment.part}: wrong outline with it simulated",
            value=outlines[garment.part].simulated / max(outlines[garment.part].skinned, 1e-9),
            unit="of skinning's",
            warn=1.0,
            fail=2.0,
            explanation=f"1 - IoU of silhouettes and masks in {outlines[garment.part].views} training views",
        )
        for garment in garments
        if garment.part in outlines
    ]
