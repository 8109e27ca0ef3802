"""Landmarks that a hand can place on a scan, and which of them lie within a limb."""

from __future__ import annotations

_OF_SIDES = (
    "shoulder",
    "elbow",
    "wrist",
    "hip",
    "knee",
    "ankle",
    "heel",
    "big_toe",
    "index_tip",
    "thumb_tip",
    "ear",
)
_WITHIN = {"shoulder", "elbow", "wrist", "hip", "knee", "ankle"}
CHOICE: tuple[str, ...] = (
    "nose",
    "neck",
    "pelvis",
    *(f"{side}_{part}" for part in _OF_SIDES for side in ("left", "right")),
)
"""In the order in which they help most: face and trunk say where the front is, limbs follow."""


def lies_within(name: str) -> bool:
    """Whether a landmark is a joint's centre, within the limb, and no point of the skin."""
    return name in ("neck", "pelvis") or name.removeprefix("left_").removeprefix("right_") in _WITHIN
