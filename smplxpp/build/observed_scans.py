"""Read scans as a registration sees them, with the labels that it may know."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from smplxpp.build.config import RegisterInputs
from smplxpp.build.data import LocatedInScan
from smplxpp.build.scan import ScanFile, read_scan, scan_file_labels
from smplxpp.capture import Capture
from smplxpp.core import BACKGROUND, LABELS, GeometryWarning, InputError, MeshLike, TriangleMesh
from smplxpp.register import ScanObservation, ViewMap
from smplxpp.segment import LabelSet, find_label_set, vote_on_faces


def observed_scans(
    files: Mapping[int, Path | MeshLike],
    inputs: RegisterInputs,
    capture: Capture | None,
    maps: ViewMap | None,
    located: Callable[[], LocatedInScan] | None,
) -> tuple[dict[int, ScanObservation], list[str]]:
    """Read scans; those that cannot be read are left out, unless it is the one that the user named.

    Labels of the reference frame's scan are those that the inputs name. Every other scan has the votes of its frame's
    label maps, where there are any, because a file of labels beside a scan is a truth that no tracker has. A reference
    frame without either has the certain labels of the body that was found in its scan.

    Args:
        files: scans by frame.
        inputs: what the body is registered to.
        capture: that the label maps are of; None for a scan alone.
        maps: label maps of the cameras that may be used, ids of `smplxpp.core.labels`, 255 elsewhere.
        located: gives the body that was found in the reference frame's scan; None where it was not searched.

    Returns:
        The scans, and notes on those that were left out.

    Raises:
        InputError: the scan that the user named cannot be read, or the labels do not fit it.
    """
    scans, notes = {}, []
    for frame, source in files.items():
        try:
            with warnings.catch_warnings():
                # The step that prepares the template's scan repeats the warnings; repairs here are not kept.
                warnings.simplefilter("ignore", GeometryWarning)
                scan = read_scan(source, units=inputs.units, up=inputs.up)
        except InputError as error:
            # The scan that the user named must be read, or the registration would silently fit something else.
            if source is inputs.scan or (isinstance(source, Path) and source == inputs.scan):
                raise
            notes.append(f"frame {frame}: the scan is left out: {error}")
            continue
        mesh = scan.clean.mesh
        labels: Int64[np.ndarray, " V"] | None
        # Labels of a file are in the file's order of elements; repair removes some, so that they are gathered by
        # source.
        if frame == inputs.frame and inputs.labels is not None:
            labels = _given_labels(inputs.labels, scan, inputs.label_set)
        else:
            labels = _voted_labels(mesh, frame, capture, maps)
            if labels is None and frame == inputs.frame and located is not None:
                labels = located().labels_of(mesh.vertex_count)
        scans[frame] = ScanObservation(mesh, labels)
    return scans, notes


def _given_labels(given: Path | np.ndarray, scan: ScanFile, label_set: str | LabelSet) -> Int64[np.ndarray, " V"]:
    """Return labels of a file or an array, one a vertex of the repaired scan, as the built-in ones they behave like."""
    labels, of_faces = scan_file_labels(given, scan.raw, label_set=label_set)
    labels = find_label_set(label_set).labels.kind_ids(labels)
    clean = scan.clean
    if not of_faces:
        return labels[clean.source_vertex]
    out = np.full(clean.mesh.vertex_count, BACKGROUND, dtype=np.int64)
    out[clean.mesh.faces] = labels[clean.source_face][:, None]
    return out


def _voted_labels(
    mesh: TriangleMesh, frame: int, capture: Capture | None, maps: ViewMap | None
) -> Int64[np.ndarray, " V"] | None:
    """Labels of the vertices where a clear majority of label maps agrees, -1 elsewhere; None without maps."""
    clear_majority = 0.6  # share of a vertex's votes, below which its label is not known
    if capture is None or maps is None:
        return None
    views = []
    for name, camera in capture.cameras.items():
        labels = maps(name, frame)
        if labels is not None and (labels < len(LABELS)).any():
            # Values from the number of labels on (255 for "elsewhere") become BACKGROUND, which casts no vote.
            views.append((camera, np.where(labels < len(LABELS), labels.astype(np.int64), BACKGROUND)))
    if not views:
        return None
    try:
        # (M, L): for each face the weight of its votes by label.
        faces = vote_on_faces(mesh, views)
    except InputError:  # maps that show nothing of the scan: nothing is known of it
        return None
    # Sum the votes of the faces around each vertex.
    votes = np.stack(
        [np.bincount(mesh.faces.ravel(), np.repeat(column, 3), mesh.vertex_count) for column in faces.T], axis=1
    )
    total = votes.sum(axis=1)
    clear = (total > 0) & (votes.max(axis=1) >= clear_majority * total)
    return np.where(clear, votes.argmax(axis=1), BACKGROUND)
