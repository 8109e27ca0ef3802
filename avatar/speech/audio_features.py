"""Features of a recording: its level, its pauses by voice activity, and a causal log-mel spectrogram.

Bands are triangles spaced evenly in mel, `m(f) = 1127 ln(1 + f / 700)` (O'Shaughnessy 1987), over the power spectrum of
Hann windows. Levels are relative to the loudest of the last seconds, so that a microphone's gain does not matter. The
page has the same in TypeScript (`web/src/lips/features.ts`); a test compares both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import uniform_filter1d

from avatar.speech.phonemes import SILENCE, Phoneme
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound

MIN_PAUSE = 0.16
"""Shortest pause in seconds; closures of stop consonants are shorter."""
RATE = 16_000
"""Sampling rate of the spectrogram, hertz."""
HOP, WINDOW = 160, 400
"""Samples from one row of the spectrogram to the next, and samples in a row's window, which ends with the row."""
BANDS = 32
"""Number of mel bands."""
FRAME = HOP / RATE
"""Seconds from one row to the next."""
_FFT_SIZE = 512
_STOPS = frozenset(("P", "B", "T", "D", "K", "G", "CH", "JH"))


def speech_level(sound: Sound) -> float:
    """Return the root mean square of a recording, and check that it may contain speech.

    Raises:
        InputError: silence (below 1e-4 of full scale), less than a tenth of a second, more than 20 minutes.
    """
    shortest, longest = 0.1, 1200.0  # seconds
    if not shortest <= sound.seconds <= longest:
        raise InputError("sound", expected=f"{shortest:g} to {longest:g} seconds", received=f"{sound.seconds:.2f}")
    # Root mean square relative to full scale: 1e-4 is -80 dB. Public recordings of speech lie at -67 dB and above.
    level = float(np.sqrt(np.mean(np.square(sound.samples))))
    if level < 1e-4:
        raise InputError("sound", expected="a recording of speech", received="silence")
    return level


def amplified(sound: Sound) -> Sound:
    """Return a recording at a root mean square of at least 0.02, because `log_mel` takes levels of -50 dB for quiet.

    Raises:
        InputError: see `speech_level`.
    """
    level = speech_level(sound)
    return sound if level >= 0.02 else Sound(sound.samples * np.float32(0.02 / level), sound.rate)


def find_pauses(sound: Sound) -> Float64[np.ndarray, "N 2"]:
    """Return the starts and ends, in seconds, of pauses of `MIN_PAUSE` or longer.

    The level of the background is measured in the recording itself. Where speech is less than 12 dB above it (music, a
    crowd, or no pause at all) none are returned.
    """
    # Energy envelope: mean power over 20 ms, every 5 ms.
    width, hop = max(round(0.02 * sound.rate), 1), max(round(0.005 * sound.rate), 1)
    if len(sound.samples) < 2 * width:
        return np.zeros((0, 2))
    mean = uniform_filter1d(np.square(sound.samples.astype(np.float64)), width)
    at = np.arange(width // 2, len(mean) - width // 2, hop)
    levels = 10.0 * np.log10(mean[at].clip(1e-12))
    # The 5th percentile is the floor of the background, the 95th the level of speech.
    floor, loud = np.percentile(levels, (5.0, 95.0))
    if loud - floor < 12.0:
        return np.zeros((0, 2))
    # A background varies by 4 dB above its floor; 40 dB below speech counts as silence however quiet the background is.
    quiet = np.concatenate([[False], levels < max(floor + 4.0, loud - 40.0), [False]])
    first, behind = np.flatnonzero(~quiet[:-1] & quiet[1:]), np.flatnonzero(quiet[:-1] & ~quiet[1:])
    # All samples of a quiet window are quiet.
    pauses = np.stack([at[first] - width // 2, at[behind - 1] + width // 2], axis=1) / sound.rate
    return pauses[pauses[:, 1] - pauses[:, 0] >= MIN_PAUSE]


def clear_pauses(phonemes: Sequence[Phoneme], pauses: Float64[np.ndarray, "N 2"]) -> list[Phoneme]:
    """Return phonemes with the pauses cut out.

    Phonemes end where a pause begins and begin where it ends; one inside a pause is removed. Stops are silent during
    their closure, so they may reach 80 ms into a pause. A phoneme on both sides of a pause keeps its longer side.
    """
    closure, shortest = 0.08, 0.02  # seconds: of a stop; of what is left of a phoneme
    out: list[Phoneme] = []
    for phoneme in phonemes:
        reach = closure if phoneme.name in _STOPS else 0.0
        one = phoneme
        for start, end in pauses if phoneme.name != SILENCE else ():
            # The pause shrinks by the closure of a stop on both sides; phonemes outside of what is left are not
            # touched.
            into, out_of = start + reach, end - reach
            if into >= out_of or one.end <= into or one.start >= out_of:
                continue
            # Keep the longer side.
            if into - one.start >= one.end - out_of:
                one = replace(one, end=into)
            else:
                one = replace(one, start=out_of)
            if one.end - one.start < shortest:
                break
        if one == phoneme or one.end - one.start >= shortest:
            out.append(one)
    return out


def mel_filters() -> Float64[np.ndarray, "257 32"]:
    """Return the weight of each frequency of the Fourier transform in each mel band, 60 to 7600 Hz."""
    lowest, highest = (1127.0 * np.log1p(one / 700.0) for one in (60.0, 7600.0))
    # BANDS + 2 edges, evenly spaced in mel; band k rises from edge k to edge k + 1 and falls to edge k + 2.
    edges = np.linspace(lowest, highest, BANDS + 2)
    hertz = 700.0 * np.expm1(edges / 1127.0)
    at = np.arange(_FFT_SIZE // 2 + 1)[:, None] * RATE / _FFT_SIZE
    low, middle, high = hertz[:-2], hertz[1:-1], hertz[2:]
    rise, fall = (at - low) / (middle - low), (high - at) / (high - middle)
    return np.maximum(np.minimum(rise, fall), 0.0)


def log_mel(samples: Float32[np.ndarray, " N"]) -> Float32[np.ndarray, "T 32"]:
    """Return the log-mel spectrogram, a row for each whole hop of samples at `RATE`, without look-ahead.

    0 is 40 dB below the loudest of the last seconds, 1 is 20 dB above that. The sound before the first sample is taken
    as silence.
    """
    power_floor = 1e-10  # relative to full scale; quieter bands count as silence
    quietest = -50.0  # dB of full scale: lower bound of the loudness that levels are relative to
    decay = 4.0  # dB a second, decay of the reference loudness
    rows_at_once = 4096  # bounds the memory of the Fourier transforms
    # A row ends with its hop, so the zeros before the first sample make the windows causal.
    count = len(samples) // HOP
    whole = np.concatenate([np.zeros(WINDOW - HOP), samples[: count * HOP].astype(np.float64)])
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(WINDOW) / WINDOW)
    bands = mel_filters()
    power = np.zeros((count, BANDS))
    for first in range(0, count, rows_at_once):
        behind = min(first + rows_at_once, count)
        pieces = np.lib.stride_tricks.sliding_window_view(whole[: WINDOW - HOP + behind * HOP], WINDOW)[::HOP][first:]
        spectrum = np.fft.rfft(pieces * window, _FFT_SIZE)
        # Normalised so that a sine of amplitude 1 has a power of 1 over all bands.
        power[first:behind] = (spectrum.real**2 + spectrum.imag**2) @ bands * (4.0 / (1.5 * WINDOW * _FFT_SIZE))
    # Levels relative to a running maximum that decays linearly in dB.
    loudness = 10.0 * np.log10(power.sum(axis=1) + power_floor)
    decayed = decay * FRAME * np.arange(count)
    loudest = np.maximum.accumulate(np.maximum(loudness, quietest) + decayed) - decayed if count else loudness
    levels = 10.0 * np.log10(power + power_floor) - loudest[:, None]
    return (np.maximum(levels + 40.0, -40.0) / 20.0).astype(np.float32)
