"""Turn the options of `avatar.train` into the configurations of all its steps, and check what they ask for."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Any, Literal, get_args

from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.training.engine.photometric_task import PhotometricConfig
from avatar.training.engine.resources import Compiled, StageMemory, foretell_memory
from avatar.training.loose_clothes import ClothConfig, loose_names, why_none
from avatar.training.presets import TrainingPreset, training_preset, with_iterations, with_local_shapes
from avatar.training.refinement.config import RefineConfig
from avatar.training.scene import TrainScene, normal_maps
from smplxpp.capture import Capture
from smplxpp.core import InputError, require_choice, require_known, require_positive

log = logging.getLogger(__name__)
STEPS = ("refine", "fit", "teacher", "cloth", "bake", "compensate")
"""The steps of a training in the order in which they run."""
_TRAININGS = ("teacher", "bake", "compensate")
"""Fields of a preset whose losses have a perceptual and a normal term."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Options of a training beside its preset; `smplxpp train` has each of them under the same name.

    Attributes:
        template_frame: frame of the capture that the template was built from, whose parameters pose it as the scan;
            None: not known, then no clothes are simulated.
        refine_cameras: correct the poses of the training cameras together with those of the person.
        refine_frames: frames of a chunk of the refinement, which several processes share.
        refine_gaussians: number of Gaussians that carry the colours of the refinement; None: `RefineConfig`'s.
        max_minutes: stop after as many minutes of work; the same call continues.
        iterations_share: share of the preset's iterations, of all steps.
        iterations: iterations by step ("fit", "teacher", "bake", "compensate"); they replace the preset's.
        batch: poses in a step of optimisation, None for the preset's.
        gaussians: number of Gaussians, None for the preset's.
        blend_shapes: "full" as published; "local": 256 parts with coefficients of their own and 16 columns; "pruned":
            full, and the compact file keeps those that move and colour most.
        max_megabytes: size of the compact file with pruned blend shapes.
        teacher: whether the student is baked from a teacher; False: from the photographs alone.
        loose_parts: names of parts to simulate; they replace those that the training finds.
        perceptual: metric of the perceptual term: "lpips", "st-lpips", "none", or "auto" for the installed one where
            the preset has the term.
        hold_out: cameras to keep from training; empty: those that the capture's splits hold out.
        seed: seed of all random draws.
        device: "auto", "cpu" or "cuda".
        force: repeat steps that are finished.
        tensorboard: log for TensorBoard too.
        checkpoint_minutes: between two checkpoints; None: half a minute, or longer for writing to take 2 %.
        precision: of networks on a GPU: "tf32" (torch's convolutions), "float32", "bfloat16"; "preset": its `amp`.
        compile: how the teacher's networks are compiled on a GPU, see `resources.compile_networks`.
        surface_normals: normals of the followed clothes where a capture has no maps, see `PhotometricConfig`; None: as
            the preset has it.
        readers: threads that decode photographs, see `SequenceConfig`.
        cache_gib: see `AvatarSequence`.

    Raises:
        InputError: a number out of range, an unknown word, or options that exclude each other.
    """

    template_frame: int | None = 0
    refine_cameras: bool = False
    refine_frames: int = 200
    refine_gaussians: int | None = None
    max_minutes: float = math.inf
    iterations_share: float = 1.0
    iterations: Mapping[str, int] = field(default_factory=dict)
    batch: int | None = None
    gaussians: int | None = None
    blend_shapes: Literal["full", "local", "pruned"] = "full"
    max_megabytes: float = 20.0
    teacher: bool = True
    loose_parts: tuple[str, ...] = ()
    perceptual: Literal["auto", "lpips", "st-lpips", "none"] = "auto"
    hold_out: tuple[str, ...] = ()
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    force: bool = False
    tensorboard: bool = False
    checkpoint_minutes: float | None = None
    precision: Literal["preset", "tf32", "float32", "bfloat16"] = "preset"
    compile: Compiled = "off"
    surface_normals: bool | None = None
    readers: int | None = None
    cache_gib: float | None = None

    def __post_init__(self) -> None:
        for name, value, least in (
            ("gaussians", self.gaussians, 1),
            ("batch", self.batch, 1),
            ("seed", self.seed, 0),
            ("max-megabytes", self.max_megabytes, 0),
            ("refine-frames", self.refine_frames, 1),
            ("refine-gaussians", self.refine_gaussians, 1),
            ("readers", self.readers, 1),
            ("cache-gib", self.cache_gib, 0),
            *((f"{step}-iterations", value, 1) for step, value in self.iterations.items()),
        ):
            if value is not None and not value >= least:
                raise InputError(f"option {name}", expected=f"a number, at least {least}", received=f"{value:g}")
        if not 0.0 < self.iterations_share < math.inf:
            raise InputError(
                "option iterations-share", expected="a number above 0", received=f"{self.iterations_share:g}"
            )
        if not self.max_minutes > 0:
            raise InputError("option max-minutes", expected="a number above 0", received=f"{self.max_minutes:g}")
        if self.checkpoint_minutes is not None:
            require_positive("option checkpoint-minutes", self.checkpoint_minutes)
        for step in self.iterations:
            require_choice("iterations of a step", step, ("fit", *_TRAININGS))
        require_choice("option precision", self.precision, ("preset", "tf32", "float32", "bfloat16"))
        require_choice("option compile", self.compile, get_args(Compiled))

    def recipe(
        self, preset: str | TrainingPreset = "cpu", *, cloth: Literal["auto", "none"] = "auto", turn_views: int = 0
    ) -> Recipe:
        """Return the configurations of all steps; whether poses are refined is decided when the capture is known.

        Args:
            preset: name of a preset, or a preset of your own.
            cloth: "auto": clothes that leave skinning and that a simulation improves are simulated; "none": no clothes.
            turn_views: number of views of a person who turns before one camera, see `TrainingPreset.for_turn`; 0 where
                all cameras see the same moment.

        Raises:
            InputError: an unknown preset.
            MissingExtraError: a perceptual metric that is named and not installed.
        """
        # Seed and share of the iterations first, then single options, which therefore are taken as given.
        chosen = training_preset(preset) if isinstance(preset, str) else preset
        chosen = chosen.for_turn(turn_views) if turn_views else chosen
        chosen = self._changed(chosen.with_seed(self.seed).shortened(self.iterations_share))
        if self.batch is not None:
            chosen = with_batch(chosen, self.batch)
        if self.perceptual in ("lpips", "st-lpips"):
            chosen = with_perceptual(chosen)
        if self.surface_normals is not None:
            chosen = _with_changes(chosen, lambda config: {"surface_normals": self.surface_normals})
        if self.precision != "preset":
            chosen = _with_changes(chosen, lambda config: {"amp": self.precision == "bfloat16"})
        return Recipe(
            preset=chosen,
            teacher=self.teacher and not turn_views,
            perceptual=choose_perceptual(self.perceptual, chosen),
            blend_shapes=self.blend_shapes,
            max_megabytes=self.max_megabytes,
            cloth=None if cloth == "none" or turn_views else ClothConfig(parts=self.loose_parts or None),
        )

    def refinement(self, *, wanted: bool) -> RefineConfig | None:
        """Return how poses are refined; None where they are not wanted.

        Raises:
            InputError: cameras are to be corrected without poses.
        """
        if self.refine_cameras and not wanted:
            raise InputError(
                "option refine-cameras",
                expected="poses that are refined too",
                received="parameters that stand as they are",
                remedy="add --refine-poses on",
            )
        if not wanted:
            return None
        how = RefineConfig(seed=self.seed, cameras=self.refine_cameras, chunk_frames=self.refine_frames)
        if self.refine_gaussians is None:
            return how
        # The head keeps its number: with half of it, heads of the embedded person turn .77 degrees off, not .62.
        count, usual = self.refine_gaussians, how.sampling
        share = usual.head_share
        if share is not None:
            share = max(share, min(share * usual.count / count, 0.5))
        return replace(how, sampling=replace(usual, count=count, head_share=share))

    @property
    def checkpoint_seconds(self) -> float | None:
        """Seconds between two checkpoints, None: by the time that writing takes."""
        return None if self.checkpoint_minutes is None else 60.0 * self.checkpoint_minutes

    def _changed(self, preset: TrainingPreset) -> TrainingPreset:
        """Return the preset with other iterations and another number of Gaussians."""
        # Teacher and bake shorten their pretraining in proportion; fit and compensation have none.
        changed: dict[str, Any] = {}
        for step, count in self.iterations.items():
            change = with_iterations if step in ("teacher", "bake") else replace
            changed[step] = change(getattr(preset, step), iterations=count)
        if self.gaussians is not None:
            fit = changed.get("fit", preset.fit)
            changed["fit"] = replace(fit, sampling=replace(fit.sampling, count=self.gaussians))
        return replace(preset, **changed)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Configurations of all steps of a training.

    Attributes:
        preset: configurations of fit, teacher, bake and compensation.
        refine: how poses are refined first; None: they are not.
        teacher: bake from a teacher; False: from the photographs alone.
        perceptual: metric of the perceptual term: "lpips", "st-lpips" or "none".
        blend_shapes: see `TrainConfig`.
        max_megabytes: size of the compact file of a pruned student.
        cloth: which clothes are simulated in new motion; None: none.
    """

    preset: TrainingPreset
    refine: RefineConfig | None = None
    teacher: bool = True
    perceptual: str = "none"
    blend_shapes: str = "full"
    max_megabytes: float = 20.0
    cloth: ClothConfig | None = field(default_factory=ClothConfig)

    @property
    def shapes(self) -> BlendShapeConfig:
        """The blend shapes of the student."""
        shapes = self.preset.blend_shapes
        return with_local_shapes(shapes) if self.blend_shapes == "local" else shapes

    @property
    def max_bytes(self) -> float | None:
        """Bound of the compact file, bytes; None where it has all blend shapes."""
        return 1e6 * self.max_megabytes if self.blend_shapes == "pruned" else None

    @property
    def follows(self) -> bool:
        """Whether a teacher follows the surface through the frames."""
        return self.teacher and self.preset.teacher.track is not None


def with_perceptual(preset: TrainingPreset) -> TrainingPreset:
    """Return the preset with the paper's weight of the perceptual term where it has none."""
    weight = ReconstructionWeights().perceptual
    return _with_changes(
        preset,
        lambda config: {"weights": replace(config.weights, perceptual=config.weights.perceptual or weight)},
    )


def with_batch(preset: TrainingPreset, items: int) -> TrainingPreset:
    """Return the preset with `items` poses in a step of every training."""
    return _with_changes(preset, lambda config: {"poses_per_step": items})


def with_processes(preset: TrainingPreset, count: int) -> TrainingPreset:
    """Return the preset with a pose of each step for every process, and no more poses in all.

    A batch that grows k times takes a k-th of the steps at sqrt(k) times the rates, because Adam's steps follow the
    noise of the gradient, which falls with sqrt(k) (Malladi et al. 2022, "On the SDEs and scaling rules for adaptive
    gradient algorithms").
    """

    def changes(config: PhotometricConfig) -> dict[str, Any]:
        grown = max(1.0, count / config.poses_per_step)
        names = [name for name in ("lr", "attributes", "position_lr", "color_lr") if hasattr(config, name)]
        return {
            "poses_per_step": max(count, config.poses_per_step),
            "iterations": math.ceil(config.iterations / grown),
            **{name: getattr(config, name) * math.sqrt(grown) for name in names},
        }

    grown = _with_changes(preset, changes)
    joint = grown.teacher.joint
    joint = joint and replace(joint, poses=max(count, joint.poses))
    return replace(grown, teacher=replace(grown.teacher, joint=joint))


def _with_changes(preset: TrainingPreset, changes: Callable[[PhotometricConfig], Mapping[str, Any]]) -> TrainingPreset:
    """Return the preset with changes of the three trainings."""
    trainings = {name: getattr(preset, name) for name in _TRAININGS}
    return replace(preset, **{name: replace(config, **changes(config)) for name, config in trainings.items()})


def choose_perceptual(name: str, preset: TrainingPreset) -> str:
    """Return the name of the perceptual metric; for "auto" the installed one, or "none" where no loss has the term.

    Raises:
        MissingExtraError: a metric that is named and not installed.
    """
    if name != "auto":
        # Load the metric now: a missing package is an error before hours of training.
        if name != "none":
            from avatar.losses.perceptual_weights import load_lpips, load_st_lpips

            (load_lpips if name == "lpips" else load_st_lpips)()
        return name
    if not any(getattr(preset, one).weights.perceptual for one in _TRAININGS):
        return "none"
    for package, metric in (("lpips", "lpips"), ("stlpips_pytorch", "st-lpips")):
        if find_spec(package) is not None:
            return metric
    log.warning(
        "neither lpips nor stlpips-pytorch is installed: training without the perceptual term "
        "(pip install lpips torchvision, or pip install --no-deps stlpips-pytorch)"
    )
    return "none"


def check_training(scene: TrainScene, recipe: Recipe, steps: Sequence[str], *, pose_known: bool) -> None:
    """Refuse what a template cannot have before any work is done, and warn of loose clothes that cannot be simulated.

    Args:
        scene: what is trained on.
        recipe: what is trained.
        steps: names of the steps, of `STEPS`.
        pose_known: whether the pose of the scan that the template was built from is known.

    Raises:
        InputError: blend shapes for a body without expressions, or names of parts that the template does not have.
    """
    if "compensate" in steps and not scene.template.body.num_expressions:
        raise InputError(
            "template",
            expected="a body with expressions, which drive the head's blend shapes",
            received="none",
            remedy="build the template on the open body or on SMPL-X, or stop with --until bake",
        )
    if recipe.cloth is None:
        return
    # Wrong names are refused now; parts that cannot be simulated only cost a warning.
    if "cloth" in steps and recipe.cloth.parts:
        require_known("loose parts", recipe.cloth.parts, loose_names(scene.template))
    if recipe.follows and {"teacher", "cloth"} & set(steps):
        why = why_none(scene.template, recipe.cloth, pose_known=pose_known, followed=True, fps=scene.capture.fps)
        if why is not None:
            log.warning("loose clothes: %s", why)


def memory_on(capture: Capture, recipe: Recipe, steps: Sequence[str]) -> dict[str, StageMemory]:
    """Return what some steps need on a capture, see `foretell_memory`."""
    cameras = [capture.cameras[name] for name in capture.splits.train_cameras]
    pixels = max(camera.width * camera.height for camera in cameras)
    frames = len(capture.splits.train_frames)
    return foretell_memory(
        recipe, megapixels=1e-6 * pixels, images=len(cameras) * frames, frames=max(frames, 1), steps=steps
    )


def note_missing_normals(capture: Capture, recipe: Recipe, steps: Sequence[str]) -> None:
    """Log once where the loss has no normal term although the recipe asks for one."""
    # Compare the number of training views with a normal map with that of all training views.
    trainings = [getattr(recipe.preset, name) for name in ("teacher", "bake", "compensate") if name in steps]
    there, views = normal_maps(capture)
    if there == views or not any(training.weights.normal for training in trainings):
        return
    if there:
        log.info("%d of %d training views have a normal map: the loss has no normal term in the others", there, views)
    elif recipe.follows and any(training.surface_normals for training in trainings):
        log.info("capture %s has no normal maps: those of followed clothes stand for them", capture.name)
    else:
        log.info("capture %s has no normal maps: the loss has no normal term", capture.name)
