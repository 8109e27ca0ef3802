"""One voice made many: pitch, formants, source, room, microphone, noise and level, all drawn from one seed."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float32, Float64
from scipy.signal import butter, fftconvolve, lfilter, resample_poly, sosfilt

from avatar.speech.audio_features import RATE

_FACTORS = (0.75, 1.45)  # of pitch, formants and tempo at once
_OTHER_SOURCE, _ROOM, _TELEPHONE, _NOISY = 0.5, 0.4, 0.15, 0.6  # shares of sentences
_ORDER, _FRAME, _STEP = 18, 480, 240  # of the vocal tract's filter; samples
_PITCHES = (70.0, 320.0)  # hertz
_RESTS = (0.0, 0.6)  # seconds of nobody's speech ahead
_BENT = 0.7  # bands by which formants are elsewhere, each for itself
_HIDDEN, _MOST_HIDDEN = 0.4, 5  # share of sentences of which bands are not heard; how many


@dataclass(frozen=True)
class Heard:
    """A sentence as a microphone got it: a time `t` of the sentence is heard at `ahead + t / faster`.

    Attributes:
        samples: at `RATE`. ahead: seconds. faster: factor of the tempo.
    """

    samples: Float64[np.ndarray, " N"]
    ahead: float
    faster: float


def vary(samples: Float64[np.ndarray, " N"], rng: np.random.Generator) -> Heard:
    """Return a sentence as somebody else might have said it elsewhere."""
    x = np.asarray(samples, np.float64)
    if rng.random() < _OTHER_SOURCE:
        x = _revoiced(x, rng)
    ratio = Fraction(float(np.exp(rng.uniform(*np.log(_FACTORS))))).limit_denominator(24)
    x = resample_poly(x, ratio.denominator, ratio.numerator)
    ahead = float(rng.uniform(*_RESTS))
    x = np.concatenate([np.zeros(round(ahead * RATE)), x, np.zeros(round(float(rng.uniform(*_RESTS)) * RATE))])
    x = _tilted(x, rng)
    if rng.random() < _ROOM:
        x = _in_room(x, rng)
    if rng.random() < _TELEPHONE:
        x = sosfilt(butter(4, (300.0, 3400.0), "bandpass", fs=RATE, output="sos"), x)
    level = np.sqrt(np.mean(np.square(x))) + 1e-9
    if rng.random() < _NOISY:
        x = x + level * 10.0 ** (-rng.uniform(8.0, 45.0) / 20.0) * _noise(len(x), rng)
    x = x * (10.0 ** (rng.uniform(-34.0, -10.0) / 20.0) / level)
    return Heard(np.clip(x, -1.0, 1.0), ahead, float(ratio))


def disguise(rows: Float32[np.ndarray, "T B"], rng: np.random.Generator) -> Float32[np.ndarray, "T B"]:
    """Return what is heard with formants moved unlike each other, and with some bands that say nothing.

    The bands' hiding is that of Park et al., SpecAugment (2019).
    """
    bands = rows.shape[1]
    bend = np.interp(np.arange(bands), np.linspace(0, bands - 1, 5), rng.normal(0.0, _BENT, 5))
    at = np.clip(np.arange(bands) + bend, 0.0, bands - 1.001)
    low = at.astype(int)
    share = (at - low).astype(np.float32)
    out = (1.0 - share) * rows[:, low] + share * rows[:, low + 1]
    if rng.random() < _HIDDEN:
        width = int(rng.integers(1, _MOST_HIDDEN, endpoint=True))
        first = int(rng.integers(0, bands - width))
        out[:, first : first + width] = out[:, first : first + width].mean()
    return out


def _revoiced(x: Float64[np.ndarray, " N"], rng: np.random.Generator) -> Float64[np.ndarray, " N"]:
    """The same vocal tract on another source: pulses of another pitch, and noise where nothing swings.

    Linear prediction (Atal and Hanauer 1971), piece by piece, laid over each other.
    """
    base, swing = np.exp(rng.uniform(*np.log(_PITCHES))), rng.uniform(0.0, 0.25)
    times = np.arange(len(x)) / RATE
    waves = sum(np.sin(2.0 * np.pi * f * times + rng.uniform(0.0, 6.3)) for f in (0.4, 1.1, 2.3))
    phase = np.cumsum(base * np.exp(swing * waves / 2.0)) / RATE
    pulses = np.diff(np.floor(phase), prepend=0.0) * np.sqrt(RATE / base)
    breath = rng.uniform(0.02, 0.3)
    noise = rng.standard_normal(len(x))
    window = np.hanning(_FRAME + 2)[1:-1]
    emphasised = lfilter([1.0, -0.95], [1.0], x)
    out = np.zeros(len(x) + _FRAME)
    for at in range(0, len(x) - _FRAME, _STEP):
        piece = emphasised[at : at + _FRAME] * window
        spectrum = np.abs(np.fft.rfft(piece, 1024)) ** 2
        around = np.fft.irfft(spectrum)
        if around[0] < 1e-7:
            continue
        swings = around[RATE // 400 : RATE // 60].max() / around[0]
        coefficients, left = _predictor(around[: _ORDER + 1])
        voiced = swings > 0.35
        source = pulses[at : at + _FRAME] + breath * noise[at : at + _FRAME] if voiced else noise[at : at + _FRAME]
        gain = np.sqrt(left / np.sum(window**2))
        out[at : at + _FRAME] += window * lfilter([gain], coefficients, source)
    return lfilter([1.0], [1.0, -0.95], out[: len(x)]) * (_STEP / (0.5 * _FRAME))


def _predictor(around: Float64[np.ndarray, " K"]) -> tuple[Float64[np.ndarray, " K"], float]:
    """Levinson and Durbin's recursion: the filter `A(z)`, and the power that it leaves."""
    a = np.zeros(len(around))
    a[0], left = 1.0, around[0] * 1.0001
    for k in range(1, len(around)):
        reflection = -(around[k] + a[1:k] @ around[k - 1 : 0 : -1]) / left
        a[1 : k + 1] = a[1 : k + 1] + reflection * a[k - 1 :: -1][:k]
        left *= 1.0 - reflection**2
    return a, max(left, 0.0)


def _tilted(x: Float64[np.ndarray, " N"], rng: np.random.Generator) -> Float64[np.ndarray, " N"]:
    """A microphone's own colour: smooth gains of a few dB over an octave scale."""
    knots = np.cumsum(rng.normal(0.0, 3.0, 7)).clip(-12.0, 12.0)
    spectrum = np.fft.rfft(x)
    octaves = np.log2(np.maximum(np.fft.rfftfreq(len(x), 1.0 / RATE), 60.0) / 60.0)
    return np.fft.irfft(spectrum * 10.0 ** (np.interp(octaves, np.linspace(0.0, 7.1, 7), knots) / 20.0), len(x))


def _in_room(x: Float64[np.ndarray, " N"], rng: np.random.Generator) -> Float64[np.ndarray, " N"]:
    """Walls: noise that decays, behind the direct sound."""
    length = rng.uniform(0.08, 0.5)  # seconds to 60 dB less
    times = np.arange(int(length * RATE)) / RATE
    tail = rng.standard_normal(len(times)) * np.exp(-6.9 * times / length)
    tail[: int(0.003 * RATE)] = 0.0
    tail *= 10.0 ** (-rng.uniform(3.0, 15.0) / 20.0) / np.sqrt(np.sum(tail**2))
    tail[0] = 1.0
    return fftconvolve(x, tail)[: len(x)]


def _noise(count: int, rng: np.random.Generator) -> Float64[np.ndarray, " N"]:
    """Noise of power `f^-k`, k from 0 to 2, sometimes coming and going."""
    spectrum = np.fft.rfft(rng.standard_normal(count))
    hertz = np.maximum(np.fft.rfftfreq(count, 1.0 / RATE), 40.0)
    noise = np.fft.irfft(spectrum * hertz ** (-0.5 * rng.uniform(0.0, 2.0)), count)
    if rng.random() < 0.3:
        noise *= np.exp(
            0.8 * np.sin(2.0 * np.pi * rng.uniform(0.2, 4.0) * np.arange(count) / RATE + rng.uniform(0.0, 6.3))
        )
    return noise / (np.sqrt(np.mean(noise**2)) + 1e-12)
