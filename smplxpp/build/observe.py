"""Collect what a registration may see of a capture: held-out cameras and frames are never used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from smplxpp.body import BodyModel, load_params
from smplxpp.build.config import RegisterInputs
from smplxpp.build.data import LocatedInScan
from smplxpp.build.locate import landmark_points
from smplxpp.build.observed_scans import observed_scans
from smplxpp.build.request import opened
from smplxpp.capture import Capture, find_scans, scans_in
from smplxpp.core import BACKGROUND, BodyParams, InputError, Keypoints2D, MeshLike
from smplxpp.register import LandmarkModel, Observations
from smplxpp.segment import map_labels

ELSEWHERE = 255
"""Value of a label map where there is no label of the person."""
_NAMED = 6  # frames or landmarks named in an error


@dataclass(eq=False)
class ViewMaps:
    """Masks or label maps of the cameras that may be used; one that cannot be read counts as missing.

    Attributes:
        capture: that they are of.
        cameras: names of those that may be used.
        kind: "mask" or "label".
        notes: on the files that could not be read so far, by camera and frame.
    """

    capture: Capture
    cameras: tuple[str, ...]
    kind: str
    notes: dict[tuple[str, int], str] = field(default_factory=dict)

    def __call__(self, camera: str, frame: int) -> UInt8[np.ndarray, "H W"] | None:
        """Return the map of a camera and a frame; None where there is none."""
        # A map that failed once is not read again, so that each bad file is noted once.
        if camera not in self.cameras or (camera, frame) in self.notes:
            return None
        try:
            if self.kind == "mask":
                return self.capture.mask(camera, frame)
            labels = self.capture.labels(camera, frame)
            if labels is None:
                return None
            ours = map_labels(labels, self.capture.label_set)
        except InputError as error:
            self.notes[camera, frame] = f"camera {camera}, frame {frame}: {self.kind} left out: {error}"
            return None
        # Masks of the solver hold uint8, so that BACKGROUND (-1) moves to 255.
        return np.where(ours == BACKGROUND, ELSEWHERE, ours).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations, and what they are made of.

    Attributes:
        capture: None for a scan alone.
        observations: what a registration sees.
        scans: the scans by frame.
        notes: what was left out on opening.
        maps: masks and label maps, which give more notes when they are read.
        placed: whether landmarks placed by hand are among the observations.
        found: the body that was found in the reference frame's scan, one row, where nothing else tells where it is.
    """

    capture: Capture | None
    observations: Observations
    scans: Mapping[int, Path | MeshLike]
    notes: tuple[str, ...]
    maps: tuple[ViewMaps, ...] = ()
    placed: bool = False
    found: BodyParams | None = None

    def all_notes(self) -> tuple[str, ...]:
        """Return everything that was wrong with the inputs, as far as they were read."""
        return (*self.notes, *(note for one in self.maps for note in one.notes.values()))


def observe(
    inputs: RegisterInputs,
    body: BodyModel,
    *,
    landmarks: Path | Mapping[str, Any] | None = None,
    located: Callable[[], LocatedInScan] | None = None,
) -> Observed:
    """Collect what a registration of these inputs sees.

    Args:
        inputs: what the body is registered to.
        body: the model.
        landmarks: points placed by hand on the reference frame's scan, a file or by name.
        located: gives the body that was found in that scan; it is called where nothing else tells where the body is.

    Raises:
        InputError: neither cameras nor scans, keypoints without cameras, nothing to start from, parameters of another
            body, unknown cameras or frames.
    """
    # A lone scan has neither cameras nor splits.
    if inputs.capture is None:
        return _observe_scan(inputs, body, landmarks)
    capture = open_inputs(inputs, body)
    cameras = _training_cameras(capture, inputs)
    # Collect cameras and frames before anything is read, so that held-out data never enters the fit.
    files = _scan_files(capture.root, inputs)
    frames = _frames(capture, files, inputs)
    # Leave out scans of held-out frames: they show what held-out cameras saw.
    held_out = set(capture.splits.novel_pose_frames)
    files = {frame: path for frame, path in files.items() if frame in frames and frame not in held_out}
    keypoints, unread = _keypoints(capture, cameras)
    if not cameras and not files:
        # Scans alone suffice, and so do cameras alone; without both there is nothing to minimise a distance to.
        _refuse_nothing(capture)
    masks, labels = (_maps(capture, cameras, kind) for kind in ("mask", "label"))
    scans, notes = observed_scans(files, inputs, capture, labels, located)
    notes = [*unread, *notes]
    # Begin with the fit that there is, else with the body that was found in the reference frame's scan.
    initial, more = _initial(capture, frames, body) if inputs.start else (None, [])
    placed = _placed(landmarks, inputs.frame, body) if landmarks is not None and inputs.frame in frames else {}
    # Only the reference frame's body can be located, because landmarks and labels are known for that scan alone.
    found, bare = None, None
    if initial is None and located is not None and inputs.frame in frames:
        place = located()
        found, bare = place.params, place.bare_of(body)
    # The problem is not convex: without a start near the person, Gauss-Newton ends in a local minimum.
    if initial is None and not keypoints and not placed and found is None:
        raise InputError(
            f"capture {capture.name}",
            expected="keypoints of its training cameras, or a fit to start from",
            received="neither",
            remedy="detect keypoints (smplxpp keypoints detect, then --keypoints), name a fit with --params, or let "
            "`smplxpp build` find the body in the reference frame",
        )
    # The shape is one vector for all frames; it must not be fitted to frames that later test the avatar.
    shape = tuple(frame for frame in frames if frame not in held_out)
    if not shape:
        raise InputError(
            "frames", expected="one that is trained on: the shape is found on these alone", received="held-out frames"
        )
    observations = Observations(
        frames=frames,
        cameras={name: capture.cameras[name] for name in cameras},
        keypoints=keypoints,
        mask=masks,
        labels=labels,
        scans=scans,
        landmarks=placed,
        initial=initial,
        fps=capture.fps,
        shape_frames=shape,
        bare=bare,
        shape=None if inputs.shape is None else load_params(inputs.shape, body=body).frame(0).betas[0],
    )
    maps = tuple(one for one in (masks, labels) if one is not None)
    return Observed(capture, observations, files, (*notes, *more), maps, bool(placed), found)


def _observe_scan(inputs: RegisterInputs, body: BodyModel, landmarks: Path | Mapping[str, Any] | None) -> Observed:
    """One scan with a fit, or landmarks, to start from."""
    if inputs.scan is None:
        raise InputError("input", expected="--capture, or --scan with --params", received="neither")
    # A scan alone does not tell limbs from each other, so that either a fit or landmarks must place the body.
    given = inputs.params if inputs.start else None
    if given is None and landmarks is None:
        raise InputError(
            f"scan {inputs.scan.name if isinstance(inputs.scan, Path) else 'in memory'}",
            expected="a fit, or landmarks, to start from: a scan alone does not say where its limbs are",
            received="neither",
            remedy="name a fit with --params, or landmarks with --landmarks; `smplxpp build --scan` finds the body by "
            "itself",
        )
    initial = None
    if given is not None:
        in_memory = isinstance(given, BodyParams)
        params = given if isinstance(given, BodyParams) else load_params(given, body=body)
        # One row is the frame's whatever its number; of several rows it is the one with the frame's number.
        initial = params.frame(inputs.frame if len(params) > 1 else 0)
        # Fail now if the fit is of another body model: the number of joints or betas would not match in the solver.
        _check_body(initial, body, "body parameters" if in_memory else str(given))
    placed = {} if landmarks is None else _placed(landmarks, inputs.frame, body)
    files: dict[int, Path | MeshLike] = {inputs.frame: inputs.scan}
    # No capture, so that there are no label maps to vote and no body located in this scan.
    scans, _ = observed_scans(files, inputs, None, None, None)
    observations = Observations(
        (inputs.frame,), scans=scans, landmarks=placed, initial=initial, shape_frames=(inputs.frame,)
    )
    return Observed(None, observations, files, (), placed=landmarks is not None)


def _placed(
    landmarks: Path | Mapping[str, Any], frame: int, body: BodyModel
) -> dict[int, dict[str, Float64[np.ndarray, " 3"]]]:
    """Landmarks by the frame that they are of; empty where there are none.

    Raises:
        InputError: names that the body does not have.
    """
    points = landmark_points(landmarks) or {}
    unknown = LandmarkModel.of(body, tuple(points)).unknown
    if unknown:
        raise InputError(
            f"landmarks {landmarks}" if isinstance(landmarks, Path) else "landmarks",
            expected="joints of the body, nose, left_ear, left_heel, left_big_toe, face_30 and the like",
            received=", ".join(unknown[:_NAMED]),
            remedy="see docs/registration.md for the names",
        )
    return {frame: points} if points else {}


def open_inputs(inputs: RegisterInputs, body: BodyModel) -> Capture:
    """Open the capture of a registration with the parameters that it starts from."""
    assert inputs.capture is not None
    params = inputs.params if inputs.start else None
    return opened(
        inputs.capture,
        params=params,
        frame=inputs.frame,
        body=body,
        protocol=inputs.protocol,
        keypoints=inputs.keypoints,
        masks=inputs.masks,
        subject=inputs.subject,
    )


def _keypoints(capture: Capture, cameras: Sequence[str]) -> tuple[dict[str, Keypoints2D], list[str]]:
    """The keypoints of those cameras that have any, and what was wrong with the others.

    Raises:
        InputError: none of the files can be read.
    """
    found, errors = {}, {}
    # One broken file costs one camera. Only if all are broken is it an error of the input.
    for name in cameras:
        try:
            points = capture.keypoints(name)
        except InputError as error:
            errors[name] = error
            continue
        if points is not None:
            found[name] = points
    if errors and not found:
        raise next(iter(errors.values()))
    left_out = [f"camera {name}: keypoints left out: {error}" for name, error in errors.items()]
    return found, [*capture.keypoint_notes(), *left_out]


def _training_cameras(capture: Capture, inputs: RegisterInputs) -> tuple[str, ...]:
    splits = capture.splits
    # Names that the user holds out must exist: a misspelt one would leak a test camera into the fit.
    unknown = sorted(set(inputs.hold_out) - set(capture.cameras))
    if unknown:
        have = ", ".join(capture.cameras) or "none"
        raise InputError("option hold-out", expected=f"cameras among {have}", received=", ".join(unknown))
    held_out = inputs.hold_out or splits.novel_view_cameras
    # Cameras that are in no split are left out too.
    known = {*splits.train_cameras, *splits.novel_view_cameras}
    cameras = tuple(name for name in capture.cameras if name in known and name not in held_out)
    if capture.cameras and not cameras:
        raise InputError("cameras", expected="at least one that is not held out", received="all held out")
    return cameras


def _scan_files(root: Path, inputs: RegisterInputs) -> dict[int, Path | MeshLike]:
    """Scans by frame: the one that is named, those of the folder that is named, or the capture's own.

    Raises:
        InputError: a folder without scans.
    """
    # The scan that is named stands for the reference frame alone.
    if inputs.scan is not None:
        return {inputs.frame: inputs.scan}
    if inputs.scans is None:
        return dict(find_scans(root))
    found = scans_in(inputs.scans)
    if not found:
        raise InputError(
            "option scans", expected="a folder of scan_FFFFFF.ply (or .obj, .glb)", received=f"none in {inputs.scans}"
        )
    return dict(found)


def _frames(capture: Capture, scans: Mapping[int, Any], inputs: RegisterInputs) -> tuple[int, ...]:
    """The frames to register: those asked for, or all that are trained on or held out."""
    splits = capture.splits
    # A frame exists if it has images or a scan.
    have = set(capture.frames) | set(scans)
    if inputs.frames is not None:
        outside = sorted(set(inputs.frames) - have)
        if outside:
            raise InputError(
                "--frames",
                expected=f"frames that capture {capture.name} has",
                received=", ".join(map(str, outside[:_NAMED])),
            )
        return tuple(sorted(inputs.frames))
    # Frames of scans are registered even outside the split, because the scan itself is then asked for.
    split = {*splits.train_frames, *splits.novel_pose_frames}
    frames = tuple(sorted(frame for frame in have if frame in split or frame in scans))
    if not frames:
        raise InputError(
            f"capture {capture.name}",
            expected="frames with images, or scans",
            received="none",
            remedy="see docs/captures.md for where they are looked for",
        )
    return frames


def _refuse_nothing(capture: Capture) -> None:
    """Say that there is nothing to register to."""
    alone = [name for name in ("keypoints", "annots") if (capture.root / name).is_dir()]
    if alone:
        raise InputError(
            f"capture {capture.name}",
            expected="cameras for its keypoints",
            received=f"a folder {alone[0]} and no calibration",
            remedy="give cameras.json or calibration.csv: points in images say nothing without their cameras",
        )
    raise InputError(
        f"capture {capture.name}",
        expected="cameras with keypoints, masks or label maps, or a scan",
        received="neither cameras nor scans",
        remedy="see docs/registration.md for what goes in",
    )


def _maps(capture: Capture, cameras: tuple[str, ...], kind: str) -> ViewMaps | None:
    rows = [name in cameras for name in capture.cameras]
    return ViewMaps(capture, cameras, kind) if capture.presence(kind)[rows].any() else None


def _initial(capture: Capture, frames: tuple[int, ...], body: BodyModel) -> tuple[BodyParams | None, list[str]]:
    """The fit to start from, a row a frame; a frame without one starts from its nearest neighbour's.

    Raises:
        InputError: no frame's fit can be read, or one of another body.
    """
    # Captures without any parameter file start from keypoints or landmarks.
    if capture.recording.params is None:
        return None, []
    known: dict[int, BodyParams] = {}
    errors: dict[int, InputError] = {}
    for frame in frames:
        try:
            params = capture.params(frame)
        except InputError as error:
            errors[frame] = error
            continue
        if params is not None:
            known[frame] = params
    if not known:
        if errors:
            raise next(iter(errors.values()))
        return None, [f"none of the {len(frames)} frames has a fit to start from"]
    # One check suffices, because all frames' parameters come from one file or folder.
    _check_body(next(iter(known.values())), body, f"capture {capture.name}")
    # Motion between neighbouring frames is small, so that the nearest frame in time is the best start.
    have = np.array(sorted(known))
    nearest = [int(have[np.abs(have - frame).argmin()]) for frame in frames]
    notes = [
        f"frame {frame}: no fit to start from, that of frame {other} is taken"
        + (f": {errors[frame]}" if frame in errors else "")
        for frame, other in zip(frames, nearest, strict=True)
        if frame != other
    ]
    return BodyParams.concatenate([known[frame] for frame in nearest]), notes


def _check_body(params: BodyParams, body: BodyModel, source: str) -> None:
    """Refuse parameters that another body file was fitted with, by its name."""
    # A forward pass compares the number of joints, betas and expressions with the model's arrays.
    try:
        body.forward(params)
    except InputError as error:
        raise InputError(
            f"{source}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=f"name the body file that the fit is for with --body ({error.remedy})",
        ) from None
