"""Sound to what a small network hears of it: levels in bands of pitch, a hundred times a second, without looking ahead.

Bands are triangles even in mel, `m(f) = 1127 ln(1 + f / 700)` (O'Shaughnessy 1987), over the power spectrum of Hann
windows. Levels are told from the loudest of the last seconds, so that a microphone's gain does not matter. The page has
the same in TypeScript (`web/src/lips/features.ts`); a test holds one against the other.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

RATE = 16_000
"""Samples a second."""
HOP, WINDOW = 160, 400
"""Samples from a row to the next, and that one row sees: it ends with the row's last sample."""
BANDS = 32
FRAME = HOP / RATE
"""Seconds from a row to the next."""
_SIZE = 512  # of the transform
_LOWEST, _HIGHEST = 60.0, 7600.0  # hertz
_FLOOR = 1e-10  # of full scale's power: what is quieter counts as silence
_QUIETEST = -50.0  # dB of full scale: the least that counts as somebody's loudest
_FORGETS = 4.0  # dB a second by which the loudest is forgotten
_ROW = 4096  # rows that are transformed at once


def mel_bands() -> Float64[np.ndarray, "257 32"]:
    """Return the weight of each frequency of the transform in each band."""
    lowest, highest = (1127.0 * np.log1p(one / 700.0) for one in (_LOWEST, _HIGHEST))
    edges = np.linspace(lowest, highest, BANDS + 2)
    hertz = 700.0 * np.expm1(edges / 1127.0)
    at = np.arange(_SIZE // 2 + 1)[:, None] * RATE / _SIZE
    low, middle, high = hertz[:-2], hertz[1:-1], hertz[2:]
    rise, fall = (at - low) / (middle - low), (high - at) / (high - middle)
    return np.maximum(np.minimum(rise, fall), 0.0)


def hear(samples: Float32[np.ndarray, " N"]) -> Float32[np.ndarray, "T 32"]:
    """Return a row for each whole hop of samples at `RATE`; 0 is 40 dB below the loudest, 1 is 20 dB more.

    Before the first sample it was silent.
    """
    count = len(samples) // HOP
    whole = np.concatenate([np.zeros(WINDOW - HOP), samples[: count * HOP].astype(np.float64)])
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(WINDOW) / WINDOW)
    bands = mel_bands()
    power = np.zeros((count, BANDS))
    for first in range(0, count, _ROW):
        behind = min(first + _ROW, count)
        pieces = np.lib.stride_tricks.sliding_window_view(whole[: WINDOW - HOP + behind * HOP], WINDOW)[::HOP][first:]
        spectrum = np.fft.rfft(pieces * window, _SIZE)
        # A sine of amplitude 1 has a power of 1, all its bands together.
        power[first:behind] = (spectrum.real**2 + spectrum.imag**2) @ bands * (4.0 / (1.5 * WINDOW * _SIZE))
    loudness = 10.0 * np.log10(power.sum(axis=1) + _FLOOR)
    forgotten = _FORGETS * FRAME * np.arange(count)
    loudest = np.maximum.accumulate(np.maximum(loudness, _QUIETEST) + forgotten) - forgotten if count else loudness
    levels = 10.0 * np.log10(power + _FLOOR) - loudest[:, None]
    return (np.maximum(levels + 40.0, -40.0) / 20.0).astype(np.float32)
