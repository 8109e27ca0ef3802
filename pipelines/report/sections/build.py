"""The report of a build: pictures of every stage, histograms of errors, numbers against their gates."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pipelines.report import CheckRow, KeyNumber, Picture, Report, Section, write_report
from pipelines.report.builder import readable, readable_numbers
from pipelines.report.sections.evaluation import (
    evaluation_figures,
    evaluation_hero,
    evaluation_key_numbers,
    evaluation_views,
    relight_section,
    standing_evaluation,
    standing_relighting,
    talking_section,
)
from pipelines.report.sections.fit import fit_key_numbers, fit_section, standing_fit
from pipelines.report.sections.reconstruct import reconstruct_section
from pipelines.report.sections.register import locate_section, register_section
from pipelines.report.sections.template import (
    fidelity_section,
    parts_section,
    poses_section,
    scan_section,
    template_section,
    weights_section,
)
from pipelines.report.sections.training import (
    cloth_section,
    refine_section,
    refinement_key_numbers,
    standing_refinement,
    standing_trainings,
    training_key_numbers,
    training_section,
)
from pipelines.report.words import next_steps, uses_of
from pipelines.runs import layout
from pipelines.runs.artefacts import load_params_of_run, load_scan, values_of
from pipelines.runs.code import versions
from pipelines.runs.layout import (
    ASSEMBLE_STAGE,
    BUILD_STAGES,
    CLOTH_STAGE,
    EVALUATE_STAGE,
    FIT_STAGE,
    LOCATE_STAGE,
    RECONSTRUCT_STAGE,
    REFINE_STAGE,
    REGISTER_STAGE,
    RELIGHT_STAGE,
    SEGMENT_STAGE,
    TEMPLATE_STAGES,
    VALIDATE_STAGE,
)
from pipelines.runs.stage import MANIFEST, StageRecord, require_stage
from pipelines.stages.build_config import BuildConfig, BuildInputs, load_build, stages_of
from pipelines.stages.run_inputs import capture_of_build
from smplxpp.body import load_body
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import jsonable
from smplxpp.figures import body_cameras, encode_jpeg, render_shaded
from smplxpp.template.template import Template
from smplxpp.template.texture import texture_paint

HEIGHT = 640
_LAST: dict[str, tuple[Section, ...]] = {}
"""Sections of the template in the last report of this process, by what they show: `smplxpp demo` writes two."""


def report_stands(run: Path, records: dict[str, StageRecord]) -> bool:
    """Tell whether the report was written after every stage, those of other commands among them."""
    report = run / layout.REPORT_FILE
    manifests = [record.folder / MANIFEST for record in records.values()]
    others = (layout.REFINE_STAGE, *layout.MODEL_STAGES, layout.EVALUATE_STAGE, layout.RELIGHT_STAGE)
    manifests += [run / name / MANIFEST for name in others]
    made = [path.stat().st_mtime_ns for path in manifests if path.exists()]
    return report.is_file() and report.stat().st_mtime_ns > max(made)


def update_build_report(run: Path, inputs: BuildInputs, config: BuildConfig, records: dict[str, StageRecord]) -> None:
    """Write `run/report.html`, unless it was written after every stage."""
    if not report_stands(run, records):
        write_build_report(run, inputs, config, records)


def write_build_report(run: Path, inputs: BuildInputs, config: BuildConfig, records: dict[str, StageRecord]) -> Path:
    """Write `run/report.html` from a finished run, with what was fitted, trained and measured on it."""
    with values_of(records[ASSEMBLE_STAGE]):
        template_digest = records[ASSEMBLE_STAGE].manifest["files"]["smplxpp.npz"]
    # Only results on this very template are shown: a run may hold older ones of another.
    fit, evaluation = standing_fit(run, template_digest), standing_evaluation(run, template_digest)
    poses, relit = standing_refinement(run, template_digest), standing_relighting(run, template_digest)
    records = {**records, **({} if poses is None else {REFINE_STAGE: poses})}
    records = {**records, **({} if fit is None else {FIT_STAGE: fit})}
    # Trainings are compared with the records found so far, from which they were made.
    trainings = standing_trainings(run, records.values())
    records = {**records, **trainings, **({} if evaluation is None else {EVALUATE_STAGE: evaluation})}
    records = {**records, **({} if relit is None else {RELIGHT_STAGE: relit})}
    template = Template.load(run / "60_assemble" / "smplxpp.npz")
    reference = load_params_of_run(run)
    checks = [CheckRow.of(c, stage=name) for name, r in records.items() for c in r.manifest["checks"]]
    by_stage = {name: tuple(c for c in checks if c.stage == name) for name in records}
    # The posed template and the scan share cameras, so that their pictures can be compared.
    posed = template.mesh.with_vertices(template.pose(reference)[0])
    scan, colors, _ = load_scan(run)
    cameras = body_cameras(scan, views=("front", "back"), height=HEIGHT)
    # The first three stages share a section.
    early = tuple(c for c in checks if c.stage in ("08_capture", "10_body", "20_segment"))
    registration = records.get(REGISTER_STAGE)
    kept, moved, checked = (records[name] for name in ("30_clean", "40_transfer", VALIDATE_STAGE))
    found = records.get(LOCATE_STAGE)
    # Sections of the template take five seconds and are those of the last report, unless their stages have changed.
    standing = repr([*(records[name].manifest for name in TEMPLATE_STAGES), run, inputs])
    of_template = _LAST.get(standing) or (
        readable(
            records[SEGMENT_STAGE],
            "Scan and labels",
            lambda: scan_section(run, records[SEGMENT_STAGE], scan, colors, cameras, early),
        ),
        readable(kept, "Parts", lambda: parts_section(run, kept, cameras, by_stage["30_clean"])),
        readable(moved, "Skin weights", lambda: weights_section(run, moved, cameras, by_stage["40_transfer"])),
        readable(
            records[ASSEMBLE_STAGE],
            "Template in the T-pose",
            lambda: template_section(
                records[ASSEMBLE_STAGE], template, by_stage["50_unpose"] + by_stage[ASSEMBLE_STAGE]
            ),
        ),
        readable(
            checked,
            "Back in the reference pose",
            lambda: fidelity_section(checked, template, posed, scan, colors, cameras, by_stage[VALIDATE_STAGE]),
        ),
        poses_section(run, template, reference, inputs),
    )
    # Sections of stages that ran are whole; others may be messages, which come with a warning each time.
    if all(records[name].ran for name in TEMPLATE_STAGES):
        _LAST.clear()
        _LAST[standing] = of_template
    # Sections in the order of the stages. `readable` turns a damaged stage into a message.
    sections = (
        *_optional(records.get(RECONSTRUCT_STAGE), "Reconstruction", lambda record: reconstruct_section(run, record)),
        *_optional(
            found,
            "Body found in the scan",
            lambda record: locate_section(record, load_body(inputs.body), scan),
        ),
        *_optional(registration, "Registration", lambda record: register_section(run, record)),
        *of_template,
        *_optional(poses, "Poses", refine_section),
        *_optional(fit, "Gaussians", fit_section),
        *(section for record in trainings.values() for section in _optional(record, "Training", _trained)),
        *_optional(evaluation, "Avatar: figures", evaluation_figures),
        *_optional(evaluation, "Avatar: side by side", evaluation_views),
        *_optional(relit, "Avatar: another light", relight_section),
        *talking_section(run),
    )
    seconds = {name: r.manifest["seconds"] for name, r in records.items()}
    key_numbers = [
        *readable_numbers(checked, lambda: _distances(checked, template.cloth_parts)),
        KeyNumber("template", f"{len(template.faces):,} faces", f"{len(template.vertices):,} vertices"),
        KeyNumber(
            "time of the template",
            f"{sum(seconds[name] for name in TEMPLATE_STAGES):.1f} s",
            "all stages of the template, validation included",
        ),
        *_numbers(poses, refinement_key_numbers),
        *_numbers(fit, fit_key_numbers),
        # An evaluation measures the same figure on more views than a training does.
        *_numbers(next(reversed(trainings.values()), None) if evaluation is None else None, training_key_numbers),
        *_numbers(evaluation, evaluation_key_numbers),
    ]
    inputs_of = {k: v for r in records.values() for k, v in r.manifest["inputs"].items()}
    front = body_cameras(posed, views=("front",), height=HEIGHT)[0]
    # In its texture, or without one in the colours of its vertices.
    paint = texture_paint(template)
    plain = template.vertex_colors if paint is None else None
    report = Report(
        subject=inputs.subject,
        summary="A personalised clothed template (SMPLX++) from one scan, measured at every stage.",
        uses=uses_of(checks),
        steps=next_steps(run, capture=capture_of_build(run, inputs), checks=checks),
        hero=(
            Picture(
                "the template in the reference pose",
                encode_jpeg(render_shaded(posed, front, vertex_colors=plain, paint=paint)),
            ),
            *(() if evaluation is None else _hero(evaluation)),
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


def _hero(evaluation: StageRecord) -> tuple[Picture, ...]:
    """The student beside a photograph; nothing where the evaluation cannot be read, which its sections say."""
    with suppress(InputError), values_of(evaluation):
        return evaluation_hero(evaluation)
    return ()


def _trained(record: StageRecord) -> Section:
    return (cloth_section if record.folder.name == CLOTH_STAGE else training_section)(record)


def _optional(record: StageRecord | None, title: str, make: Callable[[StageRecord], Section]) -> tuple[Section, ...]:
    """The section of a stage, where there is one."""
    return () if record is None else (readable(record, title, lambda: make(record)),)


def _numbers(record: StageRecord | None, make: Callable[[StageRecord], tuple[KeyNumber, ...]]) -> tuple[KeyNumber, ...]:
    """The numbers of a stage for the head of the report, where there is one."""
    return () if record is None else readable_numbers(record, lambda: make(record))


def _distances(record: StageRecord, parts: tuple[str, ...]) -> tuple[KeyNumber, ...]:
    """How far the clothes are from the scan."""
    clothes = record.manifest["numbers"]["template_vs_scan"]["labels"]
    return tuple(
        KeyNumber(f"template to scan, {part}: mean", f"{clothes[part]['pred_to_gt']['mean']:.2f} mm", "visible surface")
        for part in parts
        if clothes.get(part, {}).get("pred_to_gt")
    )


def rewrite_report(run: Path) -> Path | None:
    """Rewrite the report of a finished run from the run alone.

    Returns:
        The report, or None for a run without a record of its build.

    Raises:
        InputError: a stage of the template is missing or changed.
    """
    build = load_build(run)
    if build is None:
        return None
    return write_build_report(run, *build, {name: require_stage(run, name) for name in stages_of(build[0])})
