"""Stage 95: fit, teacher and student measured on a capture; figures, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatar.data.capture_digests import params_digest
from avatar.data.cloth_motion import ClothMotionConfig, ClothMotions
from avatar.data.sequence import AvatarSequence
from avatar.evaluation.evaluate import Evaluation, EvaluationConfig, evaluate_models
from avatar.evaluation.protocol import SETS, measured_splits, view_sets, with_people
from avatar.evaluation.report import SURFACE_SETS, EvalReport, ModelFigures, view_key
from avatar.evaluation.summary import evaluation_tables, garments, summary_figures
from avatar.models.model_file import load_avatar
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rig.rig import AvatarModel
from avatar.training.engine.adam import pixel_size
from avatar.training.loose_clothes import seen_particles
from pipelines.runs import gates
from pipelines.runs.code import TRAINING, sha256_file
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import BEST_FIRST, EVALUATE_STAGE, GARMENTS, TEACHER, TEACHER_STAGE
from pipelines.runs.stage import Stage, StageOutput, StageRecord, read_manifest, run_stage
from pipelines.stages.cloth import ClothMode, simulated_parts
from pipelines.stages.evaluate_inputs import (
    REPORT_FILE,
    exact_params,
    input_protocol,
    load_model,
    measuring_digests,
    model_files,
    of_held_out_poses,
    pose_errors,
    refined_digest,
    refined_poses,
)
from pipelines.stages.scene import TrainInputs, TrainScene, open_scene, refuse_seen
from smplxpp.body import load_body
from smplxpp.capture import Capture
from smplxpp.cloth.quality import ClothQuality, all_checks, merged
from smplxpp.core import Check, InputError, ProgressCallback, ignore_progress
from smplxpp.core.files import as_object
from smplxpp.core.files.atomic import atomic_write_bytes, atomic_write_text
from smplxpp.figures import encode_png
from smplxpp.figures.drawings import surface_picture, write_tiles
from smplxpp.metrics.comparison import MM
from smplxpp.metrics.pose_error import CONVENTION as POSE_CONVENTION
from smplxpp.template.template import Template

SeenClothes = Callable[[int], Mapping[str, np.ndarray]]
"""Where the particles of simulated parts were seen in a frame, world, metres; empty where they were not."""
MATCHING_ERROR_PIXELS = 0.05
"""Error in pixels with which photographs locate a surface; points of a clear pattern are located to 0.05 to 0.1.

The gate of P2S against skinning is relaxed by this error where skinning alone is within a pixel of the truth. At
256x320 a pixel covers 6 mm of the person, while skinning places a tight shirt to 1.7 mm. At high resolution the
relaxation
vanishes.
"""


def evaluate(
    run: Path,
    inputs: TrainInputs,
    config: EvaluationConfig,
    *,
    models: tuple[str, ...] = (),
    refined: bool = True,
    cloth: ClothMode = "simulate",
    device: str = "cpu",
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> StageRecord:
    """Measure the models of a run on a capture; skipped while models, capture, code and configuration stand.

    Args:
        models: names among `MODEL_FILES`; empty: `MEASURED`, as far as there are files.
        cloth: what moves loose clothes of students in held-out poses, where the run has found some.
        refined: measure held-out poses that the run refined on training cameras too, where it has any.
        force: measure again even if the stage is up to date.
        progress: called with the share of the frames that are measured.

    Raises:
        InputError: no template, no trained model, a model of another template; a capture of another body, or one that
            lacks views, masks or parameters.
    """
    # Open and check everything first: measuring takes long, and wrong inputs must end it at once.
    files = model_files(run, models)
    scene = open_scene(run, inputs, measures=True)
    with_people(scene.capture, view_sets(scene.capture, config.protocol))
    known = input_protocol(run, scene.capture)
    body = load_body(inputs.body)
    exact = exact_params(scene.capture, inputs.body, body)
    # Held-out poses refined on training cameras are measured in a second pass, reported apart.
    again = refined_poses(run, scene.capture) if refined else None
    clothes = _Clothes(run, scene.template, cloth)
    sequence = clothes.sequence(scene.capture, device=device)
    loaded = {name: load_model(name, path, sequence.rig) for name, path in files.items()}
    # Figures on views that a model was trained on would not be novel-view figures.
    refuse_seen(
        run,
        {path.relative_to(run).parts[0] for path in files.values()},
        measured_splits(scene.capture, config.protocol),
    )
    # The key covers models, capture, true surfaces, garments and refined poses. Evaluation is repeated if any of them
    # changes.
    seen = clothes.seen(run, scene, sequence, loaded.get("teacher"))
    stage = Stage(
        name=EVALUATE_STAGE,
        config={"evaluation": config, "inputs": known, "scale": inputs.scale, "device": device, "cloth": clothes.mode},
        inputs={
            **scene.digests,
            **{path.relative_to(run).as_posix(): sha256_file(path) for path in files.values()},
            **measuring_digests(scene.capture, config),
            **clothes.digests,
            **({} if seen is None else {TEACHER: sha256_file(run / TEACHER)}),
            **refined_digest(run, again),
            **({} if exact is None else {"capture/exact parameters": params_digest(exact)}),
        },
        code=(__name__,),
        libraries=TRAINING,
        seed=config.seed,
    )

    def _again(there: AvatarSequence, models: Mapping[str, AvatarModel]) -> dict[str, ModelFigures]:
        held_out = of_held_out_poses(config, there.capture)
        if held_out is None or not models:
            return {}
        found = evaluate_models(models, there, held_out, progress=progress).report.models
        moved.extend(there.cloth.quality if there.cloth else ())
        return found

    moved: list[ClothQuality] = []  # what was measured of simulated clothes

    def work(folder: Path) -> StageOutput:
        # First pass: all view sets with the poses that the capture gives.
        found = evaluate_models(loaded, sequence, config, files=files, progress=progress)
        report = replace(found.report, inputs=known)
        # Second pass: the same models in refined held-out poses, which separates errors of the pose from errors of the
        # model.
        if again is not None:
            report = replace(report, refined_poses=_again(clothes.sequence(again, device=device), loaded))
        # Third pass: clothes that go on from where the teacher followed them, in what the training has seen.
        if seen is not None:
            students = {name: model for name, model in loaded.items() if name not in ("fit", "teacher")}
            there = clothes.sequence(scene.capture, device=device, seen=seen)
            report = replace(report, followed_clothes=_again(there, students))
        # A synthetic capture knows the exact poses. Their errors are listed beside the figures.
        if exact is not None:
            captures = {"": scene.capture} | ({} if again is None else {", refined on training cameras": again})
            report = replace(
                report,
                poses=pose_errors(captures, exact, scene.template),
                conventions={**report.conventions, "poses": POSE_CONVENTION},
            )
        written = _write(folder, replace(found, report=report), overlap=scene.overlap, pixel=pixel_size(sequence))
        # Clothes that tore in the frames that were measured, whatever the figures say.
        qualities = merged([*(sequence.cloth.quality if sequence.cloth else ()), *moved])
        written.numbers["clothes"] = [one.as_dict() for one in qualities]
        return replace(written, checks=[*written.checks, *all_checks(qualities, "held-out poses")])

    with own_run_folder(run, (EVALUATE_STAGE, "report")):
        return run_stage(run, stage, work, force=force)


class _Clothes:
    """Loose clothes of a run, with the method that moves them in held-out frames."""

    def __init__(self, run: Path, template: Template, mode: ClothMode) -> None:
        self.template = template
        self.garments = [] if mode == "field" else simulated_parts(run, template)
        self.mode = mode if self.garments else "field"
        self.digests = {GARMENTS: sha256_file(run / GARMENTS)} if self.garments else {}

    def seen(
        self, run: Path, scene: TrainScene, sequence: AvatarSequence, teacher: AvatarModel | None
    ) -> SeenClothes | None:
        """Return where the teacher followed the simulated clothes; None where they are not, or poses are others now.

        Args:
            teacher: where it is loaded already, to be measured.
        """
        manifest = read_manifest(run / TEACHER_STAGE)
        if self.mode != "simulate" or manifest is None or not (run / TEACHER).is_file():
            return None
        known, key = as_object(manifest.get("inputs", {}), subject=f"{TEACHER_STAGE}: inputs"), "capture/parameters"
        if known.get(key) != scene.digests[key]:
            return None
        teacher = teacher or load_avatar(run / TEACHER, sequence.rig)
        track = teacher.track if isinstance(teacher, TeacherAvatar) else None
        return None if track is None else seen_particles(sequence, track, self.garments)

    def sequence(self, capture: Capture, *, device: str, seen: SeenClothes = lambda frame: {}) -> AvatarSequence:
        """Open a capture and move the loose clothes of its held-out frames, from where they were seen before them."""
        motions = None
        if self.garments:
            # Skinned clothes have no dynamics, so that the frame rate does not matter.
            fps = 1.0 if self.mode == "skin" else capture.fps
            if fps is None:
                raise InputError(
                    f"capture {capture.name}",
                    expected="its frames a second, to simulate clothes",
                    received="none",
                    remedy="evaluate with --cloth field or --cloth skin",
                )
            motions = ClothMotions(
                self.template,
                self.garments,
                params=capture.params,
                frames=capture.frames,
                fps=fps,
                config=ClothMotionConfig(mode="skin" if self.mode == "skin" else "simulate"),
                seen=seen,
            )
        return AvatarSequence(capture, self.template, device=device, cloth=motions)


def _write(folder: Path, found: Evaluation, *, overlap: float, pixel: float) -> StageOutput:
    """Write figures, tables and pictures of an evaluation; return the checks and numbers of the manifest.

    Args:
        folder: folder of the stage.
        found: figures, rendered views and posed surfaces.
        overlap: IoU of the template's silhouettes and the masks.
        pixel: size of a pixel at the person, metres.
    """
    report = found.report
    report.save(folder / REPORT_FILE)
    # Write every table as plain text, CSV and LaTeX.
    tables = evaluation_tables(report)
    for name, table in tables.items():
        for ending, text in (("txt", table.text()), ("csv", table.csv()), ("tex", table.latex(label=f"tab:{name}"))):
            atomic_write_text(folder / "tables" / f"{name}.{ending}", text)
    # Write the pictures: truth beside the rendering of every model, for typical and worst views.
    views, surfaces = [], []
    for view in found.views:
        worst = view.chosen == "worst"
        file = f"pictures/{'worst_' if worst else ''}{view.set}_{view_key(view.camera, view.frame)}.png"
        write_tiles(folder / file, view.truth, list(view.rendered.values()))
        views.append(
            {
                "file": file,
                "set": view.set,
                "camera": view.camera,
                "frame": view.frame,
                "chosen": view.chosen,
                "title": f"{'worst of ' if worst else ''}{SETS[view.set]}, {view.camera}, frame {view.frame}",
                "head": view.head,
            }
        )
    # Colour the posed mesh by its distance to the true surface.
    for surface in found.surfaces:
        file = f"pictures/surface_{surface.set}_{surface.frame:06d}.png"
        atomic_write_bytes(folder / file, encode_png(surface_picture(surface.truth, surface.posed)))
        title = f"{SURFACE_SETS[surface.set]}, frame {surface.frame}: distance to the true surface"
        surfaces.append({"file": file, "title": title})
    # All models are measured on the same views, so that the counts of the first hold for all.
    best = next(iter(report.models.values()))
    # The manifest carries all that the run's page shows, so that the page needs no other file.
    numbers = {
        "models": {name: summary_figures(model) for name, model in report.models.items()},
        "conventions": report.conventions,
        "inputs": report.inputs,
        "metric": report.metric,
        "counts": {name: best.counts(name) for name in best.views},
        "tables": [{"caption": t.caption, "header": t.header(), "rows": t.cells()} for t in tables.values()],
        "views": views,
        "surfaces": surfaces,
    }
    return StageOutput(evaluation_checks(report, overlap=overlap, pixel=pixel), numbers)


def evaluation_checks(report: EvalReport, *, overlap: float, pixel: float) -> list[Check]:
    """Check the best model of an evaluation against floors, simpler models and skinning alone.

    Args:
        report: figures of all models.
        overlap: IoU of the template's silhouettes and the masks.
        pixel: size of a pixel at the person, metres.
    """
    checks = [
        gates.SILHOUETTE.check(
            "template's silhouette on the masks",
            overlap,
            explanation="skinning alone; low: another person, another pose, or other cameras",
        )
    ]
    # The gates apply to the model that the training was for, which is the last one made.
    name = next((name for name in BEST_FIRST if name in report.models), None)
    if name is None:
        return checks
    best = report.models[name]
    # Appearance: likeness to held-out photographs, the gain over the fit, and the loss against the teacher.
    for part, likeness in gates.LIKENESS.items():
        if part in best.views:
            mean = best.mean(part)
            psnr, distance = mean["psnr"], mean.get("perceptual")
            checks.append(
                likeness.check(
                    f"{name}, {SETS[part]}: PSNR of the person",
                    psnr,
                    explanation="decibels fall with fine patterns and small images, too: look at the pictures",
                )
            )
            if "detail" in mean:
                checks.append(
                    gates.DETAIL.check(
                        f"{name}, {SETS[part]}: detail",
                        mean["detail"],
                        explanation="what is finer than five pixels, as a multiple of the photographs'; low: blurred",
                    )
                )
            perceptual = gates.PERCEPTUAL.get(report.metric or "")
            if distance is not None and perceptual is not None:
                checks.append(perceptual.check(f"{name}, {SETS[part]}: {report.metric} of the image", distance))
            if "fit" in report.models:
                checks.append(
                    gates.GAIN.check(
                        f"{name} against one frame's Gaussians, {SETS[part]}",
                        psnr - report.models["fit"].mean(part)["psnr"],
                        explanation="gain of PSNR over the fit, which skinning alone moves",
                    )
                )
            if name != "teacher" and "teacher" in report.models:
                gain = psnr - report.models["teacher"].mean(part)["psnr"]
                checks.append(gates.AGAINST_TEACHER.check(f"{name} against its teacher, {SETS[part]}", gain))
    # Geometry: the point-to-surface distance (P2S) of each garment, against that of plain skinning. The gate is for the
    # mesh that a student's field deforms, so that the teacher is left out.
    for part, title in SURFACE_SETS.items():
        if part not in best.surfaces or name == "teacher":
            continue
        own, alone = best.surfaces[part].mean.labels, report.skinning_alone[part].mean.labels
        for garment in garments(report):
            ours, skinned = (found[garment].p2s if garment in found else None for found in (own, alone))
            if ours and skinned:
                pixel_mm = pixel * MM
                # Relax the gate where skinning is within a pixel of the truth, see `MATCHING_ERROR_PIXELS`.
                slack = MATCHING_ERROR_PIXELS * pixel_mm / skinned if skinned < pixel_mm else 0.0
                gate = gates.AGAINST_SKINNING
                gate = replace(gate, warn=gate.warn + slack, fail=max(gate.fail, gate.warn + slack))
                checks.append(
                    gate.check(
                        f"P2S of {garment} against skinning alone, {title}",
                        ours / skinned,
                        explanation="below 1: the mesh that the field moves is nearer to the truth"
                        + (
                            f"; the gate allows {MATCHING_ERROR_PIXELS:g} pixel more, the error of photographs"
                            if slack
                            else ""
                        ),
                    )
                )
    return checks
