"""Stages 40-60: skin weights, the way back to the T-pose, and the assembled template."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.figures.colors import blend_joint_colors
from pipelines.runs.arrays import load_arrays, save_arrays
from pipelines.runs.checks import Check
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildConfig, BuildInputs
from pipelines.stages.scan import MM, load_params_of_run, load_scan
from smplxpp.assemble import AssemblyConfig, CanonicalPart, assemble_template, body_colors_from_scan
from smplxpp.body import BodyModel, load_body
from smplxpp.clean import WebConfig, cut_webs, find_webs
from smplxpp.core.labels import LABELS, SKIN
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_io import write_ply
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.export import write_glb, write_obj
from smplxpp.metrics import stretch_report, weight_report
from smplxpp.skinning import UnposeConfig, unpose
from smplxpp.template.template import Template
from smplxpp.transfer import TransferConfig, transfer_weights


def load_posed_body(run: Path, body: BodyModel) -> tuple[TriangleMesh, np.ndarray]:
    """The fitted body in the reference frame, and its (J, 4, 4) `posed_from_rest`."""
    with np.load(run / "10_register" / "body.npz") as data:
        return body.mesh(data["vertices"]), data["posed_from_rest"]


def load_cleaned_parts(run: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    """The cleaned parts in the reference pose: mesh, and arrays `label`, `source_vertex`, `colors`."""
    return _parts(run / "30_clean" / "parts.npz")


def load_parts(run: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    """The same as `load_cleaned_parts` without webs: what skin weights are for."""
    return _parts(run / "40_transfer" / "parts.npz")


def _parts(file: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    groups = load_arrays(file)
    return {name: (TriangleMesh(a["vertices"], a["faces"]), a) for name, a in groups.items()}


def load_weights(run: Path) -> dict[str, SkinWeights]:
    """The parts' skin weights."""
    out = {}
    for name, arrays in load_arrays(run / "40_transfer" / "weights.npz").items():
        scalars = {"joint_count": int(arrays.pop("joint_count")), "policies": tuple(arrays.pop("policies").tolist())}
        out[name] = SkinWeights(**arrays, **scalars)
    return out


def transfer(folder: Path, run: Path, inputs: BuildInputs, config: BuildConfig) -> StageOutput:
    """40: skin weights of every part from the posed body, and the parts without the webs that the weights show."""
    body = load_body(inputs.body)
    groups, parts, checks, numbers = {}, {}, [], {}
    for name, (cleaned, arrays) in load_cleaned_parts(run).items():
        label = LABELS[int(arrays["label"])].name
        settings = transfer_config(label, body, config)
        mesh, source, weights = _without_webs(cleaned, run, body, settings, config.webs)
        parts[name] = {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "label": arrays["label"],
            "source_vertex": arrays["source_vertex"][source],
            "colors": arrays["colors"][source],
        }
        groups[name] = {
            "joint_indices": weights.joint_indices,
            "joint_weights": weights.joint_weights,
            "joint_count": np.int64(weights.joint_count),
            "matched": weights.matched,
            "distance": weights.distance,
            "angle": weights.angle,
            "component": weights.component,
            "policies": np.array(weights.policies),
        }
        write_ply(
            folder / f"{name}_weights.ply",
            mesh,
            vertex_colors=blend_joint_colors(weights),
            vertex_properties={"matched": weights.matched.astype(np.int32)},
        )
        report = weight_report(weights)
        numbers[name] = {
            "matched_share": float(weights.matched.mean()),
            "components": len(weights.policies),
            "policies": sorted(set(weights.policies)),
            "report": report.as_dict(),
            "web_faces": cleaned.face_count - mesh.face_count,
            "web_area_share": 1.0 - float(mesh.face_areas.sum() / cleaned.face_areas.sum()),
        }
        checks += [
            Check(f"{name}: rows off partition of unity", report.row_sum_error, "", 1e-12, 1e-9),
            Check(f"{name}: negative weights and silent zero rows", report.negative + report.zero_rows, "", 0, 0),
        ]
    save_arrays(folder / "weights.npz", groups)
    save_arrays(folder / "parts.npz", parts)
    return StageOutput(checks, numbers)


def _without_webs(
    part: TriangleMesh, run: Path, body: BodyModel, settings: TransferConfig, config: WebConfig
) -> tuple[TriangleMesh, np.ndarray, SkinWeights]:
    """A part without its webs, the vertex of `part` that each of its vertices is, and its skin weights.

    Weights are smoothed along the surface. Where that bridges two limbs they mix far beyond the web itself, so they are
    found anew once it is cut; what remains of a web shows then.
    """
    posed, posed_from_rest = load_posed_body(run, body)
    with np.load(run / "10_register" / "body.npz") as data:
        at_rest = body.mesh(data["rest_vertices"])
    source = np.arange(part.vertex_count)
    weights = transfer_weights(posed, body.weights, part, config=settings)
    for _ in range(config.rounds):
        # What can hardly be unposed is for the next stage to say, of what is left then.
        rest = unpose(part.vertices, weights, posed_from_rest, config=UnposeConfig(warn_below=0.0, fail_below=1e-9))
        web = find_webs(part, part.with_vertices(rest.vertices), posed, at_rest, config=config)
        if not web.any():
            break
        part, kept = cut_webs(part, web, config=config)
        source = source[kept]
        weights = transfer_weights(posed, body.weights, part, config=settings)
    return part, source, weights


def transfer_config(label: str, body: BodyModel, config: BuildConfig) -> TransferConfig:
    """What a part of this label may follow, by the build's method."""
    base = TransferConfig.paper() if config.method == "paper" else TransferConfig.for_label(label)
    return replace(base, joint_names=body.joint_names, max_influences=config.max_influences)


def unpose_parts(folder: Path, run: Path, inputs: BuildInputs) -> StageOutput:
    """50: the parts in the T-pose, by the inverse of the skinning that will drive them."""
    body = load_body(inputs.body)
    _, posed_from_rest = load_posed_body(run, body)
    weights, groups, checks, numbers = load_weights(run), {}, [], {}
    for name, (mesh, _) in load_parts(run).items():
        result = unpose(mesh.vertices, weights[name], posed_from_rest)
        stretch = stretch_report(mesh, mesh.with_vertices(result.vertices))
        groups[name] = {"vertices": result.vertices, "determinant": result.determinant}
        numbers[name] = {"stretch": stretch.as_dict()}
        checks += [
            Check(f"{name}: round trip", result.report.round_trip_max * MM, "mm", 1e-6, 1e-3),
            Check(
                f"{name}: smallest determinant",
                result.report.determinant_min,
                "",
                0.25,
                0.05,
                higher_is_better=True,
                explanation="of the blended transforms; 1 is rigid, 0 cannot be inverted",
            ),
            Check(f"{name}: edge stretch p99.9", stretch.p999, "x", 3.0, 10.0),
        ]
    save_arrays(folder / "canonical.npz", groups)
    return StageOutput(checks, numbers)


def assemble(folder: Path, run: Path, inputs: BuildInputs, config: BuildConfig) -> StageOutput:
    """60: body and parts as one `Template`, layers apart; npz, GLB and OBJ."""
    body = load_body(inputs.body)
    canonical, weights, parts = load_arrays(run / "50_unpose" / "canonical.npz"), load_weights(run), {}
    source_vertex = load_arrays(run / "00_capture" / "scan.npz")["scan"]["source_vertex"]
    for name, (mesh, arrays) in load_parts(run).items():
        parts[name] = CanonicalPart(
            mesh=mesh.with_vertices(canonical[name]["vertices"]),
            weights=weights[name],
            label=int(arrays["label"]),
            vertex_colors=arrays["colors"],
            scan_index=source_vertex[arrays["source_vertex"]],
        )
    template, report = assemble_template(
        body, load_params_of_run(run), parts, config=AssemblyConfig(clearance=config.clearance_mm / MM)
    )
    template = _colored_body(template, run, body)
    template.save(folder / "smplxpp.npz")
    write_glb(folder / "template.glb", template)
    write_obj(folder / "template.obj", template)
    checks = [
        Check(
            "outer vertices inside an inner layer at rest",
            report.penetrating_after,
            "",
            0,
            0,
            explanation="after the repair",
        ),
        Check("largest push of the repair", report.max_push * MM, "mm", 15.0, 60.0),
    ]
    return StageOutput(checks, report.as_dict())


def _colored_body(template: Template, run: Path, body: BodyModel) -> Template:
    """The template with the scan's colours on the skin that the scan shows."""
    scan, colors, source_vertex = load_scan(run)
    with np.load(run / "20_segment" / "labels.npz") as labels:
        skin = labels["face_labels"] == SKIN.id
    posed, _ = load_posed_body(run, body)
    body_colors, body_index = body_colors_from_scan(posed, scan, colors, skin)
    count = body.vertex_count
    scan_index = np.where(body_index >= 0, source_vertex[body_index], -1)
    return replace(
        template,
        vertex_colors=np.concatenate([body_colors, template.vertex_colors[count:]]),
        scan_index=np.concatenate([scan_index, template.scan_index[count:]]),
    )
