"""What loose clothes follow of a motion that is known whole: smoothed, with poses in between where they are rare."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

import numpy as np

from smplxpp.cloth.driver import DriverConfig
from smplxpp.cloth.poses import resampled, smoothed
from smplxpp.core import BodyParams, require_positive

SLOWEST = 40.0
"""Poses a second at least that clothes follow: places that go straight from pose to pose cut the corners of limbs."""
SMOOTHING = 0.03
"""Standard deviation of the Gaussian in time, seconds: trackers shake waistbands."""


def followed(poses: BodyParams, fps: float, *, smoothing: float = SMOOTHING) -> tuple[BodyParams, int]:
    """Return an even motion without leaps as clothes follow it, and how many of its poses a frame has.

    Frame k is pose k times that number.

    Args:
        poses: T frames.
        fps: of them.
        smoothing: seconds; 0: none.
    """
    poses = smoothed(poses, radius=smoothing * fps)
    times, last = max(1, ceil(SLOWEST / fps - 1e-6)), len(poses) - 1
    if times > 1:
        steps = np.arange(times * last + 1.0) / times
        poses = resampled(poses, np.arange(last + 1.0), np.minimum(steps, last))
    return poses, times


def ways(
    params: BodyParams, fps: float, *, smoothing: float = SMOOTHING, leap: float = DriverConfig.teleport
) -> Iterator[list[BodyParams]]:
    """Yield for every frame the poses that lead to it from the one before, even in time, it (smoothed) the last.

    Args:
        params: T frames, evenly spaced.
        fps: of them.
        smoothing: seconds; 0: none.
        leap: metres a second of the root; what is faster is a cut, over which nothing is smoothed.

    Raises:
        InputError: no frames a second.
    """
    require_positive("frames a second", fps)
    speeds = fps * np.linalg.norm(np.diff(params.transl, axis=0), axis=1)
    for stretch in np.split(np.arange(len(params)), np.flatnonzero(speeds > leap) + 1):
        poses, times = followed(params.select(stretch), fps, smoothing=smoothing)
        yield [poses.frame(0)]
        for k in range(times, len(poses), times):
            yield [poses.frame(at) for at in range(k - times + 1, k + 1)]
