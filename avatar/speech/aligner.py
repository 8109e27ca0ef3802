"""Sound to phonemes in time by pocketsphinx: the words recognised or given, then their phones aligned."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from avatar.speech.lips import LipNetwork, agreement
from avatar.speech.phonemes import CONSONANTS, SILENCE, VOWELS, Phoneme, Speech
from avatar.speech.rests import find_rests, spoken_level, without_rests
from avatar.speech.text import EXTRA, checked_text, no_words, phones_of, words_of
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.wave_file import Sound

_RATE = 16_000
_FRAME = 0.01  # seconds
_WINDOW = 0.025625  # seconds of sound that the recogniser sees for a frame, from the frame's time on
# A frame stands for the sound about its window's middle: half a frame ahead of it, it begins.
_OFFSET = 0.5 * (_WINDOW - _FRAME)
_LOUD = 0.1  # root mean square that the recogniser is given
_HISS = 1e-3  # root mean square of white noise laid under a text's sound: the stops of a made voice are zeros
AGREES = 0.0
"""Nats a hundredth of a second: texts whose phonemes fit what is heard less well are another recording's."""
RECOGNISED_AGREE = -0.35
"""The same for words that were recognised: some may be wrong, and most of their sounds right."""


def aligns() -> bool:
    """Whether the recogniser is installed."""
    return find_spec("pocketsphinx") is not None


def load_recogniser() -> Any:
    """Return pocketsphinx's `Decoder` of English: for `align`, where it is called more than once.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
    """
    try:
        import pocketsphinx
    except ImportError:
        raise MissingExtraError("pocketsphinx", extra=EXTRA, purpose="phonemes of a recording") from None
    return pocketsphinx.Decoder(samprate=float(_RATE), loglevel="FATAL")


def align(sound: Sound, text: str | None = None, *, recogniser: Any | None = None) -> Speech:
    """Return the phonemes of a recording of English.

    Words, given or recognised, are taken where the recogniser finds a way through them and their phonemes fit what the
    network of `avatar.speech.lips` hears at their times (`agreement`): tones may be heard as words, too.

    Args:
        text: what is said in it; None: recognised.
        recogniser: of `load_recogniser`; None: another one, which takes a second.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
        InputError: silence, no words in it, a text without English words or one that it does not say, more than 20
            minutes.
    """
    spoken_level(sound)
    decoder = load_recogniser() if recogniser is None else recogniser
    words = recognised_words(sound, decoder) if text is None else _words(text)
    found = _aligned(decoder, sound, words)
    least = RECOGNISED_AGREE if text is None else AGREES
    if found is None or agreement(LipNetwork.shipped()(sound), found) < least:
        raise _nobody() if text is None else _something_else()
    speech = Speech(tuple(without_rests(found.phonemes, find_rests(sound))), sound.seconds)
    if not speech.spoken:  # words that are noises
        raise _nobody()
    return speech


def aligned_text(sound: Sound, text: str, recogniser: Any) -> Speech | None:
    """Return the recogniser's phonemes of a text, whether or not they fit what is heard; None where it finds no way."""
    return _aligned(recogniser, sound, _words(text))


def recognised_words(sound: Sound, recogniser: Any) -> list[str]:
    """Return the words of English that the recogniser hears, as its dictionary spells them.

    Raises:
        InputError: silence, no words in it, more than 20 minutes.
    """
    recogniser.config["bestpath"] = True
    recogniser.activate_search()
    _heard(recogniser, _samples(sound))
    words = [one.word.split("(")[0] for one in recogniser.seg() or ()]
    words = [word for word in words if word[0] not in "<["]
    if not words:
        raise _nobody()
    return words


def _words(text: str) -> list[str]:
    words = words_of(checked_text(text))
    if not words:
        raise no_words(text)
    return words


def _nobody() -> InputError:
    return InputError(
        "sound",
        expected="words of English",
        received="none that the recogniser knows (music, noise or another language)",
        remedy="give what is said in it as --text, or --hear sounds, which follows any language",
    )


def _something_else() -> InputError:
    return InputError(
        "sound",
        expected="what the text says",
        received="something else",
        remedy="leave --text away: it is recognised then",
    )


def _samples(sound: Sound, hiss: float = 0.0) -> bytes:
    samples = sound.at_rate(_RATE).samples * np.float32(_LOUD / spoken_level(sound))
    noise = np.random.default_rng(0).normal(scale=hiss, size=len(samples)).astype(np.float32)
    return Sound(samples + noise, _RATE).integers().tobytes()


def _heard(decoder: Any, data: bytes) -> None:
    decoder.start_utt()
    decoder.process_raw(data, full_utt=True)
    decoder.end_utt()


def _aligned(decoder: Any, sound: Sound, words: list[str]) -> Speech | None:
    """Two passes: the words' times, then those of the phones within; None where they do not fit the sound.

    The first takes its search's own best path: that through the lattice of what it kept (`bestpath`), which language
    models ask for, has no way through many a sentence that the search has found.
    """
    data = _samples(sound, _HISS)
    for word in dict.fromkeys(words):
        if decoder.lookup_word(word) is None:
            decoder.add_word(word, " ".join(one.rstrip("012") for one in phones_of(word)[0]), True)
    decoder.config["bestpath"] = False
    try:
        decoder.set_align_text(" ".join(words))
        _heard(decoder, data)
        decoder.set_alignment()
        _heard(decoder, data)
        alignment = decoder.get_alignment()
    except RuntimeError:
        return None
    if alignment is None:
        return None
    out = []
    for word in alignment:
        phones = [phone for phone in word if phone.duration > 0]
        vowels = [phone.name for phone in phones if phone.name in VOWELS]
        stresses = iter(_stresses(word.name.split("(")[0], len(vowels)))
        for phone in phones:
            known = phone.name in VOWELS | CONSONANTS
            start = phone.start * _FRAME + _OFFSET
            stress = next(stresses) if phone.name in VOWELS else 0
            out.append(Phoneme(phone.name if known else SILENCE, start, start + phone.duration * _FRAME, stress))
    return Speech(tuple(_clipped(out, sound.seconds)), sound.seconds)


def _stresses(word: str, count: int) -> list[int]:
    """The stress of a word's so many vowels, by the dictionary; none where it has another number of them."""
    known = [int(one[-1]) for one in phones_of(word)[0] if one[-1].isdigit()]
    return known if len(known) == count else [0] * count


def _clipped(phonemes: list[Phoneme], seconds: float) -> list[Phoneme]:
    """Phonemes within the sound: the first and the last frame may leave it."""
    held = [replace(one, start=max(one.start, 0.0), end=min(one.end, seconds)) for one in phonemes]
    return [one for one in held if one.end > one.start]
