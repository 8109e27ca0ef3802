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
