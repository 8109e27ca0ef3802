"""Sound to phonemes in time by pocketsphinx: the words recognised or given, then their phones aligned."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np

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
_LEADS = (0.0, 0.1, 0.005)  # seconds of silence put ahead of a sound in which the search lost its way
_LOUD = 0.1  # root mean square that the recogniser is given


def aligns() -> bool:
    """Whether the recogniser is installed."""
    return find_spec("pocketsphinx") is not None


def align(sound: Sound, text: str | None = None) -> Speech:
    """Return the phonemes of a recording of English.

    Args:
        text: what is said in it; None: recognised.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
        InputError: silence, no words in it, a text without English words or one that cannot be laid over the sound,
            more than 20 minutes.
    """
    seconds, level = sound.seconds, spoken_level(sound)
    try:
        import pocketsphinx
    except ImportError:
        raise MissingExtraError("pocketsphinx", extra=EXTRA, purpose="phonemes of a recording") from None
    samples = sound.at_rate(_RATE)
    data = Sound(samples.samples * np.float32(_LOUD / level), _RATE).integers().tobytes()
    decoder = pocketsphinx.Decoder(samprate=float(_RATE), loglevel="FATAL")
    words = _recognised(decoder, data) if text is None else _words(text)
    for word in dict.fromkeys(words):
        if decoder.lookup_word(word) is None:
            decoder.add_word(word, " ".join(one.rstrip("012") for one in phones_of(word)[0]), True)
    tries = (_aligned(decoder, data, words, lead=lead) for lead in _LEADS)
    found = next((one for one in tries if one is not None), None)
    if found is None:
        raise InputError(
            "sound",
            expected="English speech that can be aligned" if text is None else "what the text says",
            received="something else",
            remedy="give what is said in it as --text" if text is None else "leave --text away: it is recognised then",
        )
    speech = Speech(tuple(without_rests(_clipped(found, seconds), find_rests(sound))), seconds)
    if not speech.spoken:  # words that are noises
        raise _nobody()
    return speech


def _recognised(decoder: Any, data: bytes) -> list[str]:
    _heard(decoder, data)
    words = [one.word.split("(")[0] for one in decoder.seg() or ()]
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


def _heard(decoder: Any, data: bytes) -> None:
    decoder.start_utt()
    decoder.process_raw(data, full_utt=True)
    decoder.end_utt()


def _aligned(decoder: Any, data: bytes, words: list[str], *, lead: float) -> list[Phoneme] | None:
    """Two passes: the words' times, then those of the phones within; None where they do not fit the sound.

    The search prunes, and now and then loses a sentence that it finds with its frames laid elsewhere: with so many
    seconds of silence in front.
    """
    data = bytes(2 * round(lead * _RATE)) + data
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
            start = phone.start * _FRAME + _OFFSET - lead
            stress = next(stresses) if phone.name in VOWELS else 0
            out.append(Phoneme(phone.name if known else SILENCE, start, start + phone.duration * _FRAME, stress))
    return out


def _stresses(word: str, count: int) -> list[int]:
    """The stress of a word's so many vowels, by the dictionary; none where it has another number of them."""
    known = [int(one[-1]) for one in phones_of(word)[0] if one[-1].isdigit()]
    return known if len(known) == count else [0] * count


def _clipped(phonemes: list[Phoneme], seconds: float) -> list[Phoneme]:
    """Phonemes within the sound: the first and the last frame may leave it."""
    held = [replace(one, start=max(one.start, 0.0), end=min(one.end, seconds)) for one in phonemes]
    return [one for one in held if one.end > one.start]
