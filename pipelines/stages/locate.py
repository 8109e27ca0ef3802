"""Stage 03: the body found in a scan that comes with nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8

from pipelines.runs.layout import LANDMARKS_FILE, LOCATION_FILE
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from pipelines.stages.located import write_located
from pipelines.stages.scan_files import read_scan
from pipelines.stages.scan_keypoints import facing, keypoints_of_scan
from smplxpp.body import BodyModel, load_body
from smplxpp.clean import smooth_if_rough
from smplxpp.core.checks import Check
from smplxpp.core.files.json_file import jsonable
from smplxpp.core.labels import BACKGROUND
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.detect import load_detector
from smplxpp.register import ScanObservation, bare_of_scan, read_landmarks
from smplxpp.register.locate import LocatedBody, locate_body
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
    look = partial(locate_body, body, mesh, colors=colors, labeller=labeller)
    found = look(landmarks=read_landmarks(placed) if placed.exists() else None)
    witness = ""
    if build.config.detector is not None and not placed.exists():
        found, witness = _witnessed(found, look, mesh, colors, build.config.detector)
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
        "detector": witness,
        "facing_degrees": found.candidates[0].facing_degrees,
        "confidence": found.confidence,
        "problems": list(found.notes),
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
        + "".join(f"; {problem}" for problem in found.notes),
    )
    return StageOutput([check], jsonable(numbers))


def _witnessed(
    found: LocatedBody,
    look: Callable[..., LocatedBody],
    mesh: TriangleMesh,
    colors: UInt8[np.ndarray, "N 3"] | None,
    detector: str,
) -> tuple[LocatedBody, str]:
    """The body as it was found if a detector's keypoints on pictures of the scan face the same way, else as they say.

    Keypoints are centimetres off, geometry is not: they are asked for the front alone, and where both disagree the
    search is done again with them.
    """
    landmarks = keypoints_of_scan(mesh, colors, load_detector(detector))
    front = facing(landmarks)
    if front is None:
        return found, "the detector's keypoints do not tell the front"
    own = np.radians(found.candidates[0].facing_degrees)
    if np.sin(own) * front[0] + np.cos(own) * front[2] > 0:
        return found, "the detector's keypoints face the same way"
    again = look(landmarks={name: point for name, (point, _) in landmarks.items() if name.startswith("coco_")})
    return again, "the surface alone was taken for somebody who faces the other way than the detector's keypoints do"


def sure_labels(
    mesh: TriangleMesh, body: BodyModel, colors: UInt8[np.ndarray, "N 3"] | None, params: BodyParams
) -> Int64[np.ndarray, " M"]:
    """Labels of a scan's faces by its colours and a body in it; -1 where they are not sure."""
    labelled = label_by_body(mesh, body, params, colors=colors)
    return np.where(labelled.confidence >= SURE, labelled.face_labels, BACKGROUND)
