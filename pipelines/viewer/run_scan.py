"""What the viewer shows of a run, and its labels made again."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import load_labels, load_scan, load_scan_labels, read_named, take, values_of
from pipelines.runs.layout import (
    CORRECTIONS_FILE,
    LANDMARKS_FILE,
    RECONSTRUCT_FILE,
    REGISTER_FILE,
    SCAN,
    SCAN_LABELS,
    SEGMENT_STAGE,
)
from pipelines.stages.build import build
from pipelines.stages.build_config import load_build, load_reconstruct, load_register
from pipelines.viewer.session import LabelledScan, LabelSession
from smplxpp.build.prepare import GREY
from smplxpp.build.scan import read_scan
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.files import as_numbers, read_arrays
from smplxpp.register import read_landmarks
from smplxpp.segment import Corrections


def open_session(run: Path) -> LabelSession:
    """The scan of a run, its labels before any correction, and the corrections and landmarks that lie in the run.

    A run whose build stopped before its scan was kept has the scan that it was to be built from, and no labels: there
    landmarks can be placed.

    Raises:
        InputError: no run, or one without any scan.
    """
    corrections, landmarks = run / CORRECTIONS_FILE, run / LANDMARKS_FILE
    return LabelSession(
        _labelled_scan(run),
        Corrections.load(corrections, labels=load_labels(run)) if corrections.exists() else None,
        read_landmarks(landmarks) if landmarks.exists() else None,
    )


def _labelled_scan(run: Path) -> LabelledScan:
    if not (run / SCAN).is_file():
        return _unbuilt_scan(run)
    mesh, colors, _ = load_scan(run)
    if not (run / SCAN_LABELS).is_file():
        return LabelledScan(mesh, colors, None, None)
    labels = load_scan_labels(run, mesh.face_count)
    (confidence,) = read_named(run / SCAN_LABELS, "confidence")
    with values_of(run / SCAN_LABELS):
        confidence = as_numbers(confidence, (mesh.face_count,), subject="confidence")
    before = read_arrays(run / SCAN_LABELS, subject="stage file")
    # Corrections by hand are applied to the labels that the stage found, not to those with earlier corrections.
    if "labels_before_hand" in before:
        found = take(before, "labels_before_hand", "confidence_before_hand", path=run / SCAN_LABELS)
        with values_of(run / SCAN_LABELS):
            confidence = as_numbers(
                found["confidence_before_hand"], (mesh.face_count,), subject="confidence_before_hand"
            )
            labels = _before_hand(found["labels_before_hand"], mesh.face_count)
    return LabelledScan(mesh, colors, labels.astype(np.int64), confidence, load_labels(run))


def _before_hand(labels: np.ndarray, faces: int) -> np.ndarray:
    """Labels as the stage had them before corrections.

    Raises:
        InputError: others than a whole number a face.
    """
    if labels.dtype.kind not in "iu" or labels.shape != (faces,):
        raise InputError(
            "labels_before_hand", expected=f"{faces} whole numbers", received=f"{labels.dtype} {labels.shape}"
        )
    return labels


def _unbuilt_scan(run: Path) -> LabelledScan:
    found = load_build(run) if run.is_dir() else None
    if found is None:
        raise InputError(
            f"run {run}",
            expected="a run of `smplxpp build` with a scan",
            received="a folder without one" if run.is_dir() else "no such folder",
            remedy="build it first: `smplxpp build RUN --scan SCAN`; a build that stops is enough",
        )
    inputs, config = found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # told by the build
        scan = read_scan(inputs.scan_file, units=config.units, up=config.up, height=config.height)
    raw, clean = scan.raw, scan.clean
    colors = np.full((len(raw.vertices), 3), GREY, np.uint8) if raw.vertex_colors is None else raw.vertex_colors
    return LabelledScan(clean.mesh, np.asarray(colors[clean.source_vertex], dtype=np.uint8), None, None)


def label_again(run: Path, *, progress: Callable[[str, bool], None] = lambda name, done: None) -> LabelSession:
    """Run the stage of a run's labels again, with the corrections that lie in it, and open what comes out.

    Raises:
        InputError: the run does not say what it was built from, or the stage refuses.
    """
    found = load_build(run)
    if found is None:
        raise InputError(
            f"run {run}",
            expected="what it was built from (build.json)",
            received="nothing of the kind",
            remedy="give `smplxpp build` again",
        )
    inputs, config = found
    # A build that registers or reconstructs needs the inputs of these stages too, to find them up to date.
    registration = load_register(run) if inputs.registers else None
    reconstruction = load_reconstruct(run) if inputs.reconstructs else None
    lacks = (registration is None and inputs.registers, reconstruction is None and inputs.reconstructs)
    if any(lacks):
        name = REGISTER_FILE if lacks[0] else RECONSTRUCT_FILE
        raise InputError(
            f"run {run}",
            expected=f"what it was made from ({name})",
            received="nothing of the kind",
            remedy="give `smplxpp build` again",
        )
    build(
        run,
        inputs,
        config,
        registration=registration,
        reconstruction=reconstruction,
        first=SEGMENT_STAGE,
        last=SEGMENT_STAGE,
        progress=progress,
    )
    return open_session(run)
