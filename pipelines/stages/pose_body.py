"""Stage 10: the posed body of the given fit, and how well the scan agrees with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import (
    load_params_of_run,
    load_scan,
)
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from smplxpp.body import load_body
from smplxpp.core.checks import Check
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.metrics.distance import MM


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write the posed body of the given fit, and how well the scan agrees with it.

    A scan is never deeper inside the body than its noise: the share that is, tells a bad fit without any labels.
    """
    scan, _, _ = load_scan(build.run)
    posed = load_body(build.inputs.body).forward(load_params_of_run(build.run)).frame(0)
    np.savez(
        folder / "body.npz",
        vertices=posed.vertices,
        rest_vertices=posed.rest_vertices,
        joints=posed.joints,
        rest_joints=posed.rest_joints,
        posed_from_rest=posed.posed_from_rest,
    )
    body = TriangleMesh(posed.vertices, load_body(build.inputs.body).faces)
    rng = np.random.default_rng(0)
    sample = scan.vertices[np.sort(rng.permutation(scan.vertex_count)[:20_000])]
    distance = SignedDistanceField(body, solid=True).query(sample).distance * MM
    inside = float(np.mean(distance < -5.0))
    overlap = float(np.mean(np.abs(distance) < 250.0))
    checks = [
        Check(
            "share of the scan near the fitted body",
            overlap,
            "",
            0.98,
            0.8,
            higher_is_better=True,
            explanation="within 25 cm; low: another frame's parameters, or other units or axes",
        ),
        Check(
            "share of the scan inside the fitted body",
            inside,
            "",
            0.03,
            0.25,
            explanation="deeper than 5 mm; high: the fit is off by centimetres",
        ),
    ]
    if overlap < 0.2:
        raise InputError(
            "body parameters",
            expected="a body that stands in the scan",
            received=f"{100 * overlap:.0f} % of the scan within 25 cm of the body",
            remedy="check --frame, --units and --up, and that scan and parameters share one world",
        )
    return StageOutput(checks, {"distance_median_mm": float(np.median(distance))})
