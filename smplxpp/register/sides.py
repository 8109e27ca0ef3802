"""Whether all views call the left side right: the person would walk backwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from smplxpp.core.keypoints import Keypoints2D
from smplxpp.register.keypoint_faults import mirror_index

# (behind, before): what points forwards whatever the pose; a side's name is put in for {}.
_FORWARD = (
    ("{}_ankle", "{}_foot"),
    ("{}_heel", "{}_big_toe"),
    ("{}_ankle", "{}_big_toe"),
    ("coco_{}_ankle", "{}_big_toe"),
    ("{}_ear", "nose"),
    ("head", "jaw"),
    ("head", "nose"),
    ("neck", "nose"),
)
_ACROSS = ("{}_hip", "coco_{}_hip", "{}_shoulder", "coco_{}_shoulder")
_ABOVE = (("pelvis", "neck"), ("coco_{}_hip", "coco_{}_shoulder"), ("{}_hip", "{}_shoulder"))
_LEAST_FRAMES_SHARE = 0.9


def sides_are_exchanged(names: Sequence[str], points: Float64[np.ndarray, "T K 3"]) -> bool:
    """Tell whether feet and nose point backwards in nearly all frames in which it can be seen.

    With u upwards along the trunk and a from its right to its left, a body looks along a x u.

    Args:
        points: triangulated, NaN where they are not.
    """
    place = {name: k for k, name in enumerate(names)}

    def vector(start: str, end: str) -> np.ndarray | None:
        if start in place and end in place:
            return points[:, place[end]] - points[:, place[start]]
        return None

    def mean(vectors: list[np.ndarray | None]) -> np.ndarray:
        there = [v for v in vectors if v is not None]
        if not there:
            return np.full((len(points), 3), np.nan)
        stacked = np.stack(there)
        known = np.isfinite(stacked).all(axis=2, keepdims=True)
        return np.where(known, stacked, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)

    across = mean([vector(a.format("right"), a.format("left")) for a in _ACROSS])
    above = mean([vector(a.format(s), b.format(s)) for a, b in _ABOVE for s in ("left", "right")])
    ahead = mean([vector(a.format(s), b.format(s)) for a, b in _FORWARD for s in ("left", "right")])
    with np.errstate(invalid="ignore"):
        along = np.einsum("tx,tx->t", np.cross(across, above), ahead)
    told = along[np.isfinite(along)]
    return len(told) > 0 and float(np.mean(told < 0)) > _LEAST_FRAMES_SHARE


def exchanged(keypoints: Mapping[str, Keypoints2D]) -> dict[str, Keypoints2D]:
    """The keypoints with left and right exchanged in all views; those without another side are left out."""
    out = {}
    for name, one in keypoints.items():
        other = mirror_index(one.names)
        there = np.where(other < 0, 0, other)
        confidence = np.where(other < 0, 0.0, one.confidence[:, there])
        out[name] = replace(one, points=one.points[:, there], confidence=confidence)
    return out
