"""Tell OpenPose's BODY_25 from BODY_25B, which have equally many points, by the sizes of face and limbs.

BODY_25 has the face at 0 and 15 to 18, BODY_25B at 0 to 4. Read in the wrong order, "eyes and ears" are ankles and
neck, and a "shin" leads from a wrist to a hip: face and limbs become too long. Point 8 of BODY_25 is the middle of the
hips 9 and 12, in BODY_25B an elbow.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

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
_MOST_PEOPLE = 400  # people that are looked at; the median over them decides

Body25 = Literal["openpose", "openpose-25b", "unclear", "none"]
"""The order of 25 points: the name of its format; "unclear" where both orders make people of like sizes; "none" without
people of whom enough is seen."""


def body_25_order(people: Iterable[Any]) -> Body25:
    """Tell the order of lists of 25 points of u, v, confidence.

    Args:
        people: `pose_keypoints_2d` of people in any views and frames; lists of another length are ignored.
    """
    ratios: list[float] = []
    for numbers in people:
        points = np.asarray(numbers, dtype=np.float64).reshape(-1)
        if points.size != 75 or not np.isfinite(points).all():
            continue
        ratio = _size_ratio(points.reshape(25, 3))
        if ratio is not None:
            ratios.append(ratio)
        if len(ratios) >= _MOST_PEOPLE:
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
