"""MediaPipe's pose, hands and face with the weights that lie inside its wheel; nothing is fetched.

`mediapipe` 0.10.14 to 0.10.21 carries the `full` pose model (complexity 1) and what hands and face need. Its `lite` and
`heavy` models would be downloaded at first use and are not offered.
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

from smplxpp.body.keypoint_names import FACE, LEFT_HAND, MEDIAPIPE_FACE, MEDIAPIPE_POSE, RIGHT_HAND
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.validation import require_between
from smplxpp.detect.detector import SURE, Box, DetectedPerson, grown, inside, surest_first

# Side of the square that MediaPipe looks for people in, pixels; in an image below it nothing is worth looking for.
_LEAST_SIDE = 16
# What is added about a box, and about a person who is painted over to find the next, as a share of the longer side.
_MARGIN, _COVER = 0.15, 0.08
_WRISTS = {"left_hand": 15, "right_hand": 16}
_NOSE, _EYES, _EARS, _MOUTH = 0, [2, 5], (7, 8), [9, 10]
# Distance of the ears, in that of eyes and mouth, from which a head that shows its back is not one in profile.
_BEHIND = 0.3
# Share of somebody's points that may lie where somebody else was painted over.
_IMAGINED = 0.5
_STDERR = 2
# Raised when the same answer of MediaPipe is read otherwise, so that what was kept is detected anew.
_RULES = 3


@dataclass(frozen=True)
class MediaPipeConfig:
    """How MediaPipe looks.

    Attributes:
        least_confidence: of its first look at where a person is, and of the pose it then finds.
        most_people: that are looked for, one after the other; MediaPipe itself knows one alone. From two on, the second
            is told of and whoever is surest can be chosen.
    """

    least_confidence: float = 0.5
    most_people: int = 2

    def __post_init__(self) -> None:
        require_between("least_confidence", self.least_confidence, 0.0, 1.0)
        require_between("most_people", self.most_people, 1, 8)


class MediaPipeDetector:
    """Body (as COCO's annotators set it), feet, hands, brows, eyes, nose and lips of `mediapipe`'s holistic solution.

    MediaPipe's visibility is the confidence. Points of a hand have that of the wrist, those of the face that of the
    nose: MediaPipe gives none of their own. What it imagines outside of the image has 0.

    Raises:
        MissingExtraError: mediapipe is not installed.
        InputError: a mediapipe without weights, as later versions are.
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
        self.identity = f"mediapipe {package.__version__} holistic full, rules {_RULES}, {self.config}"
        named = (*MEDIAPIPE_POSE, *LEFT_HAND, *RIGHT_HAND, *FACE)
        self._kept = [k for k, name in enumerate(named) if name is not None]
        self.names = tuple(name for name in named if name is not None)

    def __call__(self, image: UInt8[np.ndarray, "H W 3"], box: Box | None = None) -> list[DetectedPerson]:
        """The people in an sRGB image, the surest first."""
        height, width = image.shape[:2]
        x0, y0, x1, y1 = 0, 0, width, height
        if box is not None:
            x0, y0, x1, y1 = (round(edge) for edge in grown(box, _MARGIN, (width, height)))
        if min(x1 - x0, y1 - y0) < _LEAST_SIDE:
            return []
        seen = np.ascontiguousarray(image[y0:y1, x0:x1])
        people: list[DetectedPerson] = []
        covered: list[Box] = []
        while len(people) < self.config.most_people:
            found = self._one(seen)
            if found is None or found.confidence.max() < SURE or _imagined(found, covered):
                break
            people.append(found)
            if len(people) < self.config.most_people:
                covered.append(grown(found.box, _COVER, (seen.shape[1], seen.shape[0])))
                seen = _without(seen, covered[-1])
        shift = np.array([x0, y0], dtype=np.float64)
        return surest_first(
            [DetectedPerson(np.where(p.confidence[:, None] > 0, p.points + shift, 0.0), p.confidence) for p in people]
        )

    def _one(self, image: UInt8[np.ndarray, "H W 3"]) -> DetectedPerson | None:
        """The person MediaPipe finds, None where it finds nobody."""
        with quiet():
            result = self._graph.process(image)
        pose = _rows(result.pose_landmarks)
        if pose is None:
            return None
        parts = [pose]
        for name, count in (("left_hand", len(LEFT_HAND)), ("right_hand", len(RIGHT_HAND))):
            hand = _rows(getattr(result, f"{name}_landmarks"))
            parts.append(np.zeros((count, 3)) if hand is None else _seen_as(hand, pose[_WRISTS[name], 2]))
        face = _rows(result.face_landmarks)
        if face is not None and _from_behind(pose[:, :2] * (image.shape[1], image.shape[0])):
            face = None  # it sees faces in hair
        if face is not None:
            face = _seen_as(np.stack([face[list(own)].mean(axis=0) for own in MEDIAPIPE_FACE]), pose[_NOSE, 2])
        parts.append(np.zeros((len(FACE), 3)) if face is None else face)
        rows = np.concatenate(parts)[self._kept]
        size = image.shape[1], image.shape[0]
        points = rows[:, :2] * size
        confidence = np.where(inside(points, size), np.clip(rows[:, 2], 0.0, 1.0), 0.0)
        return DetectedPerson(np.where(confidence[:, None] > 0, points, 0.0), confidence)


def mediapipe_package(purpose: str) -> Any:
    """The package with its weights.

    Raises:
        MissingExtraError: not installed.
        InputError: a version whose wheel has no weights.
    """
    try:
        with quiet():
            import mediapipe
    except ImportError as error:
        if error.name not in (None, "mediapipe"):
            raise MissingExtraError(f"mediapipe with {error.name}", extra="detect", purpose=purpose) from None
        raise MissingExtraError("mediapipe", extra="detect", purpose=purpose) from None
    if not hasattr(mediapipe, "solutions"):
        raise InputError(
            "mediapipe",
            expected="a version from 0.10.14 to 0.10.21, whose wheel has the models",
            received=str(getattr(mediapipe, "__version__", "another")),
            remedy="pip install 'smplxpp[detect]'",
        )
    return mediapipe


@contextmanager
def quiet() -> Iterator[None]:
    """Without the warnings of MediaPipe's own code about the versions of what it uses."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def silent_start() -> Iterator[None]:
    """Without what MediaPipe's native code writes to the standard error while it loads its models: a dozen lines about
    delegates and signatures that no setting turns off. A failure is raised all the same."""
    sys.stderr.flush()
    kept = os.dup(_STDERR)
    try:
        with tempfile.TemporaryFile() as nowhere:
            os.dup2(nowhere.fileno(), _STDERR)
        yield
    finally:
        os.dup2(kept, _STDERR)
        os.close(kept)


def _rows(landmarks: Any) -> Float64[np.ndarray, "N 3"] | None:
    """Shares of the width and the height, and visibility."""
    if landmarks is None:
        return None
    return np.array([(one.x, one.y, one.visibility) for one in landmarks.landmark], dtype=np.float64)


def _from_behind(pose: Float64[np.ndarray, "N 2"]) -> bool:
    """Whether a head, in pixels, shows its back: with its eyes above its mouth the left ear is on the left."""
    across = pose[_EARS[0]] - pose[_EARS[1]]
    up = pose[_EYES].mean(axis=0) - pose[_MOUTH].mean(axis=0)
    return bool(across[0] * up[1] - across[1] * up[0] > _BEHIND * (up @ up))


def _seen_as(rows: Float64[np.ndarray, "N 3"], visibility: float) -> Float64[np.ndarray, "N 3"]:
    """The same points with the visibility of another."""
    return np.column_stack([rows[:, :2], np.full(len(rows), visibility)])


def _imagined(person: DetectedPerson, covered: Sequence[Box]) -> bool:
    """Whether half of somebody's sure points lie where others were painted over: there is nothing to see there."""
    points = person.points[person.confidence >= SURE]
    return any(((points >= box[:2]) & (points <= box[2:])).all(axis=1).mean() > _IMAGINED for box in covered)


def _without(image: UInt8[np.ndarray, "H W 3"], box: Box) -> UInt8[np.ndarray, "H W 3"]:
    """The image with a person's box painted over, so that the next one is found."""
    x0, y0, x1, y1 = (round(edge) for edge in box)
    out = image.copy()
    out[y0:y1, x0:x1] = np.median(image.reshape(-1, 3), axis=0)
    return out
