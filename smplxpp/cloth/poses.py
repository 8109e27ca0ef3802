"""Poses between poses: ramps of cold starts, and motions smoothed before they shake cloth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from smplxpp.core import POSE_BLOCKS, BodyParams, InputError, require_at_least

# Blocks of axis-angle vectors; hands may be coefficients, which are mixed as numbers.
_ROTATIONS = tuple(name for name, _ in POSE_BLOCKS)


def pose_between(start: BodyParams, end: BodyParams, t: float) -> BodyParams:
    """Return the pose at t in [0, 1] between one frame and another, every joint along its shortest rotation."""
    changes: dict[str, Any] = {}
    for name in (*_ROTATIONS, "expression", "transl"):
        a, b = getattr(start, name), getattr(end, name)
        if _turns(name, a, b):
            first, second = _rotation(a), _rotation(b)
            step = Rotation.from_rotvec(t * (first.inv() * second).as_rotvec())
            changes[name] = (first * step).as_rotvec().reshape(a.shape)
        elif a.shape == b.shape:
            changes[name] = (1.0 - t) * a + t * b
        else:  # files that say different things about hands or faces
            changes[name] = b
    return replace(end, **changes)


def reference_facing_as(reference: BodyParams, params: BodyParams) -> BodyParams:
    """Return the reference pose where another pose stands and looks: its place, turned about the vertical alone."""
    own, its = (_rotation(p.global_orient)[0] for p in (reference, params))
    turn = Rotation.from_rotvec([0.0, _heading(its) - _heading(own), 0.0])
    return replace(reference, global_orient=(turn * own).as_rotvec()[None], transl=params.transl)


def smoothed(params: BodyParams, *, radius: float) -> BodyParams:
    """Smooth a motion in time with Gaussian weights, every joint about its own rotation; what a noisy tracker shakes.

    Args:
        params: T frames, evenly spaced.
        radius: standard deviation, frames; 0 changes nothing.
    """
    require_at_least("smoothing of motion", radius, 0.0)
    count, reach = len(params), int(np.ceil(3.0 * radius))
    if radius == 0.0 or count < 2:
        return params
    offsets = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (offsets / radius) ** 2)
    # Outside of its ends a motion is continued by its mirror image about the end's pose, which keeps the ends in place.
    changes: dict[str, Any] = {}
    for name in (*_ROTATIONS, "expression", "transl"):
        value = getattr(params, name)
        turning = _turns(name, value, value)
        total, weight = np.zeros_like(value), np.zeros((count, 1))
        for offset, w in zip(offsets, weights, strict=True):
            at = np.arange(count) + offset
            mirrored = np.arange(count) - offset
            inside = (at >= 0) & (at < count) & (mirrored >= 0) & (mirrored < count)
            rows = np.flatnonzero(inside)
            if not len(rows):  # the motion is shorter than the window
                continue
            total[rows] += w * _step(value, rows, at[rows], turning)
            weight[rows] += w
        mean = total / weight
        changes[name] = _moved(value, mean, turning)
    return replace(params, **changes)


def resampled(params: BodyParams, times: Float[np.ndarray, " T"], wanted: Float[np.ndarray, " K"]) -> BodyParams:
    """Return a motion's poses at other times: cubic Hermite curves through the poses, joints about themselves.

    Tangents are those of the parabola through a pose and its two neighbours (of Catmull and Rom, where times are even),
    taken in the space of rotation vectors about each step's first pose; at the ends a motion continues as it came.

    Args:
        params: T frames.
        times: theirs, seconds, increasing.
        wanted: between the first and the last of them.

    Raises:
        InputError: times that do not increase, or as many as there are frames; wanted ones beyond them.
    """
    count = len(params)
    if times.shape != (count,) or not (np.diff(times) > 0).all():
        raise InputError("times of a motion", expected=f"{count} that increase", received=f"{times.shape}")
    if not ((wanted >= times[0]) & (wanted <= times[-1])).all():
        raise InputError("times of poses in between", expected="within the motion's", received="others")
    if count < 2:
        return params.select(np.zeros(len(wanted), dtype=np.int64))
    step = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, count - 2)
    before, after = np.maximum(step - 1, 0), np.minimum(step + 2, count - 1)
    long = (times[step + 1] - times[step])[:, None]
    # Seconds of the steps before and after, as shares of this one's; at an end there is none.
    first = (times[step] - times[before])[:, None] / long
    last = (times[after] - times[step + 1])[:, None] / long
    t = (wanted - times[step])[:, None] / long
    changes: dict[str, Any] = {}
    for name in (*_ROTATIONS, "expression", "transl"):
        value = getattr(params, name)
        turning = _turns(name, value, value)
        change = _step(value, step, step + 1, turning)
        came = -_step(value, step, before, turning) / np.where(first > 0, first, 1.0)
        goes = _step(value, step + 1, after, turning) / np.where(last > 0, last, 1.0)
        # At an end the tangent is that of the last step.
        start = np.where(first > 0, (first * change + came) / (1.0 + first), change)
        end = np.where(last > 0, (last * change + goes) / (1.0 + last), change)
        t2, t3 = t * t, t * t * t
        curve = (t3 - 2.0 * t2 + t) * start + (3.0 * t2 - 2.0 * t3) * change + (t3 - t2) * end
        changes[name] = _moved(value[step], curve, turning)
    return replace(params.select(step), **changes)


class CausalSmoother:
    """Smooths a motion as it comes, one pose at a time: exponential, with a time constant that fast motion shortens.

    The one-euro filter (Casiez et al. 2012): the cut-off grows with speed, so that slow poses do not shake and fast
    ones do not lag.

    Args:
        cutoff: hertz at rest.
        speed_gain: hertz a radian (or a metre) a second.
    """

    def __init__(self, *, cutoff: float = 3.0, speed_gain: float = 2.0) -> None:
        self.cutoff, self.speed_gain = cutoff, speed_gain
        self._last: BodyParams | None = None

    def restart(self) -> None:
        """Forget the past: the next pose is taken as it is."""
        self._last = None

    def __call__(self, params: BodyParams, seconds: float) -> BodyParams:
        """Return the smoothed pose of one frame, `seconds` after the last."""
        if self._last is None:
            self._last = params
            return params
        changes = {}
        for name in (*_ROTATIONS, "expression", "transl"):
            old, new = getattr(self._last, name), getattr(params, name)
            if old.shape != new.shape:
                changes[name] = new
                continue
            turning = _turns(name, old, new)
            both, rows = np.concatenate([old, new]), np.array([0])
            step = _step(both, rows, np.array([1]), turning)
            width = 3 if step.shape[1] % 3 == 0 else max(step.shape[1], 1)
            speed = np.linalg.norm(step.reshape(-1, width), axis=1) / seconds
            # One-euro filter (Casiez et al. 2012): the cutoff f = f_min + gain |speed| lets fast motion through and
            # damps jitter at rest. A first-order low pass moves by the share a / (1 + a) of the step, with a = 2 pi f
            # dt.
            rate = 2.0 * np.pi * (self.cutoff + self.speed_gain * speed) * seconds
            share = np.repeat(rate / (1.0 + rate), width)[None]
            changes[name] = _moved(old, share * step, turning)
        self._last = replace(params, **changes)
        return self._last


def _turns(name: str, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether numbers of a block are axis-angle vectors: hands may be coefficients of fewer."""
    whole = not name.endswith("hand_pose") or a.shape[1] == 45
    return name in _ROTATIONS and a.shape == b.shape and whole


def _step(
    value: Float[np.ndarray, "T D"], start: np.ndarray, end: np.ndarray, turning: bool
) -> Float[np.ndarray, "K D"]:
    """Return the step from rows to other rows: rotation vectors in the start's frame, or differences."""
    if not turning:
        return value[end] - value[start]
    first, second = (_rotation(value[rows]) for rows in (start, end))
    return (first.inv() * second).as_rotvec().reshape(len(start), -1)


def _moved(value: Float[np.ndarray, "T D"], step: Float[np.ndarray, "T D"], turning: bool) -> Float[np.ndarray, "T D"]:
    if not turning:
        return value + step
    turned = _rotation(value) * _rotation(step)
    return turned.as_rotvec().reshape(value.shape)


def _heading(rotation: Rotation) -> float:
    """Return the heading of a rotation: the angle about +Y of the rotated +Z, radians."""
    ahead = rotation.apply([0.0, 0.0, 1.0])
    return float(np.arctan2(ahead[0], ahead[2]))


def _rotation(vectors: Float[np.ndarray, "K D"]) -> Rotation:
    # A copy, because scipy refuses read-only arrays.
    return Rotation.from_rotvec(np.array(vectors, dtype=np.float64).reshape(-1, 3))
