"""Read the people that a detector found in one image, with points named as in `Keypoints2D`.

OpenPose, EasyMocap, COCO and mmpose put pixel centres at whole numbers, this project at +0.5, so that half a pixel is
added.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from smplxpp.body.layout import (
    BODY_25B,
    BY_COUNT,
    FACE,
    FACE_68,
    FACE_70,
    LEFT_HAND,
    MEDIAPIPE_FACE,
    MEDIAPIPE_POSE,
    RIGHT_HAND,
    Order,
)
from smplxpp.core.errors import InputError

_FACE_25, _FACE_25B = (0, 15, 16, 17, 18), (0, 1, 2, 3, 4)
# Upper arms, forearms, thighs, shins.
_LIMBS_25 = ((2, 3), (5, 6), (3, 4), (6, 7), (9, 10), (12, 13), (10, 11), (13, 14))
_LIMBS_25B = ((5, 7), (6, 8), (7, 9), (8, 10), (11, 13), (12, 14), (13, 15), (14, 16))
_MIDDLE, _HIPS = 8, [9, 12]
# Distance of the middle from the hips' middle that tells nothing, a share of the person's box: BODY_25 has 0.01 to
# 0.03, BODY_25B mostly 0.2 to 0.5. It counts at most as much as a factor of e^1.5 in size.
_MIDWAY, _MOST_EVIDENCE = 0.08, 1.5
# The wrong order makes the face 3 to 15 times as wide, and limbs about twice as long; below this factor of the sizes
# nothing is decided.
_DECISIVE = 1.3
# Points of a face and limbs that have to be seen, and confidence from which a point counts.
_LEAST_POINTS, _LEAST_LIMBS, _LEAST_CONFIDENCE = 3, 4, 0.05

Body25 = Literal["openpose", "openpose-25b", "unclear", "none"]
"""The order of 25 points: the name of its format; "unclear" where both orders make people of like sizes; "none" without
people of whom enough is seen."""


def body_25_order(people: Iterable[Any]) -> Body25:
    """Tell OpenPose's BODY_25 from BODY_25B, which have equally many points, by the sizes of face and limbs.

    BODY_25 has the face at 0 and 15 to 18, BODY_25B at 0 to 4. Read in the wrong order, "eyes and ears" are ankles and
    neck, and a "shin" leads from a wrist to a hip: face and limbs become too long. Point 8 of BODY_25 is the middle of
    the hips 9 and 12, in BODY_25B an elbow.

    Args:
        people: `pose_keypoints_2d` (25 points of u, v, confidence) of people in any views and frames; lists of another
            length are ignored.
    """
    ratios: list[float] = []
    # People that are looked at; the median over them decides.
    most_people = 400
    for numbers in people:
        points = np.asarray(numbers, dtype=np.float64).reshape(-1)
        if points.size != 75 or not np.isfinite(points).all():
            continue
        ratio = _size_ratio(points.reshape(25, 3))
        if ratio is not None:
            ratios.append(ratio)
        if len(ratios) >= most_people:
            break
    if not ratios:
        return "none"
    middle = float(np.median(ratios))
    if 1 / _DECISIVE < middle < _DECISIVE:
        return "unclear"
    return "openpose" if middle < 1 else "openpose-25b"


def _size_ratio(points: np.ndarray) -> float | None:
    """Return how much larger a person's parts are as BODY_25 than as BODY_25B; None where too little is seen.

    It is the geometric mean of what face, limbs and hips tell, because hands near a face or hidden legs make one of
    them unsure.
    """
    seen = np.where(points[:, 2:] > _LEAST_CONFIDENCE, points[:, :2], np.nan)
    ratios = []
    faces = _spread(seen, _FACE_25), _spread(seen, _FACE_25B)
    limbs = _limb(seen, _LIMBS_25), _limb(seen, _LIMBS_25B)
    for sizes in (faces, limbs):
        if min(sizes) > 0:
            ratios.append(np.log(sizes[0] / sizes[1]))
    off, box = np.linalg.norm(seen[_MIDDLE] - seen[_HIPS].mean(axis=0)), _spread(seen, tuple(range(25)))
    if np.isfinite(off) and box > 0:
        ratios.append(np.clip(np.log(max(float(off) / box, 1e-6) / _MIDWAY), -_MOST_EVIDENCE, _MOST_EVIDENCE))
    return float(np.exp(np.mean(ratios))) if ratios else None


def _spread(seen: np.ndarray, rows: tuple[int, ...]) -> float:
    """Return the longer side of the box around the seen points; 0 where too few are seen."""
    known = seen[list(rows)]
    known = known[np.isfinite(known[:, 0])]
    return float(np.ptp(known, axis=0).max()) if len(known) >= _LEAST_POINTS else 0.0


def _limb(seen: np.ndarray, bones: tuple[tuple[int, int], ...]) -> float:
    """Return the mean length of the seen bones; 0 where too few are seen."""
    lengths = np.linalg.norm(np.diff(seen[np.array(bones)], axis=1)[:, 0], axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(lengths.mean()) if len(lengths) >= _LEAST_LIMBS else 0.0


_HALF = 0.5  # pixels between the two conventions of pixel centres
# Keys of hands and face in OpenPose's and EasyMocap's files, with the orders of points by their number.
_FACES = {len(order): order for order in (FACE_68, FACE_70)} | {len(FACE): FACE}
_OPENPOSE = {
    "hand_left_keypoints_2d": {21: LEFT_HAND},
    "hand_right_keypoints_2d": {21: RIGHT_HAND},
    "face_keypoints_2d": _FACES,
}
_EASYMOCAP = {"handl2d": {21: LEFT_HAND}, "handr2d": {21: RIGHT_HAND}, "face2d": _FACES}
_HOLISTIC = ("pose", "face", "left_hand", "right_hand")


@dataclass(frozen=True, eq=False)
class Person:
    """Points of one person in one image: u, v in pixels (centres at +0.5) and confidence, 0 for missing points."""

    points: Mapping[str, Float64[np.ndarray, " 3"]]
    id: int | None = None

    @property
    def confidence(self) -> float:
        """Sum of the confidences of all points."""
        return float(sum(point[2] for point in self.points.values()))


def chosen_person(people: Sequence[Person], person: int | None) -> Person | None:
    """Return the person with the id `person` (index, if the file has no ids); None: the one of most confidence."""
    if person is None:
        return max(people, key=lambda one: one.confidence, default=None)
    ids = [one.id if one.id is not None else place for place, one in enumerate(people)]
    return people[ids.index(person)] if person in ids else None


def openpose_people(content: Any, *, body_25b: bool, source: str) -> list[Person]:
    """Read `people` of OpenPose's JSON: BODY_25, or BODY_25B, or BODY_135 as one list; hands and face beside it."""
    people = []
    for one in content["people"]:
        # OpenPose puts pixel centres at whole numbers, and this package at +0.5.
        points = _named(one["pose_keypoints_2d"], _with_25b(body_25b), source=source, shift=_HALF)
        for key, orders in _OPENPOSE.items():
            if one.get(key):
                points |= _named(one[key], orders, source=f"{source}: {key}", shift=_HALF)
        # OpenPose writes person_id as [-1] where it does not track.
        number = int(np.ravel(one.get("person_id", -1))[0])
        people.append(Person(points, number if number >= 0 else None))
    return people


def easymocap_people(content: Any, *, body_25b: bool, source: str) -> list[Person]:
    """Read the annotations of EasyMocap's JSON: `keypoints`, `handl2d`, `handr2d`, `face2d` and `personID`."""
    people = []
    for one in content["annots"] if isinstance(content, Mapping) else content:
        body = one.get("keypoints", one.get("keypoints2d", []))
        points = _named(body, _with_25b(body_25b), source=source, shift=_HALF) if len(body) else {}
        for key, orders in _EASYMOCAP.items():
            if one.get(key):
                points |= _named(one[key], orders, source=f"{source}: {key}", shift=_HALF)
        number = one.get("personID", one.get("id"))
        people.append(Person(points, None if number is None else int(number)))
    return people


def mmpose_people(instances: Any, *, source: str) -> list[Person]:
    """Read `instances` of mmpose: `keypoints` [[u, v], ...] and `keypoint_scores`."""
    people = []
    for one in instances:
        # (K, 2) pixels and (K, 1) scores, in the order that the number of points tells.
        uv = np.asarray(one["keypoints"], dtype=np.float64).reshape(-1, 2)
        scores = np.asarray(one["keypoint_scores"], dtype=np.float64).reshape(-1, 1)
        track = one.get("track_id")
        rows = np.concatenate([uv, scores], axis=1)
        people.append(Person(_named(rows, BY_COUNT, source=source, shift=_HALF), None if track is None else int(track)))
    return people


def coco_person(entry: Any, *, source: str) -> Person:
    # COCO-WholeBody keeps body, feet, face and hands in lists of their own.
    """Read one entry of COCO's list of results: `keypoints` [u, v, score, ...]; COCO-WholeBody's four further lists."""
    points = _named(entry["keypoints"], BY_COUNT, source=source, shift=_HALF)
    parts = {
        "foot_kpts": {6: BY_COUNT[133][17:23]},
        "face_kpts": {68: FACE_68},
        "lefthand_kpts": {21: LEFT_HAND},
        "righthand_kpts": {21: RIGHT_HAND},
    }
    for key, orders in parts.items():
        if entry.get(key):
            points |= _named(entry[key], orders, source=f"{source}: {key}", shift=_HALF)
    return Person(points)


def mediapipe_person(
    parts: Mapping[str, Any], *, size: tuple[int, int] | None, normalised: bool | None, source: str
) -> Person:
    """Read MediaPipe's landmarks of one image.

    Args:
        parts: `pose` (33), `face` (468, or 478 with irises), `left_hand`, `right_hand` (21): each rows of x, y and
            perhaps z, visibility, or objects with these names; None or NaN for undetected parts.
        size: width and height of the image, for normalised coordinates.
        normalised: whether x and y are fractions of the image size; None: decided by their range.
        source: name of the file in messages.
    """
    orders = {"pose": MEDIAPIPE_POSE, "left_hand": LEFT_HAND, "right_hand": RIGHT_HAND}
    points: dict[str, np.ndarray] = {}
    for name in _HOLISTIC:
        rows = landmark_rows(parts.get(name), source=f"{source}: {name}")
        if rows is None:
            continue
        if normalised is None:
            # Normalised coordinates may leave the image by a few sizes; larger ones are pixels.
            seen = rows[rows[:, 2] > 0, :2]
            shares = bool(len(seen)) and float(np.abs(seen).max()) < 4.0
        else:
            shares = normalised
        if shares:
            if size is None:
                raise InputError(
                    source,
                    expected="the images' size, for coordinates that are shares of it",
                    received="none",
                    remedy="give --size WIDTHxHEIGHT, or the capture",
                )
            # Shares of the image's width and height become pixels; they already count from the image's corner, hence
            # no shift.
            rows[:, :2] *= size
        # A face has hundreds of points; the named ones are means of a few of them.
        if name == "face":
            if len(rows) not in (468, 478):
                raise InputError(f"{source}: face", expected="468 or 478 points", received=f"{len(rows)}")
            rows = np.stack([rows[list(own)].mean(axis=0) for own in MEDIAPIPE_FACE])
            points |= _named(rows, {len(FACE): FACE}, source=source)
        else:
            points |= _named(rows, {len(orders[name]): orders[name]}, source=f"{source}: {name}")
    return Person(points)


def landmark_rows(value: Any, *, source: str) -> Float64[np.ndarray, "N 3"] | None:
    """Return rows of x, y, confidence of MediaPipe's landmarks; confidence is the visibility, or 1 without one."""
    # Protobuf's JSON wraps the list in an object.
    if isinstance(value, Mapping):
        value = value.get("landmark", value.get("landmarks"))
    if value is None or not len(value):
        return None
    if isinstance(value[0], Mapping):
        value = [[one["x"], one["y"], 0.0, one.get("visibility") or 1.0] for one in value]
    rows = np.asarray(value, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] < 2:
        raise InputError(source, expected="rows of x, y[, z[, visibility]]", received=f"shape {rows.shape}")
    # Columns are x, y, z, visibility.
    visibility = rows[:, 3] if rows.shape[1] > 3 else np.ones(len(rows))
    # A point with NaN counts as missing, because solvers multiply by the confidence and 0 times NaN is NaN.
    there = np.isfinite(rows[:, :2]).all(axis=1) & np.isfinite(visibility)
    out = np.concatenate([rows[:, :2], visibility[:, None]], axis=1)
    out[~there] = 0.0
    return out


def _with_25b(body_25b: bool) -> dict[int, Order]:
    return {**BY_COUNT, 25: BODY_25B} if body_25b else BY_COUNT


def _named(rows: Any, orders: Mapping[int, Order], *, source: str, shift: float = 0.0) -> dict[str, np.ndarray]:
    """Name the points, and clip confidences to [0, 1] (scores of detectors may slightly exceed 1)."""
    values = np.asarray(rows, dtype=np.float64).reshape(-1, 3)
    if len(values) not in orders:
        counts = " or ".join(str(count) for count in orders)
        raise InputError(
            source,
            expected=f"{counts} points of u, v, confidence",
            received=f"{len(values)} points",
            remedy="name the format, or convert the points to keypoints/CAM.npz by hand (docs/rigs.md)",
        )
    # Copy, because the array may be a view of the caller's content.
    values = values.copy()
    there = np.isfinite(values).all(axis=1) & (values[:, 2] > 0)
    values[:, :2] += shift
    values[:, 2] = np.clip(values[:, 2], 0.0, 1.0)
    # Missing points are all zero, coordinates too, so that they compress and compare well.
    values[~there] = 0.0
    return {name: row for name, row in zip(orders[len(values)], values, strict=True) if name is not None}
