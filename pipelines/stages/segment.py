"""Stage 20: a label, a confidence and a seen flag for every face of the scan."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import (
    load_params_of_run,
    load_scan,
    load_source_faces,
    values_of,
)
from pipelines.runs.layout import CORRECTIONS_FILE, SCAN
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext, BuildInputs
from smplxpp.body import load_body
from smplxpp.capture import read_cameras
from smplxpp.core.checks import Check
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.labels import SKIN, display_colors
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh, write_ply
from smplxpp.segment import (
    Corrections,
    SegmentedScan,
    holds_labels,
    label_by_body,
    read_label_map,
    read_labels,
    segment_scan,
    vote_in_agreement,
)

DOUBTFUL = 0.5
"""Confidence of a face below which its label should be looked at."""


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write a label, a confidence and a seen flag for every face."""
    scan, stored_colors, source_vertex = load_scan(build.run)
    # A scan without colours is stored in one.
    colors = stored_colors if stored_colors.std() else None
    source = label_source(build.inputs)
    if source == "views":
        result = _by_views(scan, colors, build)
    elif source == "body":
        result = _by_body(scan, colors, build)
    else:
        result = _by_file(scan, source_vertex, build)
    before = result
    result = _corrected(build.run, scan, result)
    assert result.corrected is not None
    np.savez(
        folder / "labels.npz",
        face_labels=result.face_labels,
        confidence=result.confidence,
        seen=result.seen,
        corrected=result.corrected,
        labels_before_hand=before.face_labels,
        confidence_before_hand=before.confidence,
    )
    write_ply(
        folder / "labels.ply",
        scan,
        vertex_colors=display_colors(vertex_labels(scan, result.face_labels)),
        face_properties={
            "label": result.face_labels,
            "confidence": result.confidence,
            "corrected": result.corrected.astype(np.uint8),
        },
    )
    areas = scan.face_areas / scan.face_areas.sum()
    unseen = Check(
        "share of the surface no label saw",
        float(areas @ ~result.seen),
        "",
        0.25,
        0.6,
        explanation="labelled from its neighbours alone",
    )
    doubt = Check(
        "share of the surface with a doubtful label",
        float(areas @ (result.confidence < DOUBTFUL)),
        "",
        0.15,
        0.4,
        explanation=f"told by the body and colours with a confidence below {DOUBTFUL:g}; look at it, and correct it "
        "with `smplxpp label`",
    )
    confidence = Check(
        "label confidence, mean",
        float(areas @ result.confidence),
        "",
        0.8,
        0.5,
        higher_is_better=True,
        explanation="area-weighted; how clearly the labels speak for the answer",
    )
    numbers = {
        "labels_from": source,
        "doubts": list(before.doubts),
        "corrected_by_hand": float(areas @ result.corrected),
        "area_share": {str(k): float(areas[result.face_labels == k].sum()) for k in range(6)},
    }
    return StageOutput([confidence, doubt if source == "body" else unseen], numbers)


def label_source(inputs: BuildInputs) -> str:
    """Who says what is what: "file" of labels, or the scan's own, "views" and their label maps, or else the "body"."""
    if inputs.label_source == "body":
        return "body"
    if inputs.labels is None and inputs.label_maps:
        return "views"
    if inputs.labels is not None:
        return "file"
    return "body" if inputs.reconstructs or not holds_labels(inputs.scan) else "file"


def _by_body(scan: TriangleMesh, colors: np.ndarray | None, build: BuildContext) -> SegmentedScan:
    """What the body in the scan, of whatever parameters the run has, and the colours say."""
    return label_by_body(scan, load_body(build.inputs.body), load_params_of_run(build.run), colors=colors)


def _by_views(scan: TriangleMesh, colors: np.ndarray | None, build: BuildContext) -> SegmentedScan:
    """Votes of label maps that agree; what the body and the colours say where votes are few.

    Raises:
        InputError: maps of cameras that the camera file does not have.
    """
    inputs = build.inputs
    file = inputs.cameras
    assert file is not None  # the build has checked it
    cameras = {camera.name: camera for camera in read_cameras(file)}
    missing = sorted(set(inputs.label_maps) - set(cameras))
    if missing:
        raise InputError(
            f"camera file {file.name}",
            expected=f"cameras {', '.join(missing)}",
            received=f"cameras {', '.join(sorted(cameras))}",
        )
    views = [
        (cameras[name], read_label_map(path, label_set=inputs.label_set)) for name, path in inputs.label_maps.items()
    ]
    agreed = vote_in_agreement(scan, views)
    said = tuple(
        f"label map of {name} left out: the other views agree with {share:.0%} of it"
        for name, share in agreed.left_out.items()
    )
    for words in said:
        warnings.warn(words, GeometryWarning, stacklevel=2)
    result = segment_scan(scan, votes=agreed.votes, colors=colors, prior=_by_body(scan, colors, build))
    return replace(result, doubts=(*said, *result.doubts))


def _by_file(scan: TriangleMesh, source_vertex: np.ndarray, build: BuildContext) -> SegmentedScan:
    """Labels of the vertices or faces of the scan's file."""
    inputs = build.inputs
    raw = read_raw_mesh(inputs.scan, clouds=True)
    labels = read_labels(
        inputs.labels or inputs.scan,
        vertex_count=len(raw.vertices),
        face_count=len(raw.faces),
        label_set=inputs.label_set,
        source_faces=raw.source_faces,
    )
    with values_of(build.run / SCAN):
        if len(labels) == len(raw.faces):
            return segment_scan(scan, face_labels=labels[load_source_faces(build.run)])
        return segment_scan(scan, vertex_labels=labels[source_vertex])


def _corrected(run: Path, scan: TriangleMesh, result: SegmentedScan) -> SegmentedScan:
    """The labels with what a hand has corrected in the run."""
    path = run / CORRECTIONS_FILE
    corrections = Corrections.load(path) if path.exists() else Corrections()
    return corrections.apply(scan, result)


def vertex_labels(mesh: TriangleMesh, face_labels: np.ndarray) -> np.ndarray:
    """(N,) a label for every vertex: that of its last face in order, for pictures and files."""
    out = np.full(mesh.vertex_count, SKIN.id, dtype=np.int64)
    out[mesh.faces] = face_labels[:, None]
    return out
