"""Stage 20: a label, a confidence and a seen flag for every face of the scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import (
    load_scan,
    load_source_faces,
)
from pipelines.runs.checks import Check
from pipelines.runs.layout import CORRECTIONS_FILE, SCAN
from pipelines.runs.reading import values_of
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from smplxpp.capture import read_cameras
from smplxpp.core.errors import InputError
from smplxpp.core.labels import SKIN, display_colors
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh, write_ply
from smplxpp.segment import (
    Corrections,
    SegmentedScan,
    read_label_map,
    read_labels,
    segment_scan,
    vote_on_faces,
)


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write a label, a confidence and a seen flag for every face."""
    scan, _, source_vertex = load_scan(build.run)
    if build.inputs.labels is None and build.inputs.label_maps:
        file = build.inputs.cameras
        assert file is not None  # the build has checked it
        cameras = {camera.name: camera for camera in read_cameras(file)}
        missing = sorted(set(build.inputs.label_maps) - set(cameras))
        if missing:
            raise InputError(
                f"camera file {file.name}",
                expected=f"cameras {', '.join(missing)}",
                received=f"cameras {', '.join(sorted(cameras))}",
            )
        views = [
            (cameras[name], read_label_map(path, label_set=build.inputs.label_set))
            for name, path in build.inputs.label_maps.items()
        ]
        result = segment_scan(scan, votes=vote_on_faces(scan, views))
    else:
        raw = read_raw_mesh(build.inputs.scan, clouds=True)
        labels = read_labels(
            build.inputs.labels or build.inputs.scan,
            vertex_count=len(raw.vertices),
            face_count=len(raw.faces),
            label_set=build.inputs.label_set,
            source_faces=raw.source_faces,
        )
        if len(labels) == len(raw.faces):
            with values_of(build.run / SCAN):
                of_faces = labels[load_source_faces(build.run)]
            result = segment_scan(scan, face_labels=of_faces)
        else:
            with values_of(build.run / SCAN):
                of_vertices = labels[source_vertex]
            result = segment_scan(scan, vertex_labels=of_vertices)
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
    checks = [
        Check(
            "label confidence, mean",
            float(areas @ result.confidence),
            "",
            0.8,
            0.5,
            higher_is_better=True,
            explanation="area-weighted; how clearly the labels speak for the answer",
        ),
        Check(
            "share of the surface no label saw",
            float(areas @ ~result.seen),
            "",
            0.25,
            0.6,
            explanation="labelled from its neighbours alone",
        ),
    ]
    numbers = {
        "area_share": {str(k): float(areas[result.face_labels == k].sum()) for k in range(6)},
        "corrected_by_hand": float(areas @ result.corrected),
    }
    return StageOutput(checks, numbers)


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
