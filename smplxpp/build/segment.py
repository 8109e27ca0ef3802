"""Label every face of the scan: from its own labels, from votes of label maps, or from the body in it."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from smplxpp.body import BodyModel
from smplxpp.build.config import BuildInputs
from smplxpp.build.data import PreparedScan
from smplxpp.build.scan import ScanFile, scan_file_labels
from smplxpp.capture import read_cameras
from smplxpp.core import SKIN, BodyParams, Check, GeometryWarning, InputError, Labels, StageOutput, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.mesh_files.raw_mesh import RawMesh
from smplxpp.segment import (
    SegmentedScan,
    find_label_set,
    holds_labels,
    label_by_body,
    read_label_map,
    segment_scan,
    vote_in_agreement,
)
from smplxpp.segment.corrections import Corrections


@dataclass(frozen=True, eq=False)
class LabelledFaces:
    """Labels of the scan's faces, and what they were before corrections by hand.

    Attributes:
        result: labels, confidence, which faces were seen and which were corrected.
        before: the same before the corrections.
    """

    result: SegmentedScan
    before: SegmentedScan

    @property
    def face_labels(self) -> Int64[np.ndarray, " M"]:
        """A label for every face of the scan."""
        return self.result.face_labels


def label_source(inputs: BuildInputs) -> str:
    """Return where labels come from: a "file" (or the scan's own), "views" and their label maps, or the "body"."""
    if inputs.label_source == "body":
        return "body"
    # Labels that the user names come first, then label maps, then labels in the scan's own file, and last the body.
    if inputs.labels is None and inputs.label_maps:
        return "views"
    if inputs.labels is not None:
        return "file"
    scan = inputs.scan
    of_scan = isinstance(scan, Path) and not inputs.reconstructs and holds_labels(scan, labels=inputs.labels_used)
    return "file" if of_scan else "body"


def label_faces(
    scan: PreparedScan,
    inputs: BuildInputs,
    body: BodyModel,
    params: BodyParams,
    *,
    file: ScanFile | None = None,
    corrections: Corrections | None = None,
) -> tuple[LabelledFaces, StageOutput]:
    """Give every face a label, a confidence and a flag whether anything saw it.

    Args:
        scan: prepared.
        inputs: they name the labels.
        body: the model of `params`.
        params: of the scan's pose.
        file: the scan as its file has it, where labels are given in memory; None: it is read when it is needed.
        corrections: labels set by hand.

    Raises:
        InputError: labels that do not fit the scan, or label maps without their cameras.
    """
    source = label_source(inputs)
    if source == "views":
        before = _by_views(scan, inputs, body, params)
    elif source == "body":
        before = _by_body(scan, inputs, body, params)
    else:
        before = _by_file(scan, inputs, file)
    # Corrections by hand come last: they overrule every source of labels.
    result = (corrections or Corrections()).apply(scan.mesh, before)
    labelled = LabelledFaces(result, before)
    return labelled, _measured(scan.mesh, labelled, source, inputs.labels_used)


def _by_body(scan: PreparedScan, inputs: BuildInputs, body: BodyModel, params: BodyParams) -> SegmentedScan:
    """Ask body and colours, which know the built-in labels; what behaves like one of these has it."""
    found = label_by_body(scan.mesh, body, params, colors=scan.own_colors)
    label_set = find_label_set(inputs.label_set)
    return found if not label_set.labels.own else replace(found, face_labels=label_set.of_body(found.face_labels))


def _measured(mesh: TriangleMesh, labelled: LabelledFaces, source: str, labels: Labels) -> StageOutput:
    """Check the confidence, and the share of the surface that nothing saw or that is uncertain, by area."""
    result, uncertain = labelled.result, 0.5  # confidence below which a label should be looked at
    # Normalised by area, so that `areas @ x` is the mean over the surface, whatever the density of faces.
    areas = mesh.face_areas / mesh.face_areas.sum()
    confidence = Check(
        "label confidence, mean",
        float(areas @ result.confidence),
        "",
        0.8,
        0.5,
        higher_is_better=True,
        explanation="area-weighted; how clearly the labels speak for the answer",
    )
    if source == "body":
        # Body and colours see every face, so that coverage says nothing here; low confidence does.
        coverage = Check(
            "share of the surface with a doubtful label",
            float(areas @ (result.confidence < uncertain)),
            "",
            0.15,
            0.4,
            explanation=f"told by the body and colours with a confidence below {uncertain:g}; look at it, and correct "
            "it with `smplxpp label`",
        )
    else:
        coverage = Check(
            # Faces that no view sees, such as soles and armpits, take their neighbours' label in the graph cut.
            "share of the surface no label saw",
            float(areas @ ~result.seen),
            "",
            0.25,
            0.6,
            explanation="labelled from its neighbours alone",
        )
    assert result.corrected is not None
    numbers = {
        "labels_from": source,
        "notes": list(labelled.before.notes),
        "corrected_by_hand": float(areas @ result.corrected),
        "area_share": {str(k): float(areas[result.face_labels == k].sum()) for k in range(len(labels))},
    }
    if labels.own:
        numbers["labels"] = [asdict(label) for label in labels]
    return StageOutput([confidence, coverage], numbers)


def _by_views(scan: PreparedScan, inputs: BuildInputs, body: BodyModel, params: BodyParams) -> SegmentedScan:
    """Let label maps that agree vote; where votes are few, the body and the colours decide.

    Raises:
        InputError: no camera file, or maps of cameras that it does not have.
    """
    file = inputs.cameras
    if file is None:
        raise InputError(
            "label maps",
            expected="a camera file with them",
            received="none",
            remedy="put cameras.json or calibration.csv into the capture",
        )
    cameras = {camera.name: camera for camera in read_cameras(file)}
    # Label maps of an unknown camera show that the wrong calibration file was found.
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
    # Each map is compared with the votes of the others; see `vote_in_agreement`.
    labels = inputs.labels_used
    agreed = vote_in_agreement(scan.mesh, views, labels=labels)
    # A map that the others contradict is left out: an estimator's mistake would otherwise reach the template.
    notes = tuple(
        f"label map of {name} left out: the other views agree with {share:.0%} of it"
        for name, share in agreed.left_out.items()
    )
    for note in notes:
        warnings.warn(note, GeometryWarning, stacklevel=2)
    colors = scan.own_colors
    # A prior for faces with few votes: which label the body's region and the scan's colours make likely.
    prior = _by_body(scan, inputs, body, params)
    result = segment_scan(scan.mesh, votes=agreed.votes, colors=colors, prior=prior, labels=labels)
    return replace(result, notes=(*notes, *result.notes))


def _by_file(scan: PreparedScan, inputs: BuildInputs, file: ScanFile | None) -> SegmentedScan:
    """Take labels of the vertices or faces of the scan's file along to the prepared scan."""
    raw: RawMesh
    if file is not None:
        raw = file.raw
    elif isinstance(inputs.scan, Path):
        raw = read_raw_mesh(inputs.scan, clouds=True)
    else:
        raise InputError("labels", expected="the scan that they are of", received="none")
    source = inputs.scan if inputs.labels is None else inputs.labels
    assert isinstance(source, Path | np.ndarray), "labels are a file or an array"
    # Labels are in the file's order. The repair of the scan dropped and split elements, so that they are gathered by
    # source.
    labels, of_faces = scan_file_labels(source, raw, label_set=inputs.label_set)
    used = inputs.labels_used
    if of_faces:
        return segment_scan(scan.mesh, face_labels=_taken(labels, scan.source_face, "source_face"), labels=used)
    return segment_scan(scan.mesh, vertex_labels=_taken(labels, scan.source_vertex, "source_vertex"), labels=used)


def _taken(labels: np.ndarray, source: np.ndarray, name: str) -> np.ndarray:
    """Labels at the places that elements of the scan come from.

    Raises:
        InputError: places that the file does not have.
    """
    # An index outside of the file means that the prepared scan was made of another version of it.
    if source.size and source.max() >= len(labels):
        raise InputError(
            f"scan: {name}", expected=f"places below {len(labels)} in its file", received=f"up to {int(source.max())}"
        )
    return labels[source]


def vertex_labels(mesh: TriangleMesh, face_labels: np.ndarray) -> np.ndarray:
    """(N,) a label for every vertex: that of its last face in order, for pictures and files."""
    out = np.full(mesh.vertex_count, SKIN.id, dtype=np.int64)
    out[mesh.faces] = face_labels[:, None]
    return out
