"""Find the loose clothes of a template, cut them for simulation, and calibrate them to the tracked surface."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from avatar.data.cloth_motion import ClothMotions
from avatar.data.sequence import AvatarSequence
from avatar.models.tracked_surface import Track
from smplxpp.cloth import Garment, GarmentConfig, cut_garment
from smplxpp.cloth.calibrate import Calibration, CalibrationConfig, Followed, calibrate
from smplxpp.core import BodyParams, InputError, TriangleMesh, require_known, spread
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import BODY_PART, Template

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ClothConfig:
    """Choices of the simulation of loose clothes.

    Attributes:
        parts: names of the parts; None: those whose tracked surface departs from skinning, and whose simulation brings
            the person's outline in training views nearer to the masks. Named parts are simulated without that test.
        garment: settings of the cut; None: those of cloth, or of hair where a part is hair.
        calibration: settings of the fit to the tracked surface.
        seed: nothing is drawn; there for the stage.
        iterations: steps that a bar of progress shows for the stage.
    """

    parts: tuple[str, ...] | None = None
    garment: GarmentConfig | None = None
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    seed: int = 0
    iterations: int = 1


@dataclass(frozen=True)
class Outlines:
    """Distance of the person's outline from the masks of training views: 1 - IoU, a mean.

    Attributes:
        skinned: with the part moved by skinning alone.
        simulated: with the part simulated.
        views: number of views.
    """

    skinned: float
    simulated: float
    views: int

    @property
    def better(self) -> bool:
        """Return whether the simulation is nearer to the masks."""
        return self.simulated < self.skinned


@dataclass
class LooseClothes:
    """Loose clothes of a template, and the figures that decided their choice.

    Attributes:
        garments: parts to simulate, cut and fitted.
        calibrations: result of the fit of each part that was tested.
        outlines: outlines of the parts that depart from skinning, by name.
        notes: sentences on parts that could not be cut or fitted.
    """

    garments: list[Garment] = field(default_factory=list)
    calibrations: list[Calibration] = field(default_factory=list)
    outlines: dict[str, Outlines] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def find_garments(
    sequence: AvatarSequence,
    reference: BodyParams | None,
    config: ClothConfig,
    track: Track | None,
    *,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> LooseClothes:
    """Cut the clothes of a template, calibrate them to the tracked surface, and keep those that simulation improves.

    Args:
        sequence: the training frames.
        reference: parameters of the pose in which the template's surface is the scan's; None: not known.
        config: parts to test and settings.
        track: the tracked surface of the training frames; None: only named parts are cut, with the default material.
        report: called before each part with the numbers of parts, done and all.

    Raises:
        InputError: the name of a part that the template does not have.
    """
    template, out = sequence.rig.template, LooseClothes()
    if config.parts is not None:
        require_known("loose parts", config.parts, loose_names(template))
    wanted = _wanted(template, config)
    fps = sequence.capture.fps
    why = why_none(template, config, pose_known=reference is not None, followed=track is not None, fps=fps)
    if why is not None or reference is None:
        return LooseClothes(notes=[] if why is None else [why])
    for k, part in enumerate(wanted):
        report(k, len(wanted))
        # A part that cannot be cut (too small, nothing carries it) is left to skinning and the field.
        try:
            garment = cut_garment(template, part, reference, config.garment)
        except InputError as error:
            out.notes.append(str(error))
            log.warning("loose clothes: %s", error)
            continue
        if track is not None and fps is not None:
            # Fit drag and the depth of the pinned edge: the simulation that comes nearest to the track.
            followed = followed_particles(sequence, track, garment, fps)
            garment, calibration = calibrate(template, garment, followed, config=config.calibration)
            out.calibrations.append(calibration)
            if calibration.moves:
                out.outlines[part] = measure_outlines(sequence, garment, fps)
            # The masks decide: a part that follows its joints, or that a simulation moves away from them, stays.
            if config.parts is None and not (calibration.moves and out.outlines[part].better):
                continue
        out.garments.append(garment)
    return out


def why_none(
    template: Template, config: ClothConfig, *, pose_known: bool, followed: bool, fps: float | None
) -> str | None:
    """Return why no part of the clothes can be simulated, as far as known before a training; None: parts may be.

    Args:
        template: the clothed body.
        config: parts to test.
        pose_known: whether the pose of the scan, in which the template is the scanned surface, is known.
        followed: whether the surface is, or will be, tracked through the training frames.
        fps: frames a second of the capture.
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


def loose_names(template: Template) -> list[str]:
    """Return the names of the parts that are not the body."""
    return [name for name in template.part_names if name != BODY_PART]


def _wanted(template: Template, config: ClothConfig) -> list[str]:
    """Return the parts to look at: those named, or all clothes that are neither tight nor rigid."""
    if config.parts is not None:
        return list(config.parts)
    return list(template.loose_parts)


def measure_outlines(
    sequence: AvatarSequence, garment: Garment, fps: float, *, frames: int = 16, cameras: int = 4
) -> Outlines:
    """Compare the outlines with a part skinned and simulated with the masks of training views.

    Args:
        sequence: the training frames.
        garment: the part.
        fps: frames a second.
        frames: largest number of frames; more cost seconds and change little.
        cameras: largest number of cameras of each frame.
    """
    rig, capture = sequence.rig, sequence.capture
    clothed = with_simulated(sequence, [garment])
    wrong: dict[bool, list[float]] = {False: [], True: []}
    for turn, frame in enumerate(spread(sequence.train_frames, frames)):
        for simulated, pose in ((False, sequence.pose(frame)), (True, clothed.as_new_pose(frame))):
            # The same pose with the part skinned and with the part simulated, drawn as silhouettes and compared with
            # the mask.
            mesh = TriangleMesh(rig.skin(pose).double().cpu().numpy(), rig.template.faces)
            for camera in sequence.cameras(frame, turn, cameras, 0):
                image = capture.mask(camera, frame)
                if image is None:
                    continue
                # 1 - IoU; the maximum keeps an empty union from dividing by 0.
                mask, drawn = image > 127, rasterize_mesh(mesh, capture.cameras[camera]).mask
                wrong[simulated].append(1.0 - float((mask & drawn).sum() / max((mask | drawn).sum(), 1)))
    return Outlines(float(np.mean(wrong[False])), float(np.mean(wrong[True])), len(wrong[True]))


def seen_particles(
    sequence: AvatarSequence, track: Track, garments: Sequence[Garment]
) -> Callable[[int], dict[str, np.ndarray]]:
    """Return what tells where the particles of each garment are on the tracked surface of a frame, world, metres.

    Frames that were not tracked have none.
    """

    def seen(frame: int) -> dict[str, np.ndarray]:
        if frame not in track.row:
            return {}
        world = sequence.rig.skin_to_numpy(sequence.pose(frame), track.displacements(frame))
        return {garment.part: world[garment.particles] for garment in garments}

    return seen


def followed_particles(sequence: AvatarSequence, track: Track, garment: Garment, fps: float) -> Followed:
    """Return the positions of a garment's particles on the tracked surface, frame by frame; gaps are NaN."""
    # All frames between the first and the last, because the simulation needs even steps of time; those that were not
    # tracked stay NaN, and their poses repeat the last known one.
    frames = np.arange(min(track.row), max(track.row) + 1)
    poses, world = [], np.full((len(frames), len(garment.particles), 3), np.nan)
    confidence = np.ones(world.shape[:2])
    last = None
    seen = seen_particles(sequence, track, [garment])
    for k, frame in enumerate(frames.tolist()):
        params = sequence.capture.params(frame)
        if frame in track.row and params is not None:
            world[k] = seen(frame)[garment.part]
            confidence[k] = track.confidence(frame).cpu().numpy()[garment.particles]
        last = params if params is not None else last
        assert last is not None  # the first frame is a training frame, which has parameters
        poses.append(last.without_shape())
    return Followed(BodyParams.concatenate(poses), fps, world, confidence)


def with_simulated(sequence: AvatarSequence, garments: Sequence[Garment]) -> AvatarSequence:
    """Return the sequence with garments simulated in poses that are new or count as new; itself without any."""
    fps, capture = sequence.capture.fps, sequence.capture
    if not garments or fps is None:
        return sequence
    return sequence.with_cloth(
        ClothMotions(sequence.rig.template, garments, params=capture.params, frames=capture.frames, fps=fps)
    )
