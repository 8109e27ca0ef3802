"""What a face does beside speaking: blinks, glances, small motion of the head. All of it from one seed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

_BLINK_EVERY, _SHORTEST = 3.5, 0.8  # seconds between blinks: the mean, and the least
_CLOSING, _CLOSED, _OPENING = 0.07, 0.04, 0.15  # seconds of a blink
_GLANCE_EVERY, _GLANCE = 1.6, np.radians([1.2, 2.5, 0.0])  # seconds; spread about x and y, radians
_SACCADE = 0.04  # seconds from one glance to the next
_NOD = np.radians([1.6, 2.0, 0.8])  # of the head about x, y and z, radians
_NOD_EVERY, _NODDING, _NOD_DEPTH = (1.5, 5.0), 0.5, np.radians(5.0)  # seconds, seconds, radians
_WAVES = ((0.13, 0.6), (0.31, 0.3), (0.73, 0.15))  # Hz and share of the head's motion


def blinks(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, " T"]:
    """How far the eyes are closed, 0 to 1."""
    out = np.zeros(len(times))
    at = float(rng.uniform(_SHORTEST, _BLINK_EVERY))
    while len(times) and at < times[-1]:
        since = times - at
        closing = np.clip(since / _CLOSING, 0.0, 1.0)
        opening = np.clip((since - _CLOSING - _CLOSED) / _OPENING, 0.0, 1.0)
        out = np.maximum(out, closing * (1.0 - opening))
        at += _SHORTEST + float(rng.exponential(_BLINK_EVERY - _SHORTEST))
    return out


def glances(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, "T 3"]:
    """Rotation vectors of both eyes: still between quick turns, back to the viewer every other time."""
    out = np.zeros((len(times), 3))
    at, now, away = 0.0, np.zeros(3), True
    while len(times) and at < times[-1]:
        at += 0.3 + float(rng.exponential(_GLANCE_EVERY - 0.3))
        goal = rng.normal(size=3).clip(-2.0, 2.0) * _GLANCE if away else np.zeros(3)
        out += np.clip((times - at) / _SACCADE, 0.0, 1.0)[:, None] * (goal - now)
        now, away = goal, not away
    return out


def head_motion(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, "T 3"]:
    """Rotation vectors of head and neck together: slow waves of random phases, none at the first time."""
    out = np.zeros((len(times), 3))
    for rate, share in _WAVES:
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        speed = 2.0 * np.pi * rate * rng.uniform(0.85, 1.15, 3)
        out += share * _NOD * (np.sin(times[:, None] * speed + phase) - np.sin(phase))
    return out


def nods(times: Float64[np.ndarray, " T"], rng: np.random.Generator) -> Float64[np.ndarray, " T"]:
    """How far a listener's head is lowered, radians: once or twice every few seconds."""
    out = np.zeros(len(times))
    at = float(rng.uniform(*_NOD_EVERY))
    while len(times) and at < times[-1]:
        for k in range(int(rng.integers(1, 3))):
            u = np.clip((times - at - k * _NODDING) / _NODDING, 0.0, 1.0)
            out += _NOD_DEPTH * 0.6**k * np.sin(np.pi * u) ** 2
        at += 2.0 * _NODDING + float(rng.uniform(*_NOD_EVERY))
    return out
