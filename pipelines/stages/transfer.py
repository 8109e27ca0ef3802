"""Stage 40: skin weights of every part from the posed body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.figures.colors import blend_joint_colors
from pipelines.runs.artefacts import (
    load_cleaned_parts,
    load_posed_body,
    load_resting_body,
    save_arrays,
)
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildConfig, BuildContext
from smplxpp.body import BodyModel, load_body
from smplxpp.clean import WebConfig, cut_webs, find_webs
from smplxpp.core.checks import Check
from smplxpp.core.labels import LABELS
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import write_ply
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.metrics import weight_report
from smplxpp.skinning import UnposeConfig, unpose
from smplxpp.transfer import TransferConfig, transfer_weights


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write skin weights of every part from the posed body, and the parts without the webs that the weights show."""
    body = load_body(build.inputs.body)
    groups: dict[str, dict[str, np.ndarray]] = {}
    parts: dict[str, dict[str, np.ndarray]] = {}
    checks: list[Check] = []
    numbers: dict[str, Any] = {}
    for name, (cleaned, arrays) in load_cleaned_parts(build.run).items():
        label = LABELS[int(arrays["label"])].name
        settings = transfer_config(label, body, build.config)
        mesh, source, weights = _without_webs(cleaned, build.run, body, settings, build.config.webs)
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
            "joint_count": np.array(weights.joint_count),
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
    at_rest = load_resting_body(run, body)
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
