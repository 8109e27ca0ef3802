"""The report of a build: pictures of every stage, histograms of errors, numbers against their gates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipelines.figures import (
    blend_joint_colors,
    body_cameras,
    encode_jpeg,
    render_heat,
    render_overlay,
    render_shaded,
    row,
)
from pipelines.report import CheckRow, Comparison, Histogram, KeyNumber, Picture, Report, Section, Table, write_report
from pipelines.report.sections.evaluation import (
    evaluation_figures,
    evaluation_key_numbers,
    evaluation_views,
    standing_evaluation,
)
from pipelines.report.sections.fit import fit_key_numbers, fit_section, standing_fit
from pipelines.report.sections.readable import readable, readable_numbers
from pipelines.report.sections.refine import refine_section, refinement_key_numbers, standing_refinement
from pipelines.report.sections.register import register_section
from pipelines.report.sections.training import standing_trainings, training_key_numbers, training_section
from pipelines.runs.arrays import load_arrays, read_named
from pipelines.runs.artefacts import load_cleaned_parts, load_params_of_run, load_parts, load_scan, load_weights
from pipelines.runs.digests import versions
from pipelines.runs.layout import (
    ASSEMBLE_STAGE,
    BIND_STAGE,
    BUILD_STAGES,
    EVALUATE_STAGE,
    REFINE_STAGE,
    REGISTER_STAGE,
    SCAN_LABELS,
    SEGMENT_STAGE,
    TEMPLATE_STAGES,
    VALIDATE_STAGE,
)
from pipelines.runs.reading import values_of
from pipelines.runs.stage import StageRecord, require_stage
from pipelines.stages.build_config import BuildConfig, BuildInputs, load_build
from pipelines.stages.motion import motion_of_build
from smplxpp.body.stress_poses import STRESS_POSES, stress_poses
from smplxpp.core.camera import Camera
from smplxpp.core.files.json_values import jsonable
from smplxpp.core.labels import CLOTH_LABELS, LABELS, display_colors
from smplxpp.core.mesh import TriangleMesh, concatenate_meshes
from smplxpp.core.params import BodyParams
from smplxpp.core.spread import spread
from smplxpp.metrics import point_to_surface
from smplxpp.metrics.distance import MM
from smplxpp.template.template import Template

HEIGHT = 640
POSE_HEIGHT = 520
MOTION_PICTURES = 5
ERROR_LIMIT_MM = 6.0


def write_build_report(run: Path, inputs: BuildInputs, config: BuildConfig, records: dict[str, StageRecord]) -> Path:
    """Write `run/report.html` from a finished run, with what was fitted, trained and measured on it."""
    with values_of(records[ASSEMBLE_STAGE]):
        template_digest = records[ASSEMBLE_STAGE].manifest["files"]["smplxpp.npz"]
    fit, evaluation = standing_fit(run, template_digest), standing_evaluation(run, template_digest)
    poses = standing_refinement(run, template_digest)
    records = {**records, **({} if poses is None else {REFINE_STAGE: poses})}
    records = {**records, **({} if fit is None else {BIND_STAGE: fit})}
    trainings = standing_trainings(run, records.values())
    records = {**records, **trainings, **({} if evaluation is None else {EVALUATE_STAGE: evaluation})}
    template = Template.load(run / "60_assemble" / "smplxpp.npz")
    reference = load_params_of_run(run)
    checks = [CheckRow.of(c, stage=name) for name, r in records.items() for c in r.manifest["checks"]]
    by_stage = {name: tuple(c for c in checks if c.stage == name) for name in records}
    posed = template.mesh.with_vertices(template.pose(reference)[0])
    scan, colors, _ = load_scan(run)
    cameras = body_cameras(scan, views=("front", "back"), height=HEIGHT)
    early = tuple(c for c in checks if c.stage in ("00_capture", "10_body", "20_segment"))
    registration = records.get(REGISTER_STAGE)
    kept, moved, checked = (records[name] for name in ("30_clean", "40_transfer", VALIDATE_STAGE))
    sections = (
        *_optional(registration, "Registration", lambda record: register_section(run, record)),
        readable(records[SEGMENT_STAGE], "Scan and labels", lambda: _scan_section(run, scan, colors, cameras, early)),
        readable(kept, "Parts", lambda: _parts_section(run, kept, cameras, by_stage["30_clean"])),
        readable(moved, "Skin weights", lambda: _weights_section(run, moved, cameras, by_stage["40_transfer"])),
        _template_section(template, by_stage["50_unpose"] + by_stage["60_assemble"]),
        readable(
            checked,
            "Back in the reference pose",
            lambda: _fidelity_section(checked, template, posed, scan, colors, cameras, by_stage[VALIDATE_STAGE]),
        ),
        _poses_section(run, template, reference, inputs),
        *_optional(poses, "Poses", refine_section),
        *_optional(fit, "Gaussians", fit_section),
        *(section for record in trainings.values() for section in _optional(record, "Training", training_section)),
        *_optional(evaluation, "Avatar: figures", evaluation_figures),
        *_optional(evaluation, "Avatar: side by side", evaluation_views),
    )
    seconds = {name: r.manifest["seconds"] for name, r in records.items()}
    key_numbers = [
        *readable_numbers(checked, lambda: _distances(checked)),
        KeyNumber("template", f"{len(template.faces):,} faces", f"{len(template.vertices):,} vertices"),
        KeyNumber(
            "scan to template",
            f"{sum(seconds[name] for name in TEMPLATE_STAGES):.1f} s",
            "all stages of the template, validation included",
        ),
        *_numbers(poses, refinement_key_numbers),
        *_numbers(fit, fit_key_numbers),
        *_numbers(next(reversed(trainings.values()), None), training_key_numbers),
        *_numbers(evaluation, evaluation_key_numbers),
    ]
    inputs_of = {k: v for r in records.values() for k, v in r.manifest["inputs"].items()}
    front = body_cameras(posed, views=("front",), height=HEIGHT)[0]
    report = Report(
        subject=inputs.subject,
        summary="A personalised clothed template (SMPLX++) from one scan, measured at every stage.",
        hero=(
            Picture(
                "the template in the reference pose",
                encode_jpeg(render_shaded(posed, front, vertex_colors=template.vertex_colors)),
            ),
        ),
        key_numbers=tuple(key_numbers),
        checks=tuple(checks),
        seconds=seconds,
        sections=sections,
        provenance={
            "configuration": jsonable(config),
            "versions": versions(),
            "inputs (SHA-256)": {k: v for k, v in inputs_of.items() if not k.startswith(BUILD_STAGES)},
            "seed": {"samples": config.seed},
        },
    )
    return write_report(run / "report.html", report)


def _optional(record: StageRecord | None, title: str, make: Callable[[StageRecord], Section]) -> tuple[Section, ...]:
    """The section of a stage, where there is one."""
    return () if record is None else (readable(record, title, lambda: make(record)),)


def _numbers(record: StageRecord | None, make: Callable[[StageRecord], tuple[KeyNumber, ...]]) -> tuple[KeyNumber, ...]:
    """The numbers of a stage for the head of the report, where there is one."""
    return () if record is None else readable_numbers(record, lambda: make(record))


def _distances(record: StageRecord) -> tuple[KeyNumber, ...]:
    """How far the clothes are from the scan."""
    clothes = record.manifest["numbers"]["template_vs_scan"]["labels"]
    return tuple(
        KeyNumber(
            f"{label.name} to scan", f"{clothes[label.name]['pred_to_gt']['mean']:.2f} mm", "mean, visible surface"
        )
        for label in CLOTH_LABELS
        if clothes.get(label.name, {}).get("pred_to_gt")
    )


def rewrite_report(run: Path) -> Path | None:
    """Write the report of a finished run anew, from the run alone.

    Returns:
        The report, or None where the run does not say what it was built from.

    Raises:
        InputError: a stage of the template is missing or changed.
    """
    build = load_build(run)
    if build is None:
        return None
    return write_build_report(run, *build, {name: require_stage(run, name) for name in build[0].stages})


def _sheet(
    mesh: TriangleMesh,
    cameras: Sequence[Camera],
    *,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
    face_colors: UInt8[np.ndarray, "M 3"] | None = None,
) -> bytes:
    """Draw a mesh through cameras, side by side, as JPEG."""
    pictures = [render_shaded(mesh, camera, vertex_colors=vertex_colors, face_colors=face_colors) for camera in cameras]
    return encode_jpeg(row(pictures))


def _scan_section(
    run: Path, scan: TriangleMesh, colors: UInt8[np.ndarray, "N 3"], cameras: list[Camera], checks: tuple[CheckRow, ...]
) -> Section:
    labels, confidence = read_named(run / SCAN_LABELS, "face_labels", "confidence")
    heat = [
        render_heat(scan, camera, confidence, cmap="weight", limits=(0.0, 1.0), bar=camera is cameras[-1])
        for camera in cameras
    ]
    present = [label for label in LABELS if (labels == label.id).any()]
    return Section(
        title="Scan and labels",
        text=(
            "The scan in metres, +Y up, as it enters. Every face takes the label that a graph cut finds cheapest: "
            "labels given or votes of views, smoothed so that seams settle in folds.",
        ),
        pictures=(
            Picture("scan", _sheet(scan, cameras, vertex_colors=colors)),
            Picture("labels", _sheet(scan, cameras, face_colors=display_colors(labels))),
            Picture("confidence of the labels", encode_jpeg(row(heat))),
        ),
        legend=tuple((label.name, label.display_rgb) for label in present),
        checks=checks,
    )


def _parts_section(run: Path, record: StageRecord, cameras: list[Camera], checks: tuple[CheckRow, ...]) -> Section:
    parts = load_cleaned_parts(run)
    mesh = concatenate_meshes([mesh for mesh, _ in parts.values()])
    labels = np.concatenate([np.full(m.face_count, int(a["label"])) for m, a in parts.values()])
    numbers = record.manifest["numbers"]
    rows = tuple(
        (
            name,
            numbers[name]["report"]["faces_before"],
            numbers[name]["faces"],
            numbers[name]["quality"]["components"],
            numbers[name]["quality"]["border_loops"],
            numbers[name]["report"]["distance_mean"] * MM,
            numbers[name]["report"]["distance_p95"] * MM,
        )
        for name in parts
    )
    return Section(
        title="Parts",
        text=("Clothes, hair and shoes cut out, cleaned and simplified to their budgets; openings are kept.",),
        pictures=(Picture("parts", _sheet(mesh, cameras, face_colors=display_colors(labels))),),
        tables=(
            Table(("part", "faces before", "faces", "pieces", "openings", "to scan, mean mm", "p95 mm"), rows, "parts"),
        ),
        checks=checks,
    )


def _weights_section(run: Path, record: StageRecord, cameras: list[Camera], checks: tuple[CheckRow, ...]) -> Section:
    parts = load_parts(run)
    weights = load_weights(run, parts)
    mesh = concatenate_meshes([mesh for mesh, _ in parts.values()])
    colors = np.concatenate([blend_joint_colors(weights[name]) for name in parts])
    matched = np.concatenate([weights[name].matched for name in parts])
    tint = np.where(matched[:, None], (90, 170, 120), (230, 160, 60)).astype(np.uint8)
    numbers = record.manifest["numbers"]
    rows = tuple(
        (
            n,
            numbers[n]["matched_share"],
            numbers[n]["components"],
            ", ".join(numbers[n]["policies"]),
            numbers[n]["web_faces"],
            100.0 * numbers[n]["web_area_share"],
        )
        for n in parts
    )
    return Section(
        title="Skin weights",
        text=(
            "Weights of the body reach into the space around it; cloth takes them where it lies close and faces alike, "
            "and a smooth blend where it hangs free. Orange: cloth that no point of the body matches. Webs, where the "
            "scan bridges two limbs, are cut.",
        ),
        pictures=(
            Picture("joints mixed by weight", _sheet(mesh, cameras, vertex_colors=colors)),
            Picture("matched (green) and free (orange)", _sheet(mesh, cameras, vertex_colors=tint)),
        ),
        tables=(
            Table(("part", "matched share", "pieces", "policies", "web faces cut", "of its area, %"), rows, "transfer"),
        ),
        checks=checks,
    )


def _template_section(template: Template, checks: tuple[CheckRow, ...]) -> Section:
    cameras = body_cameras(template.mesh, views=("front", "back"), height=POSE_HEIGHT)
    return Section(
        title="Template in the T-pose",
        text=(
            "The parts taken back by the inverse of the skinning that drives them, on the naked body, layers apart.",
        ),
        pictures=(
            Picture("colours of the scan", _sheet(template.mesh, cameras, vertex_colors=template.vertex_colors)),
            Picture("semantic colours", _sheet(template.mesh, cameras, vertex_colors=template.semantic_colors)),
        ),
        checks=checks,
    )


def _fidelity_section(
    record: StageRecord,
    template: Template,
    posed: TriangleMesh,
    scan: TriangleMesh,
    colors: UInt8[np.ndarray, "N 3"],
    cameras: list[Camera],
    checks: tuple[CheckRow, ...],
) -> Section:
    distance = point_to_surface(posed.vertices, scan)[0] * MM
    errors = load_arrays(record.folder / "errors.npz")
    histograms = []
    for label in LABELS:
        values = errors["template_to_scan"]["distance_mm"][errors["template_to_scan"]["label"] == label.id]
        if len(values) and label.id:
            gates = (("mean gate", 1.0), ("p95 gate", 3.0)) if label in CLOTH_LABELS else ()
            histograms.append(Histogram(f"{label.name}: template to scan", values, gates=gates))
    back = errors["scan_to_template"]
    histograms.append(Histogram("scan to template, all labels", back["distance_mm"]))
    # Runs from before the check have none.
    uncovered = record.manifest["numbers"].get("completeness", {}).get("body_uncovered", {})
    rows = tuple((name, 100.0 * share) for name, share in uncovered.items())
    front = cameras[0]
    heat = [
        render_heat(posed, camera, distance, limits=(0.0, ERROR_LIMIT_MM), unit="mm", bar=camera is cameras[-1])
        for camera in cameras
    ]
    return Section(
        title="Back in the reference pose",
        text=("The template posed with the frame's parameters, against the scan, on the surface that can be seen.",),
        pictures=(
            Picture("distance to the scan", encode_jpeg(row(heat))),
            Picture(
                "template (glass) over the scan",
                encode_jpeg(row([render_overlay(scan, posed, camera, solid_colors=colors) for camera in cameras])),
            ),
        ),
        comparisons=(
            Comparison(
                "scan and template",
                Picture("scan", encode_jpeg(render_shaded(scan, front, vertex_colors=colors))),
                Picture("template", encode_jpeg(render_shaded(posed, front, vertex_colors=template.vertex_colors))),
            ),
        ),
        tables=(Table(("body", "neither shown nor covered, %"), rows, "uncovered"),) if rows else (),
        histograms=tuple(histograms),
        checks=checks,
    )


def _poses_section(run: Path, template: Template, reference: BodyParams, inputs: BuildInputs) -> Section:
    pictures = []
    for name, vertices in zip(STRESS_POSES, template.pose(stress_poses(reference)), strict=True):
        pictures.append(_pose_picture(template, vertices, name.replace("_", " ")))
    motion = motion_of_build(run, inputs)
    if motion is not None:
        chosen = np.array(spread(range(len(motion)), MOTION_PICTURES))
        for k, vertices in zip(chosen, template.pose(motion.select(chosen)), strict=True):
            pictures.append(_pose_picture(template, vertices, f"motion, frame {k}"))
    return Section(
        title="Driven",
        text=(
            "Poses that try the skinning, and frames of the capture's own motion. Skinning alone: no cloth dynamics.",
        ),
        pictures=tuple(pictures),
    )


def _pose_picture(template: Template, vertices: Float[np.ndarray, "V 3"], name: str) -> Picture:
    mesh = template.mesh.with_vertices(vertices)
    cameras = body_cameras(mesh, views=("front", "side"), height=POSE_HEIGHT)
    return Picture(name, _sheet(mesh, cameras, vertex_colors=template.vertex_colors))
