"""Motions made ready for a player: another frame rate, and poses held within what training saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar.runtime.bundle import AvatarBundle
from smplxpp.body.pose_range import PoseRange
from smplxpp.cloth.poses import pose_between
from smplxpp.core.params import BodyParams
from smplxpp.core.validation import require_positive

_SECOND = 1e-9


def resampled(params: BodyParams, fps: float, *, source_fps: float | None = None) -> BodyParams:
    """Return a motion at another rate, every joint turned along the shortest way between two poses (slerp).

    Two vectors of one rotation, such as those of either hemisphere of quaternions, are one pose here: nothing spins.

    Args:
        fps: frames a second of the result. source_fps: of `params`; None: as they say.

    Raises:
        InputError: no positive rate.
    """
    rate = source_fps or params.fps or 0.0
    for name, value in (("frames a second", fps), ("frames a second of the motion", rate)):
        require_positive(name, value)
    last = len(params) - 1
    frames = []
    for k in range(int(np.floor(last / rate * fps + _SECOND)) + 1):
        at = min(k * rate / fps, float(last))
        low = min(int(at), max(last - 1, 0))
        high = min(low + 1, last)
        frames.append(pose_between(params.frame(low), params.frame(high), at - low))
    return replace(BodyParams.concatenate([replace(one, fps=None) for one in frames]), fps=fps)


def pose_range(bundle: AvatarBundle) -> PoseRange | None:
    """Return the range of the poses that a bundle knows; None where it knows none."""
    known = bundle.tensors.get("poses.known")
    return None if known is None else PoseRange.of(known)
