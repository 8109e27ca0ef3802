"""Perceptual metrics by the name that an option gives them."""

from __future__ import annotations

import logging
from typing import Literal, get_args

from avatar.losses.perceptual import PerceptualDistance, load_lpips, load_st_lpips
from smplxpp.core.errors import InputError, MissingExtraError

log = logging.getLogger(__name__)
MetricName = Literal["st-lpips", "lpips", "none"]


def load_metric(name: str, *, device: str = "cpu") -> PerceptualDistance | None:
    """The metric of a name; None for "none", and where its package is not installed, which is logged.

    Raises:
        InputError: another name.
    """
    if name not in get_args(MetricName):
        raise InputError("perceptual metric", expected=f"one of {', '.join(get_args(MetricName))}", received=name)
    if name == "none":
        return None
    try:
        metric = load_st_lpips() if name == "st-lpips" else load_lpips()
    except MissingExtraError as error:
        log.warning("no perceptual distance is measured: %s", error)
        return None
    return metric.to(device)
