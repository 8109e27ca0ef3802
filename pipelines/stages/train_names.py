"""What the stages of a training and the report on them share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

KINDS = {"novel_view": "held-out views", "novel_pose": "held-out poses"}
"""Kinds of views that a training measures, in words."""


def kind_name(kind: str, *, held_out: bool) -> str:
    """What the views of a kind are to a reader: without held-out cameras they are views that were trained on."""
    return KINDS[kind] if held_out or kind != "novel_view" else "training views"


def spread(values: Sequence, count: int) -> list:
    """At most `count` of the values, evenly from first to last."""
    if not len(values):
        return []
    return [values[k] for k in np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))]


PSNR_FLOORS: dict[str, tuple[float, float]] = {"novel_view": (18.0, 16.0), "novel_pose": (17.0, 15.0)}
"""dB of the person in held-out views of any stage: a warning and a failure below.

A floor, not a mark: decibels fall with the size of the image, with the share of it that is fine pattern and with the
distance of the nearest camera that was trained on, so that one number cannot tell a good training of minutes at 256x320
from a poor one of hours. Below it something is broken. What a stage is worth is for the gates on its gain: over its
start, over its teacher, over the Gaussians of one frame.
"""
