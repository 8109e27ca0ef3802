"""Whether a recording has speech to follow, and its rests: where it is as quiet as its own background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import uniform_filter1d

from avatar.speech.phonemes import SILENCE, Phoneme
from smplxpp.core.errors import InputError
from smplxpp.core.files.wave_file import Sound

SHORTEST = 0.16
"""Seconds: closures of stops are shorter."""
_WINDOW, _HOP = 0.02, 0.005  # seconds that a level is taken over, and between levels
_FLOOR = 5.0  # percentile of the levels that is the background's
_LOUD = 95.0  # percentile that is the speech's
_ABOVE = 4.0  # dB by which a background rises above its floor
_BELOW = 40.0  # dB below speech at which nobody speaks, however quiet the background is
_CLEAR = 12.0  # dB that speech has to be above the background: else nothing tells rests from it
_CLOSURE = 0.08  # seconds that a stop is silent for
_LEFT = 0.02  # seconds: what is left of a sound may not be shorter
_QUIET = 1e-3  # of full scale: nobody speaks in all of the sound
_AT_LEAST, _AT_MOST = 0.1, 1200.0  # seconds of a sound
_STOPS = frozenset(("P", "B", "T", "D", "K", "G", "CH", "JH"))


def spoken_level(sound: Sound) -> float:
    """Return the root mean square of a recording that somebody may speak in.

    Raises:
        InputError: silence, less than a tenth of a second, more than 20 minutes.
    """
    if not _AT_LEAST <= sound.seconds <= _AT_MOST:
        raise InputError("sound", expected=f"{_AT_LEAST:g} to {_AT_MOST:g} seconds", received=f"{sound.seconds:.2f}")
    level = float(np.sqrt(np.mean(np.square(sound.samples))))
    if level < _QUIET:
        raise InputError("sound", expected="somebody who speaks", received="silence")
    return level


def find_rests(sound: Sound) -> Float64[np.ndarray, "N 2"]:
    """Return the starts and ends, in seconds, of what is quiet for `SHORTEST` or longer.

    The background's level is measured in the sound itself. Where speech is less than 12 dB above it (music, a crowd, or
    no rest at all) there are none.
    """
    width, hop = max(round(_WINDOW * sound.rate), 1), max(round(_HOP * sound.rate), 1)
    if len(sound.samples) < 2 * width:
        return np.zeros((0, 2))
    mean = uniform_filter1d(np.square(sound.samples.astype(np.float64)), width)
    at = np.arange(width // 2, len(mean) - width // 2, hop)
    levels = 10.0 * np.log10(mean[at].clip(1e-12))
    floor, loud = np.percentile(levels, (_FLOOR, _LOUD))
    if loud - floor < _CLEAR:
        return np.zeros((0, 2))
    quiet = np.concatenate([[False], levels < max(floor + _ABOVE, loud - _BELOW), [False]])
    first, behind = np.flatnonzero(~quiet[:-1] & quiet[1:]), np.flatnonzero(quiet[:-1] & ~quiet[1:])
    # All that a quiet window covers is quiet.
    rests = np.stack([at[first] - width // 2, at[behind - 1] + width // 2], axis=1) / sound.rate
    return rests[rests[:, 1] - rests[:, 0] >= SHORTEST]


def without_rests(phonemes: Sequence[Phoneme], rests: Float64[np.ndarray, "N 2"]) -> list[Phoneme]:
    """Return phonemes that leave rests free.

    Sounds end where a rest begins and begin where it ends; one that lies in it is not spoken. Stops are silent while
    they are closed: they may reach 80 ms into it. A sound on both sides of a rest keeps the longer.
    """
    out: list[Phoneme] = []
    for phoneme in phonemes:
        reach = _CLOSURE if phoneme.name in _STOPS else 0.0
        one = phoneme
        for start, end in rests if phoneme.name != SILENCE else ():
            into, out_of = start + reach, end - reach
            if into >= out_of or one.end <= into or one.start >= out_of:
                continue
            if into - one.start >= one.end - out_of:
                one = replace(one, end=into)
            else:
                one = replace(one, start=out_of)
            if one.end - one.start < _LEFT:
                break
        if one == phoneme or one.end - one.start >= _LEFT:
            out.append(one)
    return out
