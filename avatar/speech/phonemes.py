"""Phonemes in time, by their ARPAbet names without stress: the result of every engine, and the input of the mouth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from smplxpp.core.errors import InputError

SILENCE = "SIL"
VOWELS = frozenset(("AA", "AE", "AH", "AO", "AW", "AY", "EH", "ER", "EY", "IH", "IY", "OW", "OY", "UH", "UW"))
CONSONANTS = frozenset(
    (
        *("B", "CH", "D", "DH", "F", "G", "HH", "JH", "K", "L", "M", "N"),
        *("NG", "P", "R", "S", "SH", "T", "TH", "V", "W", "Y", "Z", "ZH"),
    )
)
BILABIALS = frozenset(("P", "B", "M"))
"""Consonants for which the lips close."""
LABIODENTALS = frozenset(("F", "V"))
"""Consonants for which the lower lip meets the upper teeth."""

# IPA as espeak-ng and Piper write English, and the nearest sounds of other languages; longer symbols first.
_IPA = {
    **{"aɪ": "AY", "aʊ": "AW", "eɪ": "EY", "oʊ": "OW", "əʊ": "OW", "ɔɪ": "OY", "tʃ": "CH", "dʒ": "JH"},
    **{"ɑ": "AA", "a": "AA", "ɐ": "AH", "ɒ": "AO", "æ": "AE", "ʌ": "AH", "ə": "AH", "ɔ": "AO", "ɛ": "EH", "e": "EY"},
    **{"ɜ": "ER", "ɝ": "ER", "ɚ": "ER", "ɪ": "IH", "i": "IY", "ᵻ": "IH", "ɨ": "IH", "o": "OW", "ʊ": "UH", "u": "UW"},
    **{"y": "UW", "ø": "UH", "œ": "ER", "b": "B", "d": "D", "ð": "DH", "f": "F", "ɡ": "G", "g": "G", "h": "HH"},
    **{"x": "HH", "ç": "HH", "k": "K", "c": "K", "l": "L", "ɫ": "L", "m": "M", "n": "N", "ɲ": "N", "ŋ": "NG", "p": "P"},
    **{"ɬ": "L", "ɭ": "L", "ʎ": "L", "ɖ": "D", "ʈ": "T", "q": "K", "ɣ": "G", "χ": "HH", "ʂ": "SH", "ɕ": "SH", "ɸ": "F"},
    **{"ɹ": "R", "r": "R", "ʁ": "R", "s": "S", "ʃ": "SH", "t": "T", "ɾ": "D", "θ": "TH", "v": "V", "β": "V"},
    **{"w": "W", "j": "Y", "z": "Z", "ʒ": "ZH"},
}
_TO_IPA = {
    **{"AA": "ɑː", "AE": "æ", "AH": "ʌ", "AO": "ɔː", "AW": "aʊ", "AY": "aɪ", "EH": "ɛ", "ER": "ɜː", "EY": "eɪ"},
    **{"IH": "ɪ", "IY": "iː", "OW": "oʊ", "OY": "ɔɪ", "UH": "ʊ", "UW": "uː", "B": "b", "CH": "tʃ", "D": "d"},
    **{"DH": "ð", "F": "f", "G": "ɡ", "HH": "h", "JH": "dʒ", "K": "k", "L": "l", "M": "m", "N": "n", "NG": "ŋ"},
    **{"P": "p", "R": "ɹ", "S": "s", "SH": "ʃ", "T": "t", "TH": "θ", "V": "v", "W": "w", "Y": "j", "Z": "z"},
    "ZH": "ʒ",
}
_UNSTRESSED = {"AH": "ə", "ER": "ɚ", "IY": "i"}  # as espeak-ng writes these vowels without stress


@dataclass(frozen=True)
class Phoneme:
    """One phoneme with its start and end.

    Attributes:
        name: ARPAbet without stress, or `SILENCE`.
        start: seconds.
        end: seconds.
        stress: of a vowel: 1 primary, 2 secondary, 0 none or unknown.
    """

    name: str
    start: float
    end: float
    stress: int = 0


@dataclass(frozen=True)
class Word:
    """One word of a recording with its start and end.

    Attributes:
        text: as the dictionary or the given text spells it, lower case.
        start: seconds.
        end: seconds.
    """

    text: str
    start: float
    end: float


@dataclass(frozen=True)
class Speech:
    """The phonemes of an utterance in time.

    Attributes:
        phonemes: in order of time; gaps are silent.
        seconds: length of the sound.
        words: those that were aligned with a recording, in order; empty where none were.

    Raises:
        InputError: unknown phonemes, or times that run backwards, overlap or leave the sound.
    """

    phonemes: tuple[Phoneme, ...]
    seconds: float
    words: tuple[Word, ...] = ()

    def __post_init__(self) -> None:
        # Phonemes are sorted and do not overlap; 1e-6 s absorbs rounding of frame times.
        last = 0.0
        for k, one in enumerate(self.phonemes):
            if one.name not in VOWELS | CONSONANTS | {SILENCE}:
                raise InputError(f"phoneme {k}", expected="ARPAbet without stress, or SIL", received=repr(one.name))
            if not last - 1e-6 <= one.start < one.end <= self.seconds + 1e-6:
                raise InputError(
                    f"phoneme {k} ({one.name})",
                    expected=f"times in order within {last:.3f} to {self.seconds:.3f} s",
                    received=f"{one.start:.3f} to {one.end:.3f}",
                )
            last = one.end

    @property
    def spoken(self) -> tuple[Phoneme, ...]:
        """The phonemes that are not silences."""
        return tuple(one for one in self.phonemes if one.name != SILENCE)

    @property
    def transcript(self) -> str:
        """The words in one line; "" where none were aligned."""
        return " ".join(one.text for one in self.words)


def arpabet_from_ipa(text: str, at: int) -> tuple[str, int]:
    """Return the phoneme at a position of an IPA text, and its number of characters.

    A diacritic (length, stress, tie) or an unknown sound gives "" and one character.
    """
    for length in (2, 1):
        name = _IPA.get(text[at : at + length])
        if name is not None:
            return name, length
    return "", 1


def ipa_from_arpabet(phones: Sequence[str]) -> str:
    """Write a word's ARPAbet phones, with or without stress digits, in IPA as espeak-ng does."""
    out = ""
    for phone in phones:
        # The stress mark stands before the vowel; three vowels without stress have IPA symbols of their own.
        name, stress = phone.rstrip("012"), phone[-1:]
        mark = {"1": "ˈ", "2": "ˌ"}.get(stress, "")
        out += mark + (_UNSTRESSED.get(name, _TO_IPA[name]) if stress == "0" else _TO_IPA[name])
    return out
