"""Prepare what every later step reads: the repaired scan, one frame of parameters, the posed body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from smplxpp.body import BodyModel, load_params
from smplxpp.body.smpl_joints import is_open_body
from smplxpp.body.smpl_params import FAMILY_NAMES, from_smpl
from smplxpp.build.config import BuildInputs
from smplxpp.build.data import PosedFit, PreparedScan
from smplxpp.build.limits import ROUGHNESS
from smplxpp.build.scan import ScanFile
from smplxpp.clean import smooth_if_rough
from smplxpp.core import BodyParams, Check, InputError, StageOutput, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.metrics.comparison import MM

GREY = 180
"""Value of all channels of a scan without colours."""


def prepare_scan(scan: ScanFile) -> tuple[PreparedScan, StageOutput]:
    """Smooth a repaired scan where it is rough, and measure how rough it was."""
    clean = scan.clean
    smoothed = smooth_if_rough(clean.mesh)
    # The renderer and the template need a colour for each vertex, so that a scan without colours becomes grey.
    colors = np.full((clean.mesh.vertex_count, 3), GREY, np.uint8) if scan.colors is None else scan.colors
    # Smoothing moves vertices alone: faces and both maps to the file's elements remain valid.
    mesh = TriangleMesh(smoothed.mesh.vertices, clean.mesh.faces)
    numbers = {"vertices": clean.mesh.vertex_count, "faces": clean.mesh.face_count, "repairs": str(clean.report)}
    numbers |= {"units": scan.units, "up": scan.up, "said": scan.note}
    numbers |= {"smoothing_steps": smoothed.steps, "smoothing_moved_mm": smoothed.moved * MM}
    explanation = "how far vertices stand off their neighbours, as a share of the median edge"
    if smoothed.steps:
        explanation += f"; smoothed: vertices moved by {smoothed.moved * MM:.1f} mm, what follows is of that surface"
    check = ROUGHNESS.check("roughness of the scan", smoothed.roughness, explanation=explanation)
    return PreparedScan(mesh, colors, clean.source_vertex, clean.source_face), StageOutput([check], numbers)


def given_params(inputs: BuildInputs, body: BodyModel) -> BodyParams | None:
    """Return the reference frame's parameters that the user or the capture gives; None where they are made."""
    if inputs.params is None:
        return None
    return _frame_of(inputs.params, inputs, body)


def start_params(inputs: BuildInputs, body: BodyModel) -> BodyParams | None:
    """Return the reference frame's parameters of another body, brought to the open body; None where there are none."""
    return None if inputs.start is None else _frame_of(inputs.start, inputs, body)


def _frame_of(given: Path | BodyParams, inputs: BuildInputs, body: BodyModel) -> BodyParams:
    if isinstance(given, BodyParams):
        params = from_smpl(given, inputs.whose, body) if inputs.whose in FAMILY_NAMES else given
    else:
        params = load_params(given, body=body, whose=inputs.whose)
    return params.frame(inputs.params_row if len(params) > 1 else 0)


def registered_frame(frame: int, frames: tuple[int, ...], fitted: BodyParams) -> BodyParams:
    """Return the reference frame's parameters among those that were registered.

    Raises:
        InputError: the frame could not be registered.
    """
    if frame not in frames:
        raise InputError(
            f"reference frame {frame}",
            expected="a frame that was registered",
            received=f"none of the {len(frames)} that were, {frames[0]} to {frames[-1]}",
            remedy="choose another with --frame, or give its parameters with --params and --register off",
        )
    return fitted.frame(frames.index(frame))


def pose_fit(scan: TriangleMesh, body: BodyModel, params: BodyParams) -> tuple[PosedFit, StageOutput]:
    """Pose the body of a fit, and check that the scan agrees with it.

    A scan is never deeper inside the body than its noise. The share that is tells a bad fit without any labels.

    Raises:
        InputError: the body stands elsewhere than the scan, or the parameters are of another body of the family.
    """
    posed = body.forward(params).frame(0)
    # Rest and pose together: transfer works on the posed body, unposing needs the transforms, webs need both
    # surfaces.
    fit = PosedFit(
        body.mesh(posed.vertices),
        body.mesh(posed.rest_vertices),
        posed.joints,
        posed.rest_joints,
        posed.posed_from_rest,
    )
    # Signed distances of a sample of the scan, negative inside the body, millimetres.
    # 20,000 points make the shares exact to 0.4 % (a binomial's standard error at 0.5); sorted, they are read in
    # memory order.
    rng = np.random.default_rng(0)
    sample = scan.vertices[np.sort(rng.permutation(scan.vertex_count)[:20_000])]
    distance = SignedDistanceField(fit.mesh, solid=True).query(sample).distance * MM
    # 5 mm is above a scanner's noise; 25 cm is farther than hair and most clothes stand off the body.
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
    if overlap < 0.8 and is_open_body(body):
        _refuse_another_body(scan.vertices[::50], body, params, overlap)
    # Below a fifth nothing after this step makes sense, so that the build ends here instead of warning.
    if overlap < 0.2:
        raise InputError(
            "body parameters",
            expected="a body that stands in the scan",
            received=f"{100 * overlap:.0f} % of the scan within 25 cm of the body",
            remedy="check --frame, --units and --up, and that scan and parameters share one world",
        )
    return fit, StageOutput(checks, {"distance_median_mm": float(np.median(distance))})


def _refuse_another_body(points: Float[np.ndarray, "N 3"], body: BodyModel, params: BodyParams, overlap: float) -> None:
    """Refuse parameters that do not stand in the scan as the open body's and do so as a family's.

    Raises:
        InputError: naming the family.
    """
    # Distances of the scan to the mean body with each family's turns; their pelves are 2 to 13 cm apart in height.
    distances = {}
    for family in FAMILY_NAMES:
        mesh = body.mesh(body.forward(from_smpl(params, family, body)).vertices[0])
        distances[family] = np.abs(SignedDistanceField(mesh, solid=True).query(points).distance)
    best = min(distances, key=lambda family: float(np.minimum(distances[family], 0.25).mean()))
    share = float(np.mean(distances[best] < 0.25))
    if share < max(0.9, overlap + 0.1):
        return
    raise InputError(
        "body parameters",
        expected="those of the open body, which stands in the scan",
        received=f"{100 * overlap:.0f} % of the scan within 25 cm of it, but {100 * share:.0f} % as "
        f"{FAMILY_NAMES[best]}'s parameters",
        remedy=f"give the model's file with --body, or state --whose {best}: the search for the body starts from them",
    )
