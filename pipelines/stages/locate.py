"""Stage 03: the body found in a scan that comes with nothing else."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np

from pipelines.runs.checks import Check
from pipelines.runs.layout import LANDMARKS_FILE
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from pipelines.stages.scan_files import read_scan
from smplxpp.body import BodyModel, load_body
from smplxpp.clean import smooth_if_rough
from smplxpp.core.files.json_values import jsonable
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.register.landmark_file import read_landmarks
from smplxpp.register.locate import locate_body
from smplxpp.segment import label_by_body

_LEAST_SURE = 0.3
"""Confidence of a face below which its label is none that a fit should lean on."""


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write the parameters of the body that was found, what else it might have been, and how sure that is.

    Landmarks that lie in the run, placed by hand, are believed.
    """
    body = load_body(build.inputs.body)
    scan = read_scan(build.inputs.scan, units=build.config.units, up=build.config.up)
    mesh, colors = smooth_if_rough(scan.clean.mesh).mesh, scan.colors
    placed = build.run / LANDMARKS_FILE
    found = locate_body(
        body,
        mesh,
        colors=colors,
        landmarks=read_landmarks(placed) if placed.exists() else None,
        labeller=partial(sure_labels, mesh, body, colors=colors),
    )
    found.params.save(folder / "params.npz")
    said = {"units": scan.units, "up": scan.up, "said": list(scan.said), "problems": list(found.problems)}
    candidates = [
        {"facing_degrees": one.facing_degrees, "cost": one.cost, "pose": one.pose} for one in found.candidates
    ]
    content = {**said, "confidence": found.confidence, "candidates": candidates}
    (folder / "location.json").write_text(json.dumps(jsonable(content), indent=1) + "\n")
    check = Check(
        "confidence of the body found",
        found.confidence,
        "",
        0.5,
        0.15,
        higher_is_better=True,
        explanation="how far the best way to stand in the scan is ahead of the best other way"
        + "".join(f"; {problem}" for problem in found.problems),
    )
    return StageOutput([check], {**said, "confidence": found.confidence, "candidates": len(candidates)})


def sure_labels(
    mesh: TriangleMesh, body: BodyModel, params: BodyParams, *, colors: np.ndarray | None = None
) -> np.ndarray:
    """(N,) labels of a scan's vertices by its colours and a body in it; -1 where they are not sure."""
    labelled = label_by_body(mesh, body, params, colors=colors)
    out = np.full(mesh.vertex_count, -1, dtype=np.int64)
    order = np.argsort(labelled.confidence, kind="stable")
    sure = order[labelled.confidence[order] >= _LEAST_SURE]
    out[mesh.faces[sure]] = labelled.face_labels[sure][:, None]
    return out
