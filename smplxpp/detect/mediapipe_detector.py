"""Detect keypoints and masks of people with MediaPipe and the weights inside its wheel, without any download.

`mediapipe` 0.10.14 to 0.10.21 contains the `full` pose model (complexity 1) and the models of hands and face. Its
`lite` and `heavy` models would be downloaded at first use and are not offered.
"""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from smplxpp.body.layout import FACE, LEFT_HAND, MEDIAPIPE_FACE, MEDIAPIPE_POSE, RIGHT_HAND
from smplxpp.core import InputError, require_between
from smplxpp.core.lazy import import_extra
from smplxpp.detect.detector import RELIABLE, Box, DetectedPerson, grown, inside, most_confident_first
from smplxpp.detect.plates import cleaned

# Smallest side of an image in which people are searched for, pixels.
_LEAST_SIDE = 16
# Indices of MediaPipe's pose: the wrists that give the points of a hand their confidence, and points of the head.
_WRISTS = {"left_hand": 15, "right_hand": 16}
_NOSE, _EYES, _EARS, _MOUTH = 0, [2, 5], (7, 8), [9, 10]


@dataclass(frozen=True)
class MediaPipeConfig:
    """Options of MediaPipe's detector.

    Attributes:
        least_confidence: threshold of its person detector and of the pose that it then finds.
        most_people: number of people that are searched for, one after the other, because MediaPipe itself finds only
            one. From two on, a second person is reported and the most confident one can be chosen.
    """

    least_confidence: float = 0.5
    most_people: int = 2

    def __post_init__(self) -> None:
        require_between("least_confidence", self.least_confidence, 0.0, 1.0)
        require_between("most_people", self.most_people, 1, 8)


class MediaPipeDetector:
    """Detector of body (with COCO's conventions), feet, hands, brows, eyes, nose and lips by MediaPipe Holistic.

    The confidence is MediaPipe's visibility. Points of a hand have that of the wrist and points of the face that of the
    nose, because MediaPipe gives them none. Points that it extrapolates outside the image have 0.

    Raises:
        MissingExtraError: mediapipe is not installed.
        InputError: a version of mediapipe without weights in its wheel.
    """

    def __init__(self, config: MediaPipeConfig | None = None) -> None:
        self.config = config or MediaPipeConfig()
        package = mediapipe_package("detection of keypoints")
        with quiet(), silent_start():
            self._graph = package.solutions.holistic.Holistic(
                static_image_mode=True,
                model_complexity=1,
                refine_face_landmarks=True,
                min_detection_confidence=self.config.least_confidence,
                min_tracking_confidence=self.config.least_confidence,
            )
            self._graph.process(np.zeros((_LEAST_SIDE, _LEAST_SIDE, 3), dtype=np.uint8))
        rules = 3  # to be raised when MediaPipe's answer is interpreted differently, so that stored points are redone
        self.identity = f"mediapipe {package.__version__} holistic full, rules {rules}, {self.config}"
        named = (*MEDIAPIPE_POSE, *LEFT_HAND, *RIGHT_HAND, *FACE)
        self._kept = [k for k, name in enumerate(named) if name is not None]
        self.names = tuple(name for name in named if name is not None)

    def __call__(self, image: UInt8[np.ndarray, "H W 3"], box: Box | None = None) -> list[DetectedPerson]:
        """Return the people in an sRGB image, most confident first."""
        # Crop to the box with 15 % of margin, which the person detector needs around a person.
        height, width = image.shape[:2]
        x0, y0, x1, y1 = 0, 0, width, height
        if box is not None:
            x0, y0, x1, y1 = (round(edge) for edge in grown(box, 0.15, (width, height)))
        if min(x1 - x0, y1 - y0) < _LEAST_SIDE:
            return []
        seen = np.ascontiguousarray(image[y0:y1, x0:x1])
        # Find a person, paint over the person's box with 8 % of margin, and search again.
        people: list[DetectedPerson] = []
        covered: list[Box] = []
        while len(people) < self.config.most_people:
            found = self._one(seen)
            if found is None or found.confidence.max() < RELIABLE or _imagined(found, covered):
                break
            people.append(found)
            if len(people) < self.config.most_people:
                covered.append(grown(found.box, 0.08, (seen.shape[1], seen.shape[0])))
                seen = _without(seen, covered[-1])
        shift = np.array([x0, y0], dtype=np.float64)
        return most_confident_first(
            [DetectedPerson(np.where(p.confidence[:, None] > 0, p.points + shift, 0.0), p.confidence) for p in people]
        )

    def _one(self, image: UInt8[np.ndarray, "H W 3"]) -> DetectedPerson | None:
        """Return the person that MediaPipe finds; None if it finds none."""
        with quiet():
            result = self._graph.process(image)
        pose = _rows(result.pose_landmarks)
        if pose is None:
            return None
        # Body, hands and face in the order of the names; parts that were not found are zero.
        parts = [pose]
        for name, count in (("left_hand", len(LEFT_HAND)), ("right_hand", len(RIGHT_HAND))):
            hand = _rows(getattr(result, f"{name}_landmarks"))
            parts.append(np.zeros((count, 3)) if hand is None else _seen_as(hand, pose[_WRISTS[name], 2]))
        face = _rows(result.face_landmarks)
        if face is not None and _from_behind(pose[:, :2] * (image.shape[1], image.shape[0])):
            face = None  # MediaPipe finds faces in the hair of a head seen from behind
        if face is not None:
            face = _seen_as(np.stack([face[list(own)].mean(axis=0) for own in MEDIAPIPE_FACE]), pose[_NOSE, 2])
        parts.append(np.zeros((len(FACE), 3)) if face is None else face)
        # Shares of the image to pixels; points outside the image lose their confidence.
        rows = np.concatenate(parts)[self._kept]
        size = image.shape[1], image.shape[0]
        points = rows[:, :2] * size
        confidence = np.where(inside(points, size), np.clip(rows[:, 2], 0.0, 1.0), 0.0)
        return DetectedPerson(np.where(confidence[:, None] > 0, points, 0.0), confidence)


class PersonSegmenter:
    """Segmenter of people by MediaPipe's pose model, or by its selfie segmentation where no pose is found.

    The mask of the pose model covers a square around the person and is better for standing people. The selfie
    segmentation covers the whole image and serves close-ups. Both have at most 256 pixels a side, so the masks are
    rough.

    Raises:
        MissingExtraError: mediapipe is not installed.
        InputError: a version of mediapipe without weights in its wheel.
    """

    def __init__(self) -> None:
        package = mediapipe_package("segmentation of people")
        solutions = package.solutions
        with quiet(), silent_start():
            self._pose = solutions.pose.Pose(static_image_mode=True, model_complexity=1, enable_segmentation=True)
            self._selfie = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
            for graph in (self._pose, self._selfie):
                graph.process(np.zeros((_LEAST_SIDE, _LEAST_SIDE, 3), dtype=np.uint8))
        self.identity = f"mediapipe {package.__version__} segmentation"

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        """Return the opacity of the person in an sRGB image; 0 where there is none."""
        image = np.ascontiguousarray(image)
        with quiet():
            matte = self._pose.process(image).segmentation_mask
            if matte is None:
                matte = self._selfie.process(image).segmentation_mask
        matte = np.asarray(matte, dtype=np.float32)
        matte = matte * cleaned(matte > 0.5)
        return np.round(255.0 * np.clip(matte, 0.0, 1.0)).astype(np.uint8)


def mediapipe_package(purpose: str) -> Any:
    """Import mediapipe and check that its wheel has the weights.

    Raises:
        MissingExtraError: not installed, or it does not start.
        InputError: a version whose wheel has no weights.
    """
    with quiet():
        mediapipe = import_extra("mediapipe", extra="detect", purpose=purpose)
    if not hasattr(mediapipe, "solutions"):
        raise InputError(
            "mediapipe",
            expected="a version from 0.10.14 to 0.10.21, whose wheel has the models",
            received=str(getattr(mediapipe, "__version__", "another")),
            remedy="pip install 'mediapipe>=0.10.14,<=0.10.21'",
        )
    return mediapipe


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the warnings of MediaPipe's own code about versions of its dependencies."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def silent_start() -> Iterator[None]:
    """Suppress what MediaPipe's native code writes to the standard error while it loads models.

    It writes a dozen lines about delegates and signatures that no setting turns off. Failures are still raised.
    """
    stderr = 2  # file descriptor
    sys.stderr.flush()
    kept = os.dup(stderr)
    try:
        with tempfile.TemporaryFile() as nowhere:
            os.dup2(nowhere.fileno(), stderr)
        yield
    finally:
        os.dup2(kept, stderr)
        os.close(kept)


def _rows(landmarks: Any) -> Float64[np.ndarray, "N 3"] | None:
    """Return x and y as shares of width and height, and the visibility; None for no landmarks."""
    if landmarks is None:
        return None
    return np.array([(one.x, one.y, one.visibility) for one in landmarks.landmark], dtype=np.float64)


def _from_behind(pose: Float64[np.ndarray, "N 2"]) -> bool:
    """Return whether a head is seen from behind: with its eyes above its mouth, the left ear is on the left.

    The distance of the ears must exceed 0.3 of that between eyes and mouth, since heads in profile have both ears near.
    """
    across = pose[_EARS[0]] - pose[_EARS[1]]
    up = pose[_EYES].mean(axis=0) - pose[_MOUTH].mean(axis=0)
    return bool(across[0] * up[1] - across[1] * up[0] > 0.3 * (up @ up))


def _seen_as(rows: Float64[np.ndarray, "N 3"], visibility: float) -> Float64[np.ndarray, "N 3"]:
    """Replace the visibility of points by that of another point."""
    return np.column_stack([rows[:, :2], np.full(len(rows), visibility)])


def _imagined(person: DetectedPerson, covered: Sequence[Box]) -> bool:
    """Return whether over half of a person's reliable points lie where others were painted over."""
    points = person.points[person.confidence >= RELIABLE]
    return any(((points >= box[:2]) & (points <= box[2:])).all(axis=1).mean() > 0.5 for box in covered)


def _without(image: UInt8[np.ndarray, "H W 3"], box: Box) -> UInt8[np.ndarray, "H W 3"]:
    """Paint over a person's box with the median colour, so that the next person is found."""
    x0, y0, x1, y1 = (round(edge) for edge in box)
    out = image.copy()
    out[y0:y1, x0:x1] = np.median(image.reshape(-1, 3), axis=0)
    return out
