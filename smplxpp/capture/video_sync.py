"""Align the videos of a rig in time: by offsets that the user knows, by their sound, or by the motion in them.

Two recordings of one event correlate best at the lag between them. Of sound the onsets are compared (the rise of its
loudness: a clap, steps, words), of pictures the amount of change from frame to frame. Both need an event that all
cameras record; without one, the second best lag is almost as good, and the lag is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.capture.video_files import Video, video_frames, video_sound
from smplxpp.core.errors import InputError

_RATE = 200  # values a second of both kinds of signals, which bounds the precision to 5 ms
# The best lag must have `_CLEARLY` times the correlation of any lag at least `_APART` seconds away from it, and exceed
# 0 by `_DEVIATIONS` standard deviations of a chance correlation.
_CLEARLY, _APART, _DEVIATIONS = 1.15, 0.15, 3.0
_LEAST_OVERLAP = 1.0  # seconds that two recordings must share


@dataclass(frozen=True, eq=False)
class Timeline:
    """Which frame of each video belongs to which frame of the capture.

    Attributes:
        fps: of the capture: the lowest rate of the videos.
        sources: frame of each video for each frame of the capture, by camera.
    """

    fps: float
    sources: Mapping[str, Int64[np.ndarray, " F"]]

    def __len__(self) -> int:
        return len(next(iter(self.sources.values())))


def timeline(videos: Mapping[str, Video], offsets: Mapping[str, float]) -> Timeline:
    """Return the frames of the time that all videos share, at the lowest of their rates.

    Frame n is at `t_0 + n / fps` with the latest start t_0, and shows in each video the frame whose time in the file is
    nearest to it.

    Args:
        videos: by camera.
        offsets: seconds at which each camera started, on a common clock; cameras without one started at 0.

    Raises:
        InputError: no time that all share.
    """
    starts = {name: offsets.get(name, 0.0) for name in videos}
    fps = min(video.fps for video in videos.values())
    first = max(starts.values())
    last = min(starts[name] + video.times[-1] for name, video in videos.items())
    count = int(np.floor((last - first) * fps + 1e-6)) + 1
    if count < 1:
        raise InputError(
            "offsets of the videos",
            expected="a time that all of them show",
            received=f"the last one starts at {first:.2f} s, the first one ends at {last:.2f} s",
        )
    times = first + np.arange(count) / fps
    return Timeline(fps, {name: _nearest(video.times, times - starts[name]) for name, video in videos.items()})


def _nearest(times: Float64[np.ndarray, " T"], wanted: Float64[np.ndarray, " F"]) -> Int64[np.ndarray, " F"]:
    """Return the numbers of the nearest of some ascending times; halfway between two, of the earlier."""
    return np.searchsorted(0.5 * (times[1:] + times[:-1]), wanted - 1e-6)


def found_offsets(videos: Mapping[str, Video], by: str) -> dict[str, float]:
    """Return the seconds at which each camera started, relative to the first, found by `sound` or `motion`.

    Raises:
        InputError: a video without sound, or no event that two of them clearly share.
    """
    signals = {name: _sound(video) if by == "sound" else _motion(video) for name, video in videos.items()}
    silent = [name for name, signal in signals.items() if len(signal) < _RATE * _LEAST_OVERLAP]
    if silent:
        raise InputError(
            f"--sync {by}",
            expected=f"videos with at least {_LEAST_OVERLAP:g} s of {by}",
            received=f"none in {', '.join(silent[:6])}",
            remedy="name the offsets: --offset CAM=SECONDS,...",
        )
    reference, *others = signals
    offsets = {reference: 0.0}
    for name in others:
        lag, clearness = best_lag(signals[reference], signals[name])
        if clearness < 1.0:
            raise InputError(
                f"--sync {by}",
                expected=f"an event that {reference} and {name} share, such as a clap",
                received=f"none that is clear (the best lag is {lag / _RATE:.2f} s)",
                remedy="name the offsets: --offset CAM=SECONDS,...",
            )
        offsets[name] = lag / _RATE
    earliest = min(offsets.values())
    return {name: value - earliest for name, value in offsets.items()}


def best_lag(a: Float64[np.ndarray, " N"], b: Float64[np.ndarray, " M"]) -> tuple[float, float]:
    """Return the lag of b behind a in samples, and its clarity: from 1 on it is not due to chance.

    The correlation is normalised by the energies of the parts that overlap, which have at least one second. It is clear
    if it is 1.15 times as high as that of any other lag, and three times the standard deviation `1 / sqrt(n)` of a
    chance correlation of n independent values: the length of the overlap by that of the signals' own correlation.

    Example:
        >>> event = np.random.default_rng(0).normal(size=2000)
        >>> lag, clearness = best_lag(event, event[300:])
        >>> round(lag), clearness > 1
        (300, True)
    """
    a, b = _without_trend(a), _without_trend(b)
    size = 1 << int(np.ceil(np.log2(len(a) + len(b))))
    spectrum = np.conj(np.fft.rfft(b, size))

    def correlated(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.fft.rfft(x, size) * y, size)

    lags = np.arange(-(len(b) - 1), len(a))
    product = correlated(a, spectrum)[lags % size]
    # Energies of the overlapping parts at each lag.
    ones_a, ones_b = np.ones_like(a), np.conj(np.fft.rfft(np.ones_like(b), size))
    energy_a = correlated(a**2, ones_b)[lags % size]
    energy_b = correlated(ones_a, np.conj(np.fft.rfft(b**2, size)))[lags % size]
    overlap = np.minimum(len(a), lags + len(b)) - np.maximum(0, lags)
    least = min(_RATE * _LEAST_OVERLAP, 0.5 * min(len(a), len(b)))
    with np.errstate(divide="ignore", invalid="ignore"):
        score = product / np.sqrt(np.maximum(energy_a * energy_b, 1e-12))
    # Short overlaps correlate by chance: they count less.
    score = np.where(overlap >= least, score * np.sqrt(np.minimum(1.0, overlap / min(len(a), len(b)))), -np.inf)
    best = int(np.argmax(score))
    away = np.abs(lags - lags[best]) > _APART * _RATE
    rival = float(score[away].max(initial=1e-3))
    independent = float(overlap[best]) / max(_correlation_length(a), _correlation_length(b))
    beyond_chance = float(score[best]) * np.sqrt(independent) / _DEVIATIONS
    return float(lags[best]), float(min(score[best] / max(rival, 1e-3) / _CLEARLY, beyond_chance))


def _without_trend(signal: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Return a signal less its mean over the second around each value."""
    slow = 1.0  # seconds over which signals are compared to their own mean: light and gain change slowly
    width = min(len(signal), int(slow * _RATE)) | 1
    padded = np.pad(signal, width // 2, mode="reflect") if len(signal) > width // 2 else signal
    mean = np.convolve(padded, np.full(width, 1.0 / width), mode="same")[width // 2 : width // 2 + len(signal)]
    return signal - (mean if len(mean) == len(signal) else signal.mean())


def _correlation_length(signal: Float64[np.ndarray, " N"]) -> float:
    """Return over how many values a signal resembles itself: twice the lag at which its correlation falls below 0.3."""
    size = 1 << int(np.ceil(np.log2(2 * len(signal))))
    own = np.fft.irfft(np.abs(np.fft.rfft(signal, size)) ** 2, size)[: len(signal)]
    below = np.flatnonzero(own < 0.3 * own[0])
    return 2.0 * float(below[0] if len(below) else len(signal))


def _sound(video: Video) -> Float64[np.ndarray, " N"]:
    """Return the rise of the sound's loudness, 200 values a second."""
    # Samples a second: speech and claps.
    sound_rate = 8000
    samples = video_sound(video, sound_rate)
    step = sound_rate // _RATE
    loud = np.abs(samples[: len(samples) // step * step]).reshape(-1, step).mean(axis=1)
    if len(loud) < 2:
        return np.zeros(0)
    # Logarithms, because microphones stand at different distances.
    level = np.log(loud + 0.02 * loud.max() + 1e-6)
    return np.maximum(np.diff(level), 0.0)


def _motion(video: Video) -> Float64[np.ndarray, " N"]:
    """Return the mean change of brightness from frame to frame, interpolated to 200 values a second."""
    # Pixels of the longer side of pictures that are compared.
    small = 64
    scale = small / max(video.width, video.height)
    size = (max(2, round(video.width * scale)), max(2, round(video.height * scale)))
    before, change, times = None, [], []
    for number, frame in video_frames(video, range(len(video.times)), size):
        grey = frame.mean(axis=2)
        if before is not None:
            change.append(float(np.abs(grey - before).mean()))
            times.append(float(video.times[number - 1 : number + 1].mean()))
        before = grey
    if len(change) < 2:
        return np.zeros(0)
    # A value is the change between two frames, at the time between them; the signal starts with the video.
    return np.interp(np.arange(0.0, times[-1], 1.0 / _RATE), times, np.log(np.array(change) + 0.05))
