"""Stage 03: the body found in a scan that comes with nothing else."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8

from pipelines.runs.checks import Check
from pipelines.runs.layout import LANDMARKS_FILE, LOCATION_FILE
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from pipelines.stages.located import write_located
from pipelines.stages.scan_files import read_scan
from smplxpp.body import BodyModel, load_body
from smplxpp.clean import smooth_if_rough
from smplxpp.core.files.json_values import jsonable
from smplxpp.core.labels import BACKGROUND
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.register.bare import bare_of_scan
from smplxpp.register.landmark_file import read_landmarks
from smplxpp.register.locate import locate_body
from smplxpp.register.observations import ScanObservation
from smplxpp.segment import label_by_body

SURE = 0.6
"""Confidence of a face from which its label is one that a fit leans on."""


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write the parameters of the body that was found, what else it might have been, and how sure that is.

    Landmarks that lie in the run, placed by hand, are believed.
    """
    body = load_body(build.inputs.body)
    scan = read_scan(build.inputs.scan, units=build.config.units, up=build.config.up)
    mesh, colors = smooth_if_rough(scan.clean.mesh).mesh, scan.colors
    placed = build.run / LANDMARKS_FILE
    labeller = partial(sure_labels, mesh, body, colors)
    found = locate_body(
        body,
        mesh,
        colors=colors,
        landmarks=read_landmarks(placed) if placed.exists() else None,
        labeller=labeller,
    )
    labels = np.full(mesh.vertex_count, BACKGROUND, dtype=np.int64)
    of_faces = labeller(found.params)
    known = of_faces != BACKGROUND
    labels[mesh.faces[known]] = of_faces[known][:, None]
    bare = bare_of_scan(body, found.params, ScanObservation(mesh, labels))
    write_located(folder, found.params, labels, bare)
    numbers = {
        "units": scan.units,
        "up": scan.up,
        "said": scan.said,
        "facing_degrees": found.candidates[0].facing_degrees,
        "confidence": found.confidence,
        "problems": list(found.problems),
        "candidates": found.candidates,
        "bare": float(bare.mean()),
    }
    (folder / LOCATION_FILE).write_text(json.dumps(jsonable(numbers), indent=1) + "\n")
    check = Check(
        "confidence of the body found",
        found.confidence,
        "",
        0.5,
        0.2,
        higher_is_better=True,
        explanation="how far the best way to stand in the scan is ahead of the best that faces another way"
        + "".join(f"; {problem}" for problem in found.problems),
    )
    return StageOutput([check], jsonable(numbers))


def sure_labels(
    mesh: TriangleMesh, body: BodyModel, colors: UInt8[np.ndarray, "N 3"] | None, params: BodyParams
) -> Int64[np.ndarray, " M"]:
    """Labels of a scan's faces by its colours and a body in it; -1 where they are not sure."""
    labelled = label_by_body(mesh, body, params, colors=colors)
    return np.where(labelled.confidence >= SURE, labelled.face_labels, BACKGROUND)
