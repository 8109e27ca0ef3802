"""Sections of a build's report: pictures of a stage, histograms of errors, its checks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipelines.report import CheckRow, Comparison, Histogram, Picture, Section, Table
from pipelines.runs.artefacts import (
    load_arrays,
    load_cleaned_parts,
    load_labels,
    load_parts,
    load_weights,
    read_named,
    values_of,
)
from pipelines.runs.layout import SCAN_LABELS
from pipelines.runs.stage import StageRecord
from pipelines.stages.build_config import BuildInputs
from pipelines.stages.run_inputs import motion_of_build
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core import BodyParams, TriangleMesh, concatenate_meshes, spread
from smplxpp.core.camera import Camera
from smplxpp.core.files.json_file import as_list, as_text
from smplxpp.figures import body_cameras, encode_jpeg, render_heat, render_overlay, render_shaded, row
from smplxpp.figures.colors import blend_joint_colors
from smplxpp.metrics.distance import MM, point_to_surface
from smplxpp.segment import UNSURE
from smplxpp.template.template import Template

POSE_HEIGHT = 520
MOTION_PICTURES = 5
ERROR_LIMIT_MM = 6.0


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


_SOURCES = {
    "file": "labels given",
    "views": "votes of views, and where they are few what the body in the scan and its colours say",
    "body": "labels estimated from the body in the scan, its colours and its folds",
}


def scan_section(
    run: Path,
    record: StageRecord,
    scan: TriangleMesh,
    colors: UInt8[np.ndarray, "N 3"],
    cameras: list[Camera],
    checks: tuple[CheckRow, ...],
) -> Section:
    """Show the scan, its colours, its labels and their uncertainty.

    Args:
        run: folder of the run.
        record: the stage that labelled the scan.
        scan: the scan.
        colors: its colours.
        cameras: cameras of the pictures.
        checks: checks of the stage.
    """
    with values_of(record):
        source = as_text(record.manifest["numbers"].get("labels_from", "file"), subject="labels_from")
        notes = as_list(record.manifest["numbers"].get("notes", []), subject="notes")
    labels, confidence = read_named(run / SCAN_LABELS, "face_labels", "confidence")
    certain = confidence >= UNSURE
    # A colour bar beside the last view serves all.
    known = load_labels(run)
    shown = known.display_colors(labels, certain)
    heat = [
        render_heat(scan, camera, confidence, cmap="weight", limits=(0.0, 1.0), bar=camera is cameras[-1])
        for camera in cameras
    ]
    present = [label for label in known if (labels == label.id).any()]
    return Section(
        title="Scan and labels",
        text=(
            "The scan in metres, +Y up, as it enters. Every face takes the label that a graph cut finds cheapest: "
            f"{_SOURCES.get(source, source)}, smoothed so that seams settle in folds.",
        ),
        pictures=(
            Picture("scan", _sheet(scan, cameras, vertex_colors=colors)),
            Picture("labels, pale where uncertain", _sheet(scan, cameras, face_colors=shown)),
            Picture("confidence of the labels", encode_jpeg(row(heat))),
        ),
        tables=(Table(("uncertain labels",), tuple((str(note),) for note in notes)),) if notes else (),
        legend=tuple((label.name, label.display_rgb) for label in present),
        checks=checks,
    )


_METHODS = {
    "quadric": "simplified to their budgets by quadric edge collapse (fast-simplification)",
    "isotropic": "covered with faces of one size by isotropic remeshing (pymeshlab, which is under the GPL 3)",
}


_BARE = "No clothes, hair or shoes were found: the template is the body alone."


def parts_section(run: Path, record: StageRecord, cameras: list[Camera], checks: tuple[CheckRow, ...]) -> Section:
    """Show the parts and how simplification changed them."""
    parts = load_cleaned_parts(run)
    if not parts:
        return Section(title="Parts", text=(_BARE,), checks=checks)
    # Draw all parts together, coloured by their label.
    mesh = concatenate_meshes([part.mesh for part in parts.values()])
    labels = np.concatenate([np.full(part.mesh.face_count, part.label) for part in parts.values()])
    numbers = record.manifest["numbers"]
    # Stages from before the choice have none.
    method = as_text(record.manifest["config"].get("remesh", "quadric"), subject="remesh")
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
        text=(f"Clothes, hair and shoes cut out, cleaned and {_METHODS.get(method, method)}; openings are kept.",),
        pictures=(Picture("parts", _sheet(mesh, cameras, face_colors=load_labels(run).display_colors(labels))),),
        tables=(
            Table(("part", "faces before", "faces", "pieces", "openings", "to scan, mean mm", "p95 mm"), rows, "parts"),
        ),
        checks=checks,
    )


def weights_section(run: Path, record: StageRecord, cameras: list[Camera], checks: tuple[CheckRow, ...]) -> Section:
    """Show the skin weights of the parts."""
    parts = load_parts(run)
    weights = load_weights(run, parts)
    if not parts:
        return Section(title="Skin weights", text=(_BARE,), checks=checks)
    # Draw all parts together: joint colours mixed by weight, then matched against free cloth.
    mesh = concatenate_meshes([part.mesh for part in parts.values()])
    colors = np.concatenate([blend_joint_colors(weights[name]) for name in parts])
    matched = np.concatenate([weights[name].matched for name in parts])
    tint = np.where(matched[:, None], (90, 170, 120), (230, 160, 60)).astype(np.uint8)
    numbers = record.manifest["numbers"]
    # Share of matched vertices, pieces, and the bridges that were cut.
    rows = tuple(
        (
            n,
            numbers[n]["matched_share"],
            numbers[n]["components"],
            str(numbers[n].get("rule", "")),
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
            "and a smooth blend where it hangs free. Orange: cloth that no point of the body matches. Bridges "
            "between limbs are cut.",
        ),
        pictures=(
            Picture("joints mixed by weight", _sheet(mesh, cameras, vertex_colors=colors)),
            Picture("matched (green) and free (orange)", _sheet(mesh, cameras, vertex_colors=tint)),
        ),
        tables=(
            Table(
                ("part", "matched share", "pieces", "rule", "policies", "bridge faces", "of its area, %"),
                rows,
                "transfer",
            ),
        ),
        checks=checks,
    )


def template_section(record: StageRecord, template: Template, checks: tuple[CheckRow, ...]) -> Section:
    """Show the template in the T-pose."""
    # Runs of earlier versions did not fill holes.
    darned = record.manifest["numbers"].get("darned", {})
    rows = tuple((name, one["holes"], one["closed"], 1e4 * one["area"]) for name, one in darned.items() if one["holes"])
    cameras = body_cameras(template.mesh, views=("front", "back"), height=POSE_HEIGHT)
    return Section(
        title="Template in the T-pose",
        text=(
            "The parts taken back by the inverse of the skinning that drives them, on the naked body, layers apart. "
            "Holes of cut bridges are closed by the surface of least area over them, as the scan lacks that cloth.",
        ),
        pictures=(
            Picture("colours of the scan", _sheet(template.mesh, cameras, vertex_colors=template.vertex_colors)),
            Picture("semantic colours", _sheet(template.mesh, cameras, vertex_colors=template.semantic_colors)),
        ),
        tables=(Table(("part", "holes of cuts", "closed", "patches, cm2"), rows, "darned"),) if rows else (),
        checks=checks,
    )


def fidelity_section(
    record: StageRecord,
    template: Template,
    posed: TriangleMesh,
    scan: TriangleMesh,
    colors: UInt8[np.ndarray, "N 3"],
    cameras: list[Camera],
    checks: tuple[CheckRow, ...],
) -> Section:
    """Show how far scan and template are from each other."""
    distance = point_to_surface(posed.vertices, scan)[0] * MM
    errors = load_arrays(record.folder / "errors.npz")
    histograms = []
    for label in template.labels:
        values = errors["template_to_scan"]["distance_mm"][errors["template_to_scan"]["label"] == label.id]
        if len(values) and label.id:
            gates = (("mean gate", 1.0), ("p95 gate", 3.0)) if label in template.labels.cloth else ()
            histograms.append(Histogram(f"template to scan, {label.name}", values, gates=gates))
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


def poses_section(run: Path, template: Template, reference: BodyParams, inputs: BuildInputs) -> Section:
    """Show the template in stress poses and in its motion."""
    pictures = []
    for name, vertices in zip(STRESS_POSES, template.pose(stress_poses(reference)), strict=True):
        pictures.append(_pose_picture(template, vertices, name.replace("_", " ")))
    # Frames of the motion are evenly spread over its length.
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
