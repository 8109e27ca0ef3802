"""Prepare motions for a player: resample them, and give the range of poses of the training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar.runtime.bundle import AvatarBundle
from smplxpp.body.pose_range import PoseRange
from smplxpp.cloth.poses import pose_between
from smplxpp.core import BodyParams, require_positive


def resampled(params: BodyParams, fps: float, *, source_fps: float | None = None) -> BodyParams:
    """Resample a motion to another frame rate, with spherical linear interpolation (slerp) of every joint.

    Different vectors of one rotation are the same pose, so that a joint never spins between them.

    Args:
        params: the motion.
        fps: frames a second of the result.
        source_fps: frames a second of `params`; None: their own.

    Raises:
        InputError: no positive rate.
    """
    rate = source_fps or params.fps or 0.0
    for name, value in (("frames a second", fps), ("frames a second of the motion", rate)):
        require_positive(name, value)
    # Interpolate between the two neighbouring frames of each new time.
    # The 1e-9 keeps the last frame where the duration is a whole number of new frames up to rounding.
    last = len(params) - 1
    frames = []
    for k in range(int(np.floor(last / rate * fps + 1e-9)) + 1):
        at = min(k * rate / fps, float(last))
        low = min(int(at), max(last - 1, 0))
        high = min(low + 1, last)
        frames.append(pose_between(params.frame(low), params.frame(high), at - low))
    return replace(BodyParams.concatenate([replace(one, fps=None) for one in frames]), fps=fps)


def pose_range(bundle: AvatarBundle) -> PoseRange | None:
    """Return the range of the training's poses in a bundle; None if it stores none."""
    known = bundle.tensors.get("poses.known")
    return None if known is None else PoseRange.of(known)
