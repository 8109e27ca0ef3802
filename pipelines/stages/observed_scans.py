"""Scans as a registration sees them, with the labels that it may know."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from pipelines.stages.located import read_located_labels
from pipelines.stages.register_config import RegisterInputs
from pipelines.stages.scan_files import ScanFile, read_scan
from smplxpp.capture import Capture
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.labels import BACKGROUND, LABELS
from smplxpp.core.mesh import TriangleMesh
from smplxpp.register import ScanObservation, ViewMap
from smplxpp.segment import read_labels, vote_on_faces

CLEAR_MAJORITY = 0.6
"""Share of a vertex's votes that its label has; others are not known."""


def observed_scans(
    files: Mapping[int, Path],
    inputs: RegisterInputs,
    capture: Capture | None,
    maps: ViewMap | None,
    located: Path | None,
) -> tuple[dict[int, ScanObservation], list[str]]:
    """Read scans; those that cannot be read are left out, unless it is the one that the user named.

    Labels of the reference frame's scan are those that the inputs name. Every other scan has the votes of its frame's
    label maps, where there are any: a file of labels beside a scan is a truth that no tracker has. Where nobody has
    labelled the reference frame, the body that was found in its scan says what is sure.

    Args:
        files: by frame.
        maps: label maps of the cameras that may be used, ids of `smplxpp.core.labels`, 255 elsewhere.
        located: folder of the stage that found the body in the reference frame's scan, None where there is none.

    Returns:
        The scans, and what was wrong with the others, in words.

    Raises:
        InputError: the scan that the user named cannot be read, or the labels do not fit it.
    """
    scans, problems = {}, []
    for frame, path in files.items():
        try:
            with warnings.catch_warnings():
                # What a template is built from is told at its stage; here a repair changes nothing that is kept.
                warnings.simplefilter("ignore", GeometryWarning)
                scan = read_scan(path, units=inputs.units, up=inputs.up)
        except InputError as error:
            if path == inputs.scan:
                raise
            problems.append(f"frame {frame}: the scan is left out: {error}")
            continue
        mesh = scan.clean.mesh
        labels: Int64[np.ndarray, " V"] | None
        if frame == inputs.frame and inputs.labels is not None:
            labels = _given_labels(inputs.labels, scan, inputs.label_set)
        else:
            labels = _voted_labels(mesh, frame, capture, maps)
            if labels is None and frame == inputs.frame and located is not None:
                labels = read_located_labels(located, mesh.vertex_count)
        scans[frame] = ScanObservation(mesh, labels)
    return scans, problems


def _given_labels(path: Path, scan: ScanFile, label_set: str) -> Int64[np.ndarray, " V"]:
    """The labels of a file, a vertex."""
    raw = scan.raw
    labels = read_labels(
        path,
        vertex_count=len(raw.vertices),
        face_count=len(raw.faces),
        label_set=label_set,
        source_faces=raw.source_faces,
    )
    clean = scan.clean
    if len(labels) != len(raw.faces):
        return labels[clean.source_vertex]
    out = np.full(clean.mesh.vertex_count, BACKGROUND, dtype=np.int64)
    out[clean.mesh.faces] = labels[clean.source_face][:, None]
    return out


def _voted_labels(
    mesh: TriangleMesh, frame: int, capture: Capture | None, maps: ViewMap | None
) -> Int64[np.ndarray, " V"] | None:
    """What a frame's label maps clearly say of the vertices, negative elsewhere; None where there are no maps."""
    if capture is None or maps is None:
        return None
    views = []
    for name, camera in capture.cameras.items():
        labels = maps(name, frame)
        if labels is not None and (labels < len(LABELS)).any():
            views.append((camera, np.where(labels < len(LABELS), labels.astype(np.int64), BACKGROUND)))
    if not views:
        return None
    try:
        faces = vote_on_faces(mesh, views)
    except InputError:  # maps that show nothing of the scan: nothing is known of it
        return None
    votes = np.stack(
        [np.bincount(mesh.faces.ravel(), np.repeat(column, 3), mesh.vertex_count) for column in faces.T], axis=1
    )
    total = votes.sum(axis=1)
    clear = (total > 0) & (votes.max(axis=1) >= CLEAR_MAJORITY * total)
    return np.where(clear, votes.argmax(axis=1), BACKGROUND)
