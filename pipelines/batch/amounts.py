"""What decides a cost: facts of a capture, and the work of a training's stages.

The stages of a training take of one core a constant, and rates of the work that they do:

    seconds = start + vertices x opening + looks (a + b megapixels + c Gaussians) + poses x (rig and networks)

A look draws a view of one pose, compares it and differentiates; one without derivatives counts as `drawn` of it. The
work follows from the preset, from frames, cameras and pixels of a capture, and from the template's vertices and loose
parts. Which of these a simulation has to move is known when the surface has been followed: till then the search for
clothes takes a range. Rates are of a single core.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.batch.jobs import is_address
from pipelines.runs.layout import TEMPLATE
from smplxpp.capture import open_capture
from smplxpp.capture.declared import has_estimated_params
from smplxpp.capture.reference import find_scans
from smplxpp.core import spread
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.template.template import Template

if TYPE_CHECKING:
    from avatar.training.recipe import Recipe
    from avatar.training.refinement.config import RefineConfig


@dataclass(frozen=True)
class Facts:
    """What decides the cost of a subject.

    Attributes:
        frames: of the capture.
        cameras: of the capture.
        megapixels: of an image that is trained on.
        source_mb: of an image as it was recorded, with its mask, MB.
        held_out_cameras: cameras that are measured.
        held_out_frames: frames that are measured.
        scan_mb: of the reference frame's scan; 0 where there is none.
        tracked: whether its parameters are estimates, which a training refines.
        vertices: of the template; those of a usual one before it is built.
        loose: parts of the template that may hang freely; those of a usual one before it is built.
    """

    frames: int
    cameras: int
    megapixels: float
    source_mb: float
    held_out_cameras: int = 2
    held_out_frames: int = 0
    scan_mb: float = 0.0
    tracked: bool = False
    vertices: int = 20_000
    loose: int = 2

    @property
    def images(self) -> int:
        """Return the number of images."""
        return self.frames * self.cameras


@dataclass(frozen=True)
class TrainingRates:
    """Rates of the stages of a training, seconds of one core.

    Measured on two captures at two sizes each; those of looks, on trainings of three people by `cpu`.

    Attributes:
        start_s: of each stage: opening, what it takes over, its files and figures.
        start_s_kv: the same, a thousand vertices of the template.
        look_s: a look, beside its pixels and Gaussians.
        look_s_mp: a megapixel of the whole image, of which a person fills a part.
        look_s_kg: a thousand Gaussians.
        drawn: share of a look that drawing alone takes.
        pose_s: networks and rig of a pose in a step, by stage; of the field a thousand control points.
        frame_s: of a frame beside its looks: following it, relating its pose to the surface, and of each loose part.
        simulated_s: of a frame of clothes whose simulation is fitted to it, ten times over.
    """

    start_s: Mapping[str, float] = field(
        default_factory=lambda: {
            **{"refine": 1.0, "fit": 0.5, "teacher": 2.0, "cloth": 0.8, "bake": 0.4, "compensate": 0.8}
        }
    )
    start_s_kv: Mapping[str, float] = field(
        default_factory=lambda: {
            **{"refine": 0.07, "fit": 0.06, "teacher": 0.09, "cloth": 0.04, "bake": 0.04, "compensate": 0.07}
        }
    )
    look_s: float = 0.001
    look_s_mp: float = 0.19
    look_s_kg: float = 0.00085
    drawn: float = 0.4
    pose_s: Mapping[str, float] = field(
        default_factory=lambda: {
            **{"pretrain": 0.0155, "teacher": 0.063, "field": 0.006, "bake": 0.005, "compensate": 0.005}
        }
    )
    frame_s: Mapping[str, float] = field(
        default_factory=lambda: {"teacher": 0.15, "cloth": 0.05, "bake": 0.08, "compensate": 0.05}
    )
    simulated_s: float = 0.5


@dataclass
class Work:
    """Looks of a stage, the images that they read, and their megapixels; what the rest of it takes, seconds.

    `unsure` seconds more or fewer are taken by what only the stage itself finds out.
    """

    stage: str
    vertices: int
    gaussians: int = 0
    looks: float = 0.0
    reads: float = 0.0
    megapixels: float = 0.0
    seconds: float = 0.0
    unsure: float = 0.0

    def look(self, count: float, megapixels: float, halvings: int = 0, *, reads: float | None = None) -> None:
        """Add looks at photographs that are halved; each reads its image, unless `reads` of them are kept."""
        self.looks += count
        self.reads += count if reads is None else reads
        self.megapixels += count * megapixels / 4.0**halvings

    def takes(self, rates: TrainingRates) -> float:
        """Return the seconds of one core."""
        each = rates.look_s + rates.look_s_kg * 1e-3 * self.gaussians
        start = rates.start_s[self.stage] + rates.start_s_kv[self.stage] * 1e-3 * self.vertices
        return start + self.looks * each + self.megapixels * rates.look_s_mp + self.seconds


def recipe_of(options: Mapping[str, Any], *, tracked: bool = True) -> Recipe:
    """Return the configurations of a training with options by their names.

    Args:
        options: of `smplxpp train`.
        tracked: whether the parameters of the frames are estimates, which are refined by default.

    Raises:
        InputError: an option out of range.
        MissingExtraError: torch is not installed.
    """
    if find_spec("torch") is None:
        raise MissingExtraError("torch", extra="avatar", purpose="foretelling a training")
    from avatar.training.recipe import TrainConfig

    iterations = {step: options.get(f"{step}_iterations") for step in ("fit", "teacher", "bake", "compensate")}
    config = TrainConfig(
        iterations_share=float(options.get("iterations_share") or 1.0),
        iterations={step: int(count) for step, count in iterations.items() if count is not None},
        batch=_number(options.get("batch")),
        gaussians=_number(options.get("gaussians")),
        refine_frames=int(options.get("refine_frames", 200)),
        refine_gaussians=_number(options.get("refine_gaussians")),
        loose_parts=tuple(options.get("loose_parts") or ()),
        teacher=not options.get("no_teacher", False),
        perceptual="none",
    )
    choice = options.get("refine_poses", "auto")
    wanted = choice == "on" or (choice == "auto" and tracked)
    recipe = config.recipe(options.get("preset", "cpu"), cloth=options.get("cloth", "auto"))
    return replace(recipe, refine=config.refinement(wanted=wanted))


def _number(value: Any) -> int | None:
    return None if value is None else int(value)


def training_works(recipe: Recipe, facts: Facts, rates: TrainingRates) -> dict[str, Work]:
    """Return the work of every stage, by the name of its step.

    Args:
        recipe: configurations of the stages.
        facts: of the capture.
        rates: of the machine.
    """
    preset, size, works = recipe.preset, facts.megapixels, dict[str, Work]()
    count = preset.fit.sampling.count
    if recipe.refine is not None:
        works["refine"] = _refinement(recipe.refine, facts)
    measured = min(2, facts.frames) * max(facts.held_out_cameras, 1) + 2.0 * min(2, facts.held_out_frames)
    fit = Work("fit", facts.vertices, count)
    fit.look(preset.fit.iterations, size)
    fit.look(rates.drawn * preset.fit.evaluations * max(facts.held_out_cameras, 1), size)
    works["fit"] = fit
    for step in ("teacher", "bake", "compensate"):
        if step == "teacher" and not recipe.teacher:
            continue
        config, work = getattr(preset, step), Work(step, facts.vertices, count)
        poses = config.iterations * config.poses_per_step
        work.look(poses * config.views, size)
        work.look(rates.drawn * config.evaluations * measured, size)
        work.seconds += rates.pose_s[step] * poses
        pretrain = getattr(config, "pretrain", None)
        if pretrain is not None:
            a_pose = rates.pose_s["pretrain"]
            if step == "bake":
                a_pose = rates.pose_s["field"] * 1e-3 * (preset.control_points or 2400)
            work.seconds += a_pose * pretrain.iterations * pretrain.batch
        works[step] = work
    track = preset.teacher.track
    if recipe.follows and track is not None:
        frames = facts.frames - facts.held_out_frames
        # Each segment of a longer motion after the first is tracked with the reference frame and a run-in.
        followed = frames + (math.ceil(frames / track.segment_frames) - 1) * (track.run_in + 1)
        for level in track.levels:
            # A frame's photographs are read once, for all of its steps.
            cameras = facts.cameras - facts.held_out_cameras
            looks, reads = followed * level.steps * min(track.views, cameras), followed * cameras / len(track.levels)
            works["teacher"].look(looks, size, level.halvings, reads=reads)
        if preset.teacher.joint is not None:
            works["teacher"].look(preset.teacher.joint.looks * preset.teacher.joint.steps(frames), size)
        for step in ("teacher", "bake", "compensate"):
            works[step].seconds += rates.frame_s[step] * frames
        if recipe.cloth is not None:
            works["cloth"] = _search_for_clothes(recipe.cloth.parts, facts, rates, frames)
    return works


def _search_for_clothes(named: tuple[str, ...] | None, facts: Facts, rates: TrainingRates, frames: int) -> Work:
    """Return what clothes take: each loose part is compared with skinning, and simulated where it departs from it."""
    parts = facts.loose if named is None else len(named)
    work = Work("cloth", facts.vertices, seconds=rates.frame_s["cloth"] * frames * parts)
    simulated = rates.simulated_s * frames
    if named is not None:
        work.seconds += simulated * parts
    elif parts:
        # None of them, or one: trousers and a shirt do not depart, a skirt does.
        work.seconds, work.unsure = work.seconds + simulated / 2.0, simulated / 2.0
    return work


def _refinement(config: RefineConfig, facts: Facts) -> Work:
    """Return the looks of a refinement: passes over all frames, then start and result drawn once more."""
    work, cameras = Work("refine", facts.vertices, config.sampling.count), facts.cameras - facts.held_out_cameras
    for level in config.levels:
        work.look(facts.frames * cameras * (level.steps + 1), facts.megapixels, level.halvings)
    work.look(0.8 * facts.frames * cameras, facts.megapixels, config.levels[-1].halvings)
    for level in config.reference_levels:
        work.look(cameras * (level.steps + 1), facts.megapixels, level.halvings)
    return work


def facts_of(
    place: str | Path, *, protocol: str | None = None, params: Path | None = None, run: Path | None = None
) -> Facts | None:
    """Return what a capture's files say about its cost; None where it is elsewhere, or cannot be opened.

    Args:
        place: its folder, or an address.
        protocol: of the capture.
        params: parameters to read in the place of its own.
        run: folder of a run, whose template counts where there is one.
    """
    if is_address(str(place)) or not Path(place).is_dir():
        return None
    try:
        capture = open_capture(Path(place), protocol=protocol, params=params)
    except InputError:  # the batch itself says what is wrong with it
        return None
    cameras, splits = list(capture.cameras.values()), capture.splits
    # A few views stand for all.
    frames = spread(list(capture.frames), 4)
    views = [(name, frame) for name in capture.cameras for frame in frames][:64]
    files = [capture.file(*view, kind) for view in views for kind in ("image", "mask")]
    sizes = [file.stat().st_size for file in files if file is not None]
    facts = Facts(
        frames=len(capture.frames),
        cameras=len(cameras),
        megapixels=sum(camera.width * camera.height for camera in cameras) / max(len(cameras), 1) / 1e6,
        source_mb=1e-6 * sum(sizes) / max(len(views), 1),
        held_out_cameras=len(splits.novel_view_cameras),
        held_out_frames=len(splits.novel_pose_frames),
        scan_mb=scan_mb(place),
        tracked=has_estimated_params(capture),
    )
    if run is None or not (run / TEMPLATE).is_file():
        return facts
    template = Template.load(run / TEMPLATE)
    return replace(facts, vertices=len(template.vertices), loose=len(template.loose_parts))


def scan_mb(capture: str | Path) -> float:
    """Return the size of a capture's first scan as a binary PLY would have it, MB; 0 without one."""
    for path in find_scans(capture).values():
        return 1e-6 * path.stat().st_size * (1.0 if path.suffix.lower() in (".ply", ".glb") else 0.2)
    return 0.0
