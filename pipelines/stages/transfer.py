"""Stage 40: skin weights of every part from the posed body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.figures.colors import blend_joint_colors
from pipelines.runs.arrays import save_arrays
from pipelines.runs.artefacts import (
    load_parts,
    load_posed_body,
)
from pipelines.runs.checks import Check
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildConfig, BuildContext
from smplxpp.body import BodyModel, load_body
from smplxpp.core.labels import LABELS
from smplxpp.core.mesh_io import write_ply
from smplxpp.metrics import weight_report
from smplxpp.transfer import TransferConfig, transfer_weights


def run(folder: Path, build: BuildContext) -> StageOutput:
    """skin weights of every part from the posed body."""
    body = load_body(build.inputs.body)
    posed, _ = load_posed_body(build.run, body)
    groups, checks, numbers = {}, [], {}
    for name, (mesh, arrays) in load_parts(build.run).items():
        label = LABELS[int(arrays["label"])].name
        settings = transfer_config(label, body, build.config)
        weights = transfer_weights(posed, body.weights, mesh, config=settings)
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
        }
        checks += [
            Check(f"{name}: rows off partition of unity", report.row_sum_error, "", 1e-12, 1e-9),
            Check(f"{name}: negative weights and silent zero rows", report.negative + report.zero_rows, "", 0, 0),
        ]
    save_arrays(folder / "weights.npz", groups)
    return StageOutput(checks, numbers)


def transfer_config(label: str, body: BodyModel, config: BuildConfig) -> TransferConfig:
    """What a part of this label may follow, by the build's method."""
    base = TransferConfig.paper() if config.method == "paper" else TransferConfig.for_label(label)
    return replace(base, joint_names=body.joint_names, max_influences=config.max_influences)
