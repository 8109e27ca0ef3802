"""What the network learns from: sentences of random words, said by one CC0 voice whose own durations are the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from avatar.speech import SILENCE, Speech, articulate
from avatar.speech.audio_features import RATE
from avatar.speech.phonemes import CONSONANTS, VOWELS, ipa_from_arpabet
from avatar.speech.pronunciation import cmu_dictionary, phones_from_word
from avatar.speech.voice import PiperVoice

STEP = 0.01
"""Seconds between the mouth's positions that are kept."""
_COMMON = (
    "the a and of to in is it you that he was for on are with as they be at this have from or had by but what some we "
    "can out other were all there when up use your how said an each she which their if will way about many then them "
    "would like so these her long make thing see him two has look more day could go come did my no most over know who"
).split()
_SHARE_COMMON = 0.35
_WORDS = (4, 9)  # of a sentence
_COMMA = 0.12  # behind a word
_SLOWER, _NOISE = (0.75, 1.3), (0.0, 0.8)


@dataclass(frozen=True, eq=False)
class Utterance:
    """A sentence that was said.

    Attributes:
        samples: at `RATE`. speech: its phonemes in time. mouth: `ARTICULATORS` every `STEP` seconds from 0 on.
    """

    samples: Float32[np.ndarray, " N"]
    speech: Speech
    mouth: Float64[np.ndarray, "T 6"]


def make_sentences(count: int, rng: np.random.Generator) -> list[str]:
    """Return sentences of random words in IPA: those with rare sounds come as often as others."""
    known = cmu_dictionary()
    words = [one for one in sorted(known) if one.isalpha() and 3 <= len(known[one].split()) <= 11]
    phones = [known[one].split() for one in words]
    names = sorted(VOWELS | CONSONANTS)
    counts = {name: 1 for name in names}
    for one in phones:
        for phone in one:
            counts[phone] += 1
    rarity = np.array([np.mean([1.0 / counts[phone] for phone in one]) for one in phones])
    share = rarity / rarity.sum()
    out = []
    for _ in range(count):
        said = ""
        chosen = rng.integers(*_WORDS, endpoint=True)
        for k in range(chosen):
            word = str(rng.choice(_COMMON)) if rng.random() < _SHARE_COMMON else words[rng.choice(len(words), p=share)]
            said += (" " if said else "") + ipa_from_arpabet(phones_from_word(word)[0])
            if k + 1 < chosen and rng.random() < _COMMA:
                said += ","
        out.append(said + ".")
    return out


def make_utterances(count: int, seed: int) -> list[Utterance]:
    """Have the voice say sentences, each at a speed and with a noise of its own."""
    import onnxruntime

    rng = np.random.default_rng(seed)
    onnxruntime.set_seed(seed)
    voice = PiperVoice(threads=1)
    out = []
    for ipa in make_sentences(count, rng):
        spoken = voice.read(ipa, slower=float(rng.uniform(*_SLOWER)), noise=float(rng.uniform(*_NOISE)))
        times = np.arange(int(spoken.speech.seconds / STEP) + 1) * STEP
        out.append(Utterance(spoken.sound.at_rate(RATE).samples, spoken.speech, articulate(spoken.speech, times)))
    return out


def label(speech: Speech, times: Float64[np.ndarray, " T"], names: list[str]) -> np.ndarray:
    """Return the place among `names` of what is said at times; silence where nothing is."""
    out = np.full(len(times), names.index(SILENCE))
    for one in speech.phonemes:
        out[np.searchsorted(times, one.start) : np.searchsorted(times, one.end)] = names.index(one.name)
    return out
