"""A small network from sound to the mouth, in any language and at once: what is being said, and how the lips stand.

Features (`avatar.speech.sound_features`), then convolutions that see the past alone: one of width 5, and five of width
3 that reach 1, 2, 4, 8 and 16 rows apart, each added to what it got, `h <- relu(h + W * h)` (dilated and causal as van
den Oord et al., WaveNet, 2016). Two heads: probabilities of phonemes, and `ARTICULATORS` as `articulate` would give
them. A row says what was said `delay` seconds before its last sample. `tools.lips` makes the weights; the page runs the
same network (`web/src/lips/network.ts`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from avatar.speech.coarticulation import ARTICULATORS
from avatar.speech.phonemes import CONSONANTS, SILENCE, VOWELS, Phoneme, Speech
from avatar.speech.rests import spoken_level
from avatar.speech.sound_features import BANDS, FRAME, HOP, RATE, hear
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.files.tensor_bytes import unpack_tensors
from smplxpp.core.files.wave_file import Sound

WEIGHTS = Path(__file__).parent / "lips.safetensors"
"""Made by `python -m tools.lips.train`; the page carries the same file."""
PHONES = (SILENCE, *sorted(VOWELS | CONSONANTS))
"""What the first head tells apart."""
VERSION = 1
_JAW, _PRESS = (ARTICULATORS.index(name) for name in ("jaw", "press"))
_FOLLOWS = 0.5  # of what is new, a row
_OPEN, _CLOSED = 0.3, 0.6  # of the lips' pressing: from which they begin to close; from which they are closed
_CHANGE = 3.0  # nats that another phoneme has to be worth
_LEAST = 1e-3  # added to probabilities: no single row refuses a text
_EVEN = 100.0  # rows of even probabilities that are laid under a recording's mean: "five five" is little else


@dataclass(frozen=True, eq=False)
class Lips:
    """What the network hears, a row every `FRAME` seconds.

    Attributes:
        times: that each row tells of, seconds of the sound. phones: probabilities of `PHONES`.
        mouth: `ARTICULATORS`, 0 to 1.
    """

    times: Float64[np.ndarray, " T"]
    phones: Float32[np.ndarray, "T 40"]
    mouth: Float32[np.ndarray, "T 6"]


class LipNetwork:
    """The network, of a file's tensors.

    Args:
        tensors: by layer `NAME.weight`, whole numbers (out, in, width), `NAME.scale` and `NAME.bias` (out).
        about: `version`, `delay` in seconds, `dilations` of the layers behind the first.

    Raises:
        InputError: another network, or another version.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> None:
        if about.get("version") != VERSION:
            raise InputError("lip network", expected=f"version {VERSION}", received=str(about.get("version")))
        self.delay = float(about["delay"])
        self.dilations = [1, *(int(one) for one in about["dilations"]), 1]
        names = ["first", *(f"middle{k}" for k in range(len(self.dilations) - 2)), "last"]
        self._layers = [
            (
                (tensors[f"{name}.weight"] * tensors[f"{name}.scale"][:, None, None]).astype(np.float32),
                tensors[f"{name}.bias"].astype(np.float32),
            )
            for name in names
        ]
        width_in, width_out = self._layers[0][0].shape[1], self._layers[-1][0].shape[0]
        if (width_in, width_out) != (BANDS, len(PHONES) + len(ARTICULATORS)):
            raise InputError("lip network", expected="this version's layers", received=f"{width_in} to {width_out}")

    @staticmethod
    @cache
    def shipped() -> LipNetwork:
        """Return the network of `WEIGHTS`."""
        return LipNetwork(*unpack_tensors(read_bytes(WEIGHTS, subject="lip network"), subject="lip network"))

    def __call__(self, sound: Sound) -> Lips:
        """Return what is heard in a sound of any rate and level, the last `delay` of it included."""
        samples = sound.at_rate(RATE).samples
        behind = np.zeros(round(self.delay * RATE) + HOP, np.float32)
        h = hear(np.concatenate([samples, behind])).T
        for k in range(len(self._layers)):
            h = self.layer(k, h)
        logits, mouth = h[: len(PHONES)].T, h[len(PHONES) :].T
        times = (np.arange(len(logits)) + 1) * FRAME - self.delay
        seen = (times >= 0.0) & (times < sound.seconds)
        grown = np.exp(logits - logits.max(axis=1, keepdims=True))
        phones = grown / grown.sum(axis=1, keepdims=True)
        return Lips(times[seen], phones[seen], (1.0 / (1.0 + np.exp(-mouth)))[seen])

    def layer(self, k: int, h: Float32[np.ndarray, "I T"]) -> Float32[np.ndarray, "O T"]:
        """Return what layer `k` makes of all rows."""
        weight, bias = self._layers[k]
        out = _convolve(h, weight, self.dilations[k]) + bias[:, None]
        if k == len(self._layers) - 1:
            return out
        return np.maximum(out + h if k else out, 0.0)


def steady(mouth: Float[np.ndarray, "T 6"]) -> Float64[np.ndarray, "T 6"]:
    """Return the network's mouth as it is shown: without jitter, about 10 ms later, with lips that close.

    Each row takes half of what is new. Lips that are likely to be pressed are, and then the jaw is not open.
    """
    out, mean = np.zeros(mouth.shape), np.zeros(mouth.shape[1])
    for row, heard in zip(out, mouth, strict=True):
        mean += _FOLLOWS * (heard - mean)
        row[:] = mean
    share = np.clip((out[:, _PRESS] - _OPEN) / (_CLOSED - _OPEN), 0.0, 1.0)
    closed = share * share * (3.0 - 2.0 * share)
    out[:, _PRESS] = np.maximum(out[:, _PRESS], closed)
    out[:, _JAW] *= 1.0 - closed
    return out


def agreement(heard: Lips, speech: Speech) -> float:
    """Return by how much phonemes fit what is heard at their times better than what is heard at any, nats a row.

    The mean of `log p_t(a_t) - log mean_s p_s(a_t)` over the rows t in which a phoneme `a_t` is said: 0 is about what
    the same phonemes have at times that know nothing of the sound. What a voice or a room does to all rows cancels.
    """
    names = np.zeros(len(heard.times), np.int64)
    for one in speech.spoken:
        first, behind = np.searchsorted(heard.times, (one.start, one.end))
        names[first:behind] = PHONES.index(one.name)
    said = np.flatnonzero(names)
    if not len(said):
        return -np.inf
    rows = heard.phones[said].astype(np.float64)
    mean = (rows.sum(axis=0) + _EVEN / len(PHONES)) / (len(said) + _EVEN)
    own = rows[np.arange(len(said)), names[said]]
    return float(np.mean(np.log(own + _LEAST) - np.log(mean[names[said]] + _LEAST)))


def sounds_of(sound: Sound) -> Speech:
    """Return the likeliest phonemes of a recording in any language, without words.

    Viterbi's path through phonemes that may follow each other at will, at a price a change.

    Raises:
        InputError: silence, or more than 20 minutes.
    """
    spoken_level(sound)
    seconds = sound.seconds
    heard = LipNetwork.shipped()(sound)
    path = _best_path(np.log(heard.phones + 1e-9), _CHANGE)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(path)) + 1, [len(path)]])
    out = []
    for first, behind in pairwise(starts):
        start, end = max(heard.times[first] - 0.5 * FRAME, 0.0), min(heard.times[behind - 1] + 0.5 * FRAME, seconds)
        if PHONES[path[first]] != SILENCE and end > start:
            out.append(Phoneme(PHONES[path[first]], start, end))
    if not out:
        raise InputError("sound", expected="somebody who speaks", received="no sound of speech in it")
    return Speech(tuple(out), seconds)


def _convolve(h: Float32[np.ndarray, "I T"], weight: Float32[np.ndarray, "O I W"], reach: int) -> np.ndarray:
    """A convolution that sees the past alone, zeros before the start."""
    width = weight.shape[2]
    padded = np.pad(h, ((0, 0), ((width - 1) * reach, 0)))
    pieces = (weight[:, :, k] @ padded[:, k * reach : k * reach + h.shape[1]] for k in range(width))
    return np.sum(list(pieces), axis=0)


def _best_path(scores: Float32[np.ndarray, "T K"], change: float) -> np.ndarray:
    """The row of states with the greatest sum of scores less `change` for each change of state."""
    count, states = scores.shape
    came = np.zeros((count, states), np.int64)
    best = scores[0].astype(np.float64)
    for t in range(1, count):
        other = int(best.argmax())
        moved = best[other] - change
        came[t] = np.where(best >= moved, np.arange(states), other)
        best = np.maximum(best, moved) + scores[t]
    path = np.zeros(count, np.int64)
    path[-1] = int(best.argmax())
    for t in range(count - 1, 0, -1):
        path[t - 1] = came[t, path[t]]
    return path
