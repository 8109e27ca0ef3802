"""Stage 50: the parts in the T-pose, by the inverse of the skinning that will drive them."""

from __future__ import annotations

from pathlib import Path

from pipelines.runs.artefacts import (
    load_parts,
    load_posed_body,
    load_weights,
    save_arrays,
)
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from smplxpp.body import load_body
from smplxpp.core.checks import Check
from smplxpp.metrics import stretch_report
from smplxpp.metrics.distance import MM
from smplxpp.skinning import unpose


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write the parts in the T-pose, by the inverse of the skinning that will drive them."""
    body = load_body(build.inputs.body)
    _, posed_from_rest = load_posed_body(build.run, body)
    parts, groups, checks, numbers = load_parts(build.run), {}, [], {}
    weights = load_weights(build.run, parts)
    for name, (mesh, _) in parts.items():
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
