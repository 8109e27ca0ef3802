"""Find the body in a scan that comes with nothing else, and refuse one that was found with too little confidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from smplxpp.body import BodyModel
from smplxpp.build.data import LocatedInScan
from smplxpp.build.scan import ScanFile
from smplxpp.build.scan_keypoints import Landmarks, facing, keypoints_of_scan
from smplxpp.clean import smooth_if_rough
from smplxpp.core import BACKGROUND, SKIN, BodyParams, Check, InputError, StageOutput, TriangleMesh
from smplxpp.core.files.json_file import jsonable
from smplxpp.detect import load_detector
from smplxpp.raster import render_within
from smplxpp.register import ScanObservation, bare_of_scan, read_landmarks
from smplxpp.register.locate import BodyNotFoundError, LocatedBody, locate_body
from smplxpp.segment import UNSURE, label_by_body
from smplxpp.segment.by_body_confidence import TAKEN_AS_BARE

LEAST_CONFIDENCE = 0.1
"""Confidence of a located body below which a build stops.

Of 14 real scans and 18 procedural people in rare poses, bodies with every limb in its place have .74 and up, but for
one in clothes 45 mm wide (.03); the other facing, lost poses and two people stay below .04, a single limb elsewhere
below .09."""
_HELP = (
    "cut away everything but the person, place landmarks (`smplxpp label`, --landmarks), ask a "
    "detector (--detector mediapipe), or give the parameters (--params). --accept-failures builds all the same"
)
_CERTAIN = 0.4
"""Certainty from which a detector's point proposes the pose of a limb: less is seen by few views, or only by some."""


def require_found(
    scan: TriangleMesh,
    body: BodyModel,
    params: BodyParams,
    *,
    confidence: float,
    findings: Sequence[str],
    picture_file: Path | None = None,
) -> None:
    """Refuse to build on a body that was found with too little confidence, or with a shape that no person has.

    Args:
        scan: the surface, metres, +Y up.
        body: the model.
        params: the body that was found, one row.
        confidence: of it, from 0 to 1.
        findings: sentences about evidence against one whole person.
        picture_file: file in which the caller will write the error's picture, for the message; None: it does not.

    Raises:
        BodyNotFoundError: the confidence is below `LEAST_CONFIDENCE`, or the shape is none.
    """
    strange = strange_shape(params)
    found = f"a confidence of {confidence:.2g} (a build needs {LEAST_CONFIDENCE:g})"
    if confidence >= LEAST_CONFIDENCE:
        if strange is None:
            return
        found = strange
    what = "".join(f"; {finding}" for finding in findings)
    raise BodyNotFoundError(
        LocatedBody(params, confidence, findings=tuple(findings)),
        received=f"a body with {found}{what}",
        remedy=_HELP if picture_file is None else f"look at {picture_file}; {_HELP}",
        picture=picture_within(scan, body, params),
    )


def strange_shape(params: BodyParams) -> str | None:
    """Return a finding about a shape that no person has; None for that of a person.

    Example:
        >>> strange_shape(BodyParams.rest(betas=np.full(20, 1.5))) is None
        True
    """
    # Mean square of the betas: people have 1, bodies found in heavy, thin and drawn ones up to 6.5; of a figure with
    # limbs of other lengths the search made 90, with a waist of a hand's width.
    most = 12.0
    square = float(np.square(params.betas).mean()) if params.betas.size else 0.0
    return (
        f"a shape that no person has (betas of a mean square of {square:.0f}, people have 1)" if square > most else None
    )


def picture_within(scan: TriangleMesh, body: BodyModel, params: BodyParams) -> np.ndarray:
    """Draw a scan, and a body within it from its front and its side.

    Args:
        scan: the surface, metres, +Y up.
        body: the model.
        params: the body, one row.
    """
    x, _, z = body.joint_rotations(params)[0, 0][:, 2]
    posed = body.mesh(body.forward(params).vertices[0])
    return render_within(posed, scan, facing=float(np.arctan2(x, z)))


def landmark_points(landmarks: Path | Mapping[str, Any] | None) -> dict[str, np.ndarray] | None:
    """Return landmarks by name, read from their file if they are in one."""
    if landmarks is None:
        return None
    if isinstance(landmarks, Path):
        return dict(read_landmarks(landmarks))
    return {name: np.asarray(point, dtype=np.float64) for name, point in landmarks.items()}


def locate_in_scan(
    scan: ScanFile,
    body: BodyModel,
    *,
    landmarks: Path | Mapping[str, Any] | None = None,
    detector: str | None = None,
    height: float | None = None,
    start: BodyParams | None = None,
) -> tuple[LocatedInScan, StageOutput]:
    """Find the body in a scan, with its confidence and the other candidates.

    With a stature the scan is scaled by the ratio of the stature to that of the body found, and searched again, until
    both agree. The caller decides whether the confidence suffices (`smplxpp.build.locate.require_found`).

    Args:
        scan: repaired.
        body: the model.
        landmarks: points placed by hand, which are trusted.
        detector: keypoint model that is asked for the front and for limbs; see `BuildConfig`. Unused beside landmarks.
        height: the person's stature, metres; None: the scan has its size.
        start: one frame of a body of another shape in the scan, whose limbs and front are proposed as a detector's
            keypoints are; it takes the place of the detector.

    Raises:
        InputError: a surface that is not of a person's size, or landmarks that the body does not have.
    """
    placed = landmark_points(landmarks)
    found, output = _located(scan, body, placed, detector, start)
    if height is None:
        return found, output
    # Poses, shoes and hair make the scan's extent another length than the stature. The body's shape prior draws a
    # wrong size towards the mean, so that one step need not suffice. 1 % is less than shoes and hair add.
    scale, tolerance, rounds = 1.0, 0.01, 3
    for _ in range(rounds):
        ratio = height / stature(body, found.params)
        if abs(ratio - 1.0) < tolerance:
            break
        scale *= ratio
        scaled = None if placed is None else {name: scale * point for name, point in placed.items()}
        found, output = _located(scan.scaled(scale), body, scaled, detector, None)
    numbers = {"height": height, "stature": stature(body, found.params), "scale": scale}
    return replace(found, scale=scale), StageOutput(output.checks, {**output.numbers, **numbers})


def stature(body: BodyModel, params: BodyParams) -> float:
    """Return the height of a shaped body that stands upright, metres: from soles to top of the head in the T-pose."""
    shaped = body.forward(BodyParams.rest(betas=params.betas[0], expressions=0, v_shape=params.v_shape))
    return float(np.ptp(shaped.vertices[0][:, 1]))


def _located(
    scan: ScanFile,
    body: BodyModel,
    landmarks: dict[str, np.ndarray] | None,
    detector: str | None,
    start: BodyParams | None,
) -> tuple[LocatedInScan, StageOutput]:
    """Find the body in a scan of known size; see `locate_in_scan`."""
    # Search on the surface that the template will be made of: smoothed where the scan is rough.
    mesh, colors = smooth_if_rough(scan.clean.mesh).mesh, scan.colors
    labeller = partial(certain_labels, mesh, body, colors)
    search = partial(locate_body, body, mesh, colors=colors, labeller=labeller)
    # The surface decides, because it is precise. Keypoints of a detector, or of a body of another shape, only propose
    # limb poses and can correct the facing direction.
    note, seen = "", Landmarks()
    if start is not None:
        seen = _points_of(body, start)
    elif detector is not None and landmarks is None:
        seen, note = _detected(mesh, colors, detector)
    if seen and landmarks is None:
        found = _best(search, hints={name: point for name, (point, certainty) in seen.items() if certainty >= _CERTAIN})
        found, note = _confirmed(found, search, seen)
        note = note if start is None else note.replace("detector's keypoints", "given parameters")
    else:
        found = _best(search, landmarks=landmarks)
    # Keep the labels that a registration may lean on, a label for each vertex of a certain face.
    labels = np.full(mesh.vertex_count, BACKGROUND, dtype=np.int64)
    # One label a face, BACKGROUND where body and colours disagree, and everywhere on what is no person.
    of_faces = labeller(found.params) if found.confidence > 0 else np.full(mesh.face_count, BACKGROUND)
    known = of_faces != BACKGROUND
    # A vertex between faces with different labels takes the label of the last of them; such vertices lie on seams.
    labels[mesh.faces[known]] = of_faces[known][:, None]
    # Skin that the scan shows without clothes; only there must the registration bring the body onto the scan.
    bare = bare_of_scan(body, found.params, ScanObservation(mesh, labels))
    numbers = {
        "units": scan.units,
        "up": scan.up,
        "said": scan.note,
        "detector": note,
        "facing_degrees": found.candidates[0].facing_degrees,
        "confidence": found.confidence,
        "problems": list(found.notes),
        "findings": list(found.findings),
        "strange_shape": strange_shape(found.params),
        "moved": list(found.moved),
        "candidates": found.candidates,
        "bare": float(bare.mean()),
    }
    # Confidence is the margin over the best pose with another facing; without a lead the person may stand turned by
    # 180 degrees.
    check = Check(
        "confidence of the body found",
        found.confidence,
        "",
        0.5,
        LEAST_CONFIDENCE,
        higher_is_better=True,
        explanation="how far the best way to stand in the scan is ahead of the best that faces another way"
        + "".join(f"; {problem}" for problem in found.notes),
    )
    return LocatedInScan(found.params, labels, bare), StageOutput([check], jsonable(numbers))


def _points_of(body: BodyModel, start: BodyParams) -> Landmarks:
    """Return the detectors' keypoints on a posed body, by name, each with a confidence of 1."""
    vertices = body.forward(start).vertices[0]
    return {name: (weights @ vertices[index], 1.0) for name, (index, weights) in body.landmarks.items()}


def _detected(mesh: TriangleMesh, colors: UInt8[np.ndarray, "N 3"] | None, detector: str) -> tuple[Landmarks, str]:
    """Return a detector's keypoints of a scan; if it finds no person, possibly for lack of colours, the reason."""
    loaded = load_detector(detector)
    try:
        return keypoints_of_scan(mesh, colors, loaded), ""
    except InputError as error:
        return {}, f"the detector sees no person: {error.received}"


def _best(search: Callable[..., LocatedBody], **known: Any) -> LocatedBody:
    """Return the best body, with confidence 0 for a surface that is no person; `require_found` refuses it later."""
    try:
        return search(**known)
    except BodyNotFoundError as error:
        return error.located


def _confirmed(found: LocatedBody, search: Callable[..., LocatedBody], landmarks: Landmarks) -> tuple[LocatedBody, str]:
    """Keep the body found if a detector's keypoints agree on its facing direction; else search again with them.

    Keypoints are centimetres off, geometry is not: they propose limb poses and decide the facing direction alone.
    """
    front = facing(landmarks)
    if front is None:
        return found, "the detector's keypoints do not tell the front"
    # The surface's front is (sin a, 0, cos a) with the angle a about +Y from +Z, and `front` is a horizontal unit
    # vector. A positive dot product means that they differ by less than 90 degrees.
    own = np.radians(found.candidates[0].facing_degrees)
    if np.sin(own) * front[0] + np.cos(own) * front[2] > 0:
        return found, "the detector's keypoints face the same way"
    again = _best(search, landmarks={name: point for name, (point, _) in landmarks.items() if name.startswith("coco_")})
    return again, "the surface alone was taken for a person who faces away from where the detector's keypoints do"


def certain_labels(
    mesh: TriangleMesh, body: BodyModel, colors: UInt8[np.ndarray, "N 3"] | None, params: BodyParams
) -> Int64[np.ndarray, " M"]:
    """Return labels of a scan's faces by its colours and a body in it; -1 where they do not tell."""
    # A wrong label pulls the fit, a missing one only slows it.
    labelled = label_by_body(mesh, body, params, colors=colors)
    known = labelled.confidence >= UNSURE
    if TAKEN_AS_BARE in labelled.notes:
        # Skin or tight clothes: either lies where the body is.
        known |= (labelled.face_labels == SKIN.id) & (labelled.confidence >= 0.76 * UNSURE)
    return np.where(known, labelled.face_labels, BACKGROUND)
