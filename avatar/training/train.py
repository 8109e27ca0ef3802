"""`avatar.train`: a template and a capture to a student, step by step in a folder; finished steps are not repeated."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from avatar.data.one_frame import views_of_turn
from avatar.data.sequence import AvatarSequence, SequenceConfig
from avatar.gaussians.tensor_file import load_bound, save_bound
from avatar.losses.perceptual_weights import load_metric
from avatar.models.model_file import load_avatar, save_avatar
from avatar.models.open_student import TRAINING_FILES, open_student
from avatar.models.student import Student
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rig.rig import Rig
from avatar.training.engine.loop import Progress
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import (
    allow_tf32,
    check_memory,
    choose_device,
    explain_resource_errors,
    keep_freed_memory,
)
from avatar.training.engine.session import Session
from avatar.training.fit.fit import fit_gaussians, fit_scene
from avatar.training.fit_teacher import fit_teacher
from avatar.training.loose_clothes import find_garments, with_simulated
from avatar.training.presets import TrainingPreset
from avatar.training.recipe import STEPS, Recipe, TrainConfig, check_training, memory_on, note_missing_normals
from avatar.training.refinement.board import RefinementStoppedError
from avatar.training.refinement.refine_capture import refine_capture, with_refined_poses
from avatar.training.scene import TrainScene, hold_out_cameras, prepare_scene
from avatar.training.student.bake import bake
from avatar.training.student.compensate import compensate, write_student
from smplxpp.capture import Capture
from smplxpp.capture.declared import has_estimated_params
from smplxpp.cloth.garment_file import load_garments, save_garments
from smplxpp.core import BodyParams, InputError, require_choice
from smplxpp.core.files import atomic_folder, atomic_write_text, jsonable, read_bytes, read_json
from smplxpp.template.template import Template

log = logging.getLogger(__name__)
_RECORD = "step.json"
Report = Callable[[str, Progress], None]


class UnfinishedTrainingError(RuntimeError):
    """The limit of time ended a training before its last step; the same call continues."""


def train(
    template: Template,
    capture: Capture,
    out: str | Path,
    *,
    preset: str | TrainingPreset = "cpu",
    refine: Literal["auto", "on", "off"] = "auto",
    cloth: Literal["auto", "none"] = "auto",
    config: TrainConfig | None = None,
    report: Report = lambda step, progress: None,
) -> Student:
    """Train a student on a capture, as `smplxpp train` does: the same inputs and seed give the same bits.

    Poses are refined on the photographs where they are estimates. Gaussians are fitted to the template's frame, a
    teacher follows the surface and learns the photographs, loose clothes are cut and fitted to the tracked surface,
    the student is baked from the teacher, and its blend shapes learn what is left.

    Args:
        template: the clothed body, as `smplxpp.build_template` gives it.
        capture: with images, masks, and the parameters of its frames; its splits say what is held out.
        out: folder of checkpoints and results. A step that is finished there with the same inputs is not
            repeated, and an interrupted one continues.
        preset: "demo" (minutes), "cpu", "gpu", "paper", "paper-small", or a preset of your own.
        refine: "auto": refine the poses where they were registered, or where the capture declares them as tracked.
        cloth: "auto": simulate the clothes that leave skinning and that a simulation improves; "none": no clothes.
        config: all other options.
        report: called with a step's name and its progress.

    Returns:
        The student with its template and its loose clothes, as `avatar.load(out)` gives it again.

    Raises:
        InputError: unusable input, an option out of range, a checkpoint of other inputs (which stays), or too little
            memory or disk.
        UnfinishedTrainingError: `config.max_minutes` are over; the same call continues.

    Example:
        >>> built = smplxpp.build_template("scan.ply", capture=smplxpp.open_capture("capture"))
        >>> student = avatar.train(built.template, built.capture, "out", preset="demo")
        >>> student.export("me.avatar")
    """
    config = config or TrainConfig()
    require_choice("refine", refine, ("auto", "on", "off"))
    require_choice("cloth", cloth, ("auto", "none"))
    if config.loose_parts and (cloth == "none" or not config.teacher):
        raise InputError(
            "loose_parts",
            expected='cloth="auto" and a teacher, to whose followed surface clothes are fitted',
            received=f"cloth={cloth!r}, teacher={config.teacher}",
        )
    # All configurations are made, and wrong options refused, before any file is written.
    recipe = config.recipe(preset, cloth=cloth)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    # The template is trained on as it is read back, so that a student opened later stands on the same numbers.
    template.save(folder / TRAINING_FILES.template)
    template = Template.load(folder / TRAINING_FILES.template)
    capture = hold_out_cameras(capture, config.hold_out)
    recipe = config.recipe(preset, cloth=cloth, turn_views=views_of_turn(capture))
    training = _Training(folder, config, recipe, report)
    reference = _reference_pose(capture, config.template_frame)
    if reference is not None:
        reference.save(folder / TRAINING_FILES.reference)
    scene = prepare_scene(template, capture, built_frame=config.template_frame)
    _refuse_held_out_template(capture, config.template_frame)
    # Checks that need the template, the capture and the recipe together; after them only work is left.
    steps = [step for step in STEPS if step not in ({"cloth"} if recipe.cloth is None else ())]
    check_training(scene, recipe, steps, pose_known=reference is not None)
    how = config.refinement(wanted=refine == "on" or (refine == "auto" and has_estimated_params(capture)))
    if training.device.startswith("cuda"):
        check_memory(memory_on(scene.capture, replace(recipe, refine=how), steps), training.device)
    if how is not None:
        settings = {"refinement": how, "reference": scene.frame}
        work = lambda session, made: _refine(scene, how, session, made, training.device)  # noqa: E731
        found = training.once("refine", settings, scene, {}, work)
        refined = with_refined_poses(capture, found)
        scene = prepare_scene(template, refined, built_frame=config.template_frame, before=scene)
    note_missing_normals(scene.capture, recipe, steps)
    training.models(scene, reference)
    return open_student(folder, TRAINING_FILES, device=training.device)


def _reference_pose(capture: Capture, frame: int | None) -> BodyParams | None:
    """Return the parameters that pose the template as its scan; None where they are not known."""
    params = None if frame is None else capture.params(frame)
    return None if params is None else params.without_shape()


def _refuse_held_out_template(capture: Capture, frame: int | None) -> None:
    """Refuse a template that was built from a held-out frame.

    Raises:
        InputError: the frame is among the held-out frames of the capture's splits.
    """
    if frame in capture.splits.novel_pose_frames:
        raise InputError(
            f"held-out frames of capture {capture.name}",
            expected="frames that neither the template nor a model has seen",
            received=f"frame {frame}, from which the template was built",
            remedy="hold out other frames in the capture's splits, or build the template from a training frame",
        )


def _refine(scene: TrainScene, config: Any, session: Session, folder: Path, device: str) -> Progress:
    def show(step: str, share: float) -> None:
        session.report(Progress(round(100 * share), 100, 0.0, 0.0))

    until, work = time.monotonic() + session.max_seconds, session.folder / session.key[:16]
    try:
        stop = lambda: time.monotonic() > until  # noqa: E731
        refine_capture(scene, config, folder, work=work, progress=show, stop=stop, device=device)
    except RefinementStoppedError:
        return Progress(0, 1, 0.0, 0.0)
    return Progress(1, 1, 0.0, 0.0)


def _teacher(path: Path, rig: Rig) -> TeacherAvatar:
    """Read a teacher that this training wrote."""
    model = load_avatar(path, rig)
    assert isinstance(model, TeacherAvatar)
    return model


class _Training:
    """The steps of a training in a folder, each made once and read back from its file.

    Args:
        folder: where the steps are kept, one folder each.
        config: options of the training.
        recipe: configurations of the steps.
        report: called with a step's name and its progress.
    """

    def __init__(self, folder: Path, config: TrainConfig, recipe: Recipe, report: Report) -> None:
        self.folder, self.config, self.recipe, self.report = folder, config, recipe, report
        self.device = choose_device(config.device)
        self._together = Distributed(device=self.device)
        self._deadline = time.monotonic() + 60.0 * config.max_minutes
        self._worked = False
        keep_freed_memory()
        allow_tf32(config.precision)

    @cached_property
    def _metric(self) -> Any:
        """The perceptual distance, loaded when the first photometric step starts."""
        return load_metric(self.recipe.perceptual, device=self.device)

    def models(self, scene: TrainScene, reference: BodyParams | None) -> None:
        """Make the models of the training, each from the files of those before it.

        Args:
            scene: what is trained on, with refined poses if they were refined.
            reference: parameters that pose the template as its scan; None: no clothes are simulated.
        """
        preset, template = self.recipe.preset, scene.template
        reading, kept = SequenceConfig(readers=self.config.readers), self.config.cache_gib
        sequence = AvatarSequence(scene.capture, template, reading, device=self.device, cache_gib=kept)
        rig = sequence.rig

        # Gaussians on the template, coloured and placed by the photographs of one frame.
        def fit(session: Session, made: Path) -> Progress:
            result = fit_gaussians(
                fit_scene(scene, template),
                preset.fit,
                session.folder,
                key=session.key,
                device=self.device,
                max_seconds=session.max_seconds,
                report=session.report,
            )
            save_bound(result.gaussians, made / "gaussians.safetensors")
            return result.progress

        fitted = self.once("fit", {"fit": preset.fit, "frame": scene.frame}, scene, {}, fit) / "gaussians.safetensors"
        gaussians = load_bound(fitted, faces=rig.template.faces).to(device=rig.device)
        source, teacher, garments = fitted, None, []
        needs = {"source": fitted}
        if self.recipe.teacher:
            # Track the surface through the frames, then train the teacher's maps on the photographs.
            training = preset.teacher.starting_at(scene.built_frame)

            def teach(session: Session, made: Path) -> Progress:
                model, done = fit_teacher(sequence, gaussians, preset.networks.teacher, training, session)
                save_avatar(made / "teacher.safetensors", model)
                return done

            settings = {"training": training, "networks": preset.networks.teacher}
            source = self.once("teacher", settings, scene, {"gaussians": fitted}, teach) / "teacher.safetensors"
            needs = {"source": source}
            teacher = _teacher(source, rig)
            if self.recipe.cloth is not None:
                # Cut the clothes that depart from skinning, and calibrate them to the tracked surface.
                how = self.recipe.cloth

                def simulate(session: Session, made: Path) -> Progress:
                    found = find_garments(sequence, reference, how, teacher.track)
                    save_garments(made / "garments.npz", found.garments)
                    return Progress(1, 1, 0.0, 0.0)

                cut = self.once("cloth", {"cloth": how}, scene, {"teacher": source}, simulate) / "garments.npz"
                garments = load_garments(cut, template)
                needs["cloth"] = cut
        clothed = with_simulated(sequence, garments)

        # The teacher's maps become motion of the student's mesh; new poses are shown with simulated clothes.
        def baked(session: Session, made: Path) -> Progress:
            # Each step has a teacher of its own: the bake freezes the one it is given.
            own = None if teacher is None else _teacher(source, rig)
            start = gaussians if own is None else own.gaussians.snapshot()
            model, done = bake(clothed, start, preset.student(), preset.bake, session, teacher=own)
            save_avatar(made / "student.safetensors", model)
            return done

        settings = {"training": preset.bake, "student": preset.student()}
        bake_file = self.once("bake", settings, scene, needs, baked) / "student.safetensors"

        # Blend shapes learn what the field leaves over.
        shapes = replace(self.recipe.shapes, expression_size=template.body.num_expressions)

        def compensated(session: Session, made: Path) -> Progress:
            own = _teacher(source, rig) if teacher is not None and preset.compensate.init_from_track else None
            start = load_avatar(bake_file, rig)
            assert isinstance(start, Student)
            model, done = compensate(clothed, start, shapes, preset.compensate, session, teacher=own)
            write_student(
                made / "student.safetensors",
                made / "student_compact.safetensors",
                model,
                clothed,
                preset.compensate,
                max_bytes=self.recipe.max_bytes,
                context=session.context,
            )
            return done

        settings = {"training": preset.compensate, "blend_shapes": shapes, "max_bytes": self.recipe.max_bytes}
        self.once("compensate", settings, scene, {**needs, "student": bake_file}, compensated)

    def once(
        self,
        step: str,
        settings: Mapping[str, Any],
        scene: TrainScene,
        needs: Mapping[str, Path],
        work: Callable[[Session, Path], Progress],
    ) -> Path:
        """Do a step unless its folder stands with the same inputs; return the folder.

        Args:
            step: name of the step and of its folder.
            settings: all choices that the result depends on.
            scene: template and capture.
            needs: files of earlier steps, by their role.
            work: writes the step's files into the folder that it is given.

        Raises:
            UnfinishedTrainingError: the limit of time ended it; its checkpoint stays.
        """
        folder, state = self.folder / step, self.folder / f"{step}_work"
        # A finished step has the key of its inputs in its record; equal keys mean equal results.
        key = self._key(settings, scene, needs)
        record = folder / _RECORD
        if not self.config.force and record.is_file() and read_json(record).get("key") == key:
            log.info("%s: stands, skipped", step)
            return folder
        # At least one step works in each call, so that repeated calls with a short limit make progress.
        left = self._deadline - time.monotonic()
        if left <= 0.0 and self._worked:
            raise UnfinishedTrainingError(f"the limit of time was over before {step}; the same call continues")
        self._worked = True
        if self.config.force:
            shutil.rmtree(state, ignore_errors=True)
        session = Session(
            state,
            key,
            self._metric if step in ("teacher", "bake", "compensate") else None,
            self._together,
            max(left, 1e-9),  # each call takes one iteration at least
            tensorboard=self.config.tensorboard,
            checkpoint_seconds=self.config.checkpoint_seconds,
            report=lambda progress: self.report(step, progress),
            compile=self.config.compile,
        )
        with explain_resource_errors(self.folder), atomic_folder(folder) as made:
            done = work(session, made)
            if not done.finished:
                raise UnfinishedTrainingError(
                    f"{step} stopped at {done.iteration} of {done.iterations} iterations; the same call continues"
                )
            if state.is_dir():  # metrics of the step, and of the tracking and pretraining before it
                shutil.copytree(state, made / "log", ignore=shutil.ignore_patterns("*.safetensors", "*.npz"))
            atomic_write_text(made / _RECORD, json.dumps({"key": key, "settings": jsonable(settings)}, indent=1))
        shutil.rmtree(state, ignore_errors=True)
        return folder

    def _key(self, settings: Mapping[str, Any], scene: TrainScene, needs: Mapping[str, Path]) -> str:
        """Return the digest of all that decides a step: settings, template, capture, earlier steps, version, device."""
        # The device counts, because CPU and GPU sum in other orders; the version counts, because the code may change.
        files = {"template": self.folder / TRAINING_FILES.template, **needs}
        identity = {
            "version": version("smplxpp"),
            "device": self.device,
            "perceptual": self.recipe.perceptual,
            "settings": jsonable(settings),
            "capture": scene.digests,
            "files": {name: hashlib.sha256(read_bytes(path)).hexdigest() for name, path in files.items()},
        }
        return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
