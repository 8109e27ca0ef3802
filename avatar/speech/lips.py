"""A small causal network from sound to phonemes and mouth shape, in any language and in real time.

Log-mel features (`avatar.speech.audio_features`), then causal convolutions: one of width 5, and five residual ones of
width 3 with dilations 1, 2, 4, 8 and 16, `h <- relu(h + W * h)` (van den Oord et al., WaveNet, 2016). Two heads:
probabilities of phonemes, and `ARTICULATORS` as `articulate` gives them. A row describes the sound `delay` seconds
before its last sample. `tools.lips` trains the weights; the page runs the same network (`web/src/lips/network.ts`).
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

from avatar.speech.audio_features import BANDS, FRAME, HOP, RATE, amplified, log_mel
from avatar.speech.coarticulation import ARTICULATORS
from avatar.speech.phonemes import CONSONANTS, SILENCE, VOWELS, Phoneme, Speech
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.files.sound_file import Sound
from smplxpp.core.files.tensor_bytes import unpack_tensors

WEIGHTS = Path(__file__).parent / "lips.safetensors"
"""Made by `python -m tools.lips.train`; the page carries the same file."""
PHONES = (SILENCE, *sorted(VOWELS | CONSONANTS))
"""Classes of the first head."""
VERSION = 1
"""Version of the weight file, shared with the page."""
_JAW, _PRESS = (ARTICULATORS.index(name) for name in ("jaw", "press"))


@dataclass(frozen=True, eq=False)
class LipPrediction:
    """Output of the network, a row every `FRAME` seconds.

    Attributes:
        times: time in the sound that each row describes, seconds.
        phones: probabilities of `PHONES`.
        mouth: `ARTICULATORS`, 0 to 1.
    """

    times: Float64[np.ndarray, " T"]
    phones: Float32[np.ndarray, "T 40"]
    mouth: Float32[np.ndarray, "T 6"]


class LipNetwork:
    """The network, made from the tensors of its weight file.

    Args:
        tensors: for each layer `NAME.weight`, integers (out, in, width), `NAME.scale` and `NAME.bias` (out).
        about: `version`, `delay` in seconds, `dilations` of the residual layers.

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
        """Return the network of the shipped `WEIGHTS`."""
        return LipNetwork(*unpack_tensors(read_bytes(WEIGHTS, subject="lip network"), subject="lip network"))

    def __call__(self, sound: Sound) -> LipPrediction:
        """Return the prediction for a sound of any rate and level, up to its very end."""
        # Silence after the end, so that the delayed output covers all of the sound.
        samples = sound.at_rate(RATE).samples
        behind = np.zeros(round(self.delay * RATE) + HOP, np.float32)
        h = log_mel(np.concatenate([samples, behind])).T
        for k in range(len(self._layers)):
            h = self.layer(k, h)
        # Row k ends (k + 1) FRAME after the start and describes the sound `delay` seconds before; rows outside are
        # cut off.
        logits, mouth = h[: len(PHONES)].T, h[len(PHONES) :].T
        times = (np.arange(len(logits)) + 1) * FRAME - self.delay
        seen = (times >= 0.0) & (times < sound.seconds)
        # Softmax; subtracting the maximum avoids overflow. The mouth's outputs go through the logistic function.
        grown = np.exp(logits - logits.max(axis=1, keepdims=True))
        phones = grown / grown.sum(axis=1, keepdims=True)
        return LipPrediction(times[seen], phones[seen], (1.0 / (1.0 + np.exp(-mouth)))[seen])

    def layer(self, k: int, h: Float32[np.ndarray, "I T"]) -> Float32[np.ndarray, "O T"]:
        """Return the output of layer `k` for all rows."""
        weight, bias = self._layers[k]
        # The first layer has no residual, because it changes the number of channels; the last one has no activation.
        out = _convolve(h, weight, self.dilations[k]) + bias[:, None]
        if k == len(self._layers) - 1:
            return out
        return np.maximum(out + h if k else out, 0.0)


def smooth_mouth(mouth: Float[np.ndarray, "T 6"]) -> Float64[np.ndarray, "T 6"]:
    """Return the network's mouth without jitter, about 10 ms later, with lips that close completely.

    An exponential moving average removes the jitter. Lips pressed by 0.6 or more are closed, and the jaw with them;
    they begin to close at 0.3.
    """
    out, mean = np.zeros(mouth.shape), np.zeros(mouth.shape[1])
    for row, heard in zip(out, mouth, strict=True):
        mean += 0.5 * (heard - mean)
        row[:] = mean
    # Smoothstep from 0 at 0.3 to 1 at 0.6: the pressing lips and the jaw close together, without a jump.
    share = np.clip((out[:, _PRESS] - 0.3) / (0.6 - 0.3), 0.0, 1.0)
    closed = share * share * (3.0 - 2.0 * share)
    out[:, _PRESS] = np.maximum(out[:, _PRESS], closed)
    out[:, _JAW] *= 1.0 - closed
    return out


def alignment_score(heard: LipPrediction, speech: Speech) -> float:
    """Return the mean log-likelihood ratio of phonemes at their times to the same phonemes at any time, nats a row.

    The mean of `log p_t(a_t) - log mean_s p_s(a_t)` over the rows t with a phoneme `a_t`. An alignment independent of
    the sound scores about 0. Effects of a voice or a room on all rows cancel.
    """
    names = np.zeros(len(heard.times), np.int64)
    for one in speech.spoken:
        # Class 0 is silence, so 0 marks rows without a phoneme.
        first, behind = np.searchsorted(heard.times, (one.start, one.end))
        names[first:behind] = PHONES.index(one.name)
    with_phoneme = np.flatnonzero(names)
    if not len(with_phoneme):
        return -np.inf
    # Additive smoothing keeps a single row from rejecting a text. 100 rows of uniform probabilities in the mean keep it
    # from being dominated by a short text's own phonemes ("five five").
    smoothing, uniform_rows = 1e-3, 100.0
    rows = heard.phones[with_phoneme].astype(np.float64)
    mean = (rows.sum(axis=0) + uniform_rows / len(PHONES)) / (len(with_phoneme) + uniform_rows)
    own = rows[np.arange(len(with_phoneme)), names[with_phoneme]]
    return float(np.mean(np.log(own + smoothing) - np.log(mean[names[with_phoneme]] + smoothing)))


def recognise_phonemes(sound: Sound) -> Speech:
    """Recognise the phonemes of a recording in any language, without words.

    The Viterbi path through phonemes that may follow each other freely, at a cost of 3 nats a change.

    Raises:
        InputError: silence, or more than 20 minutes.
    """
    seconds = sound.seconds
    heard = LipNetwork.shipped()(amplified(sound))
    # The cost of a change keeps single noisy rows from becoming phonemes of their own.
    path = _best_path(np.log(heard.phones + 1e-9), 3.0)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(path)) + 1, [len(path)]])
    out = []
    for first, behind in pairwise(starts):
        start, end = max(heard.times[first] - 0.5 * FRAME, 0.0), min(heard.times[behind - 1] + 0.5 * FRAME, seconds)
        if PHONES[path[first]] != SILENCE and end > start:
            out.append(Phoneme(PHONES[path[first]], start, end))
    if not out:
        raise InputError("sound", expected="a recording of speech", received="no phoneme in it")
    return Speech(tuple(out), seconds)


def _convolve(h: Float32[np.ndarray, "I T"], weight: Float32[np.ndarray, "O I W"], dilation: int) -> np.ndarray:
    """Return a causal dilated convolution, with zeros before the start."""
    # Pad on the left alone: row t sees rows t - (W - 1) dilation to t. One matrix product for each tap of the kernel.
    width = weight.shape[2]
    padded = np.pad(h, ((0, 0), ((width - 1) * dilation, 0)))
    pieces = (weight[:, :, k] @ padded[:, k * dilation : k * dilation + h.shape[1]] for k in range(width))
    return np.sum(list(pieces), axis=0)


def _best_path(scores: Float32[np.ndarray, "T K"], change: float) -> np.ndarray:
    """Return the Viterbi path: states with the greatest sum of scores minus `change` for each change of state."""
    count, states = scores.shape
    # Forward pass: a state is kept, or entered from the best one of the row before.
    came = np.zeros((count, states), np.int64)
    best = scores[0].astype(np.float64)
    for t in range(1, count):
        other = int(best.argmax())
        moved = best[other] - change
        came[t] = np.where(best >= moved, np.arange(states), other)
        best = np.maximum(best, moved) + scores[t]
    # Backtrack from the best last state.
    path = np.zeros(count, np.int64)
    path[-1] = int(best.argmax())
    for t in range(count - 1, 0, -1):
        path[t - 1] = came[t, path[t]]
    return path
