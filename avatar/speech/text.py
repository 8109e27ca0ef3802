"""Text to the sounds of its words: by espeak-ng where it is installed, else the CMU dictionary of pocketsphinx."""

from __future__ import annotations

import re
import shutil
import subprocess
import unicodedata
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from avatar.speech.phonemes import ipa_from_arpabet
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.paths import read_text

MOST_CHARACTERS = 20_000
"""Of a text that is spoken at once: some twenty minutes."""
PAUSES = ".,;:!?"
EXTRA = "talk"
# Marks at which a sentence breaks: not within numbers, behind one letter or behind a title.
_POINT = "".join(rf"(?<!\b{title})" for title in ("[A-Za-z]", "Dr", "Mr", "Ms", "St", "Mrs", "Prof")) + r"\."
_BREAK = re.compile(rf"((?:{_POINT}|[,;:!?])[{re.escape(PAUSES)}]*)(?=[\s\"'”’)\]]|$)")
_WAIT = 60.0  # seconds for espeak-ng
_ONES = (
    "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen seventeen "
    "eighteen nineteen"
).split()
_TENS = "twenty thirty forty fifty sixty seventy eighty ninety".split()

_SELDOM = ("AH", "ER", "IH")
# Words that carry no stress in a sentence.
_WEAK = frozenset(
    "a an the and or but nor as at by for from in into of on to with than that if is are was were be been am do does "
    "did has have had he him his i it its me my she her them they their us we our you your can could shall should will "
    "would may might must there some".split()
)

# Spelling to sound for words that no dictionary has; longer spellings first.
_LETTERS = {
    **{"tion": "SH AH0 N", "igh": "AY1", "tch": "CH", "ch": "CH", "sh": "SH", "th": "TH", "ph": "F", "ck": "K"},
    **{"ng": "NG", "qu": "K W", "wh": "W", "ee": "IY1", "ea": "IY1", "oo": "UW1", "ou": "AW1", "ow": "OW1"},
    **{"ai": "EY1", "ay": "EY1", "oi": "OY1", "oy": "OY1", "au": "AO1", "aw": "AO1", "er": "ER0", "ar": "AA1 R"},
    **{"or": "AO1 R", "ir": "ER1", "ur": "ER1", "a": "AE1", "b": "B", "c": "K", "d": "D", "e": "EH1", "f": "F"},
    **{"g": "G", "h": "HH", "i": "IH1", "j": "JH", "k": "K", "l": "L", "m": "M", "n": "N", "o": "AA1", "p": "P"},
    **{"q": "K", "r": "R", "s": "S", "t": "T", "u": "AH1", "v": "V", "w": "W", "x": "K S", "y": "IY0", "z": "Z"},
}


@dataclass
class Pronunciation:
    """A text as a voice reads it.

    Attributes:
        ipa: in espeak-ng's manner, words apart, with the text's pauses. guessed: words spelled out by rules.
        foreign: words left out, whose letters the language does not have.
    """

    ipa: str
    guessed: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)


def checked_text(text: str) -> str:
    """Return a text with single spaces.

    Raises:
        InputError: nothing to say in it, or too much.
    """
    text = " ".join(text.split())
    if not any(one.isalnum() for one in text):
        raise InputError("text", expected="at least one word", received=repr(text[:40]) if text else "none")
    if len(text) > MOST_CHARACTERS:
        raise InputError(
            "text",
            expected=f"at most {MOST_CHARACTERS} characters",
            received=str(len(text)),
            remedy="speak it in parts; the films can be joined",
        )
    return text


def pronounce(text: str, *, language: str = "en-us") -> Pronunciation:
    """Return the sounds of a text.

    Args:
        language: espeak-ng's name of it; the dictionary has American English alone.

    Raises:
        InputError: nothing to say, a language that cannot be pronounced, an espeak-ng that fails.
        MissingExtraError: neither the program nor the dictionary is installed.
    """
    text, foreign = _legible(checked_text(text), language)
    program = shutil.which("espeak-ng")
    if program is not None:
        return Pronunciation(_by_espeak(program, text, language), foreign=foreign)
    if not language.startswith("en"):
        raise InputError(
            f"language {language}",
            expected="English, which the dictionary has",
            received="no program espeak-ng on this machine for others",
            remedy="apt-get install espeak-ng",
        )
    return replace(_by_dictionary(text), foreign=foreign)


def no_words(text: str) -> InputError:
    """What to say of a text in which nothing can be pronounced."""
    return InputError(
        "text",
        expected="words that the voice's language has",
        received=repr(text[:40]),
        remedy="a recording in any language is followed by its sounds (--audio), and --voice names another voice",
    )


def words_of(text: str) -> list[str]:
    """Return the words of a text as the dictionary spells them, numbers in words."""
    return [word for token in _tokens(text) if token not in PAUSES for word in [token]]


def phones_of(word: str) -> tuple[list[str], bool]:
    """Return the ARPAbet phones of a word, with stress, and whether they were guessed from its spelling.

    Raises:
        MissingExtraError: pocketsphinx, whose dictionary is read, is not installed.
    """
    known = cmu_dictionary().get(word)
    if known is not None and word in _WEAK:
        return [one + "0" if one[0] in "AEIOU" else one for one in known.split()], False
    if known is not None:
        return _stressed(known), False
    if word.endswith("'s") and word[:-2] in cmu_dictionary():
        return [*_stressed(cmu_dictionary()[word[:-2]]), "Z"], False
    phones: list[str] = []
    at = 0
    while at < len(word):
        for length in (4, 3, 2, 1):
            sound = _LETTERS.get(word[at : at + length])
            if sound is not None:
                phones += sound.split()
                break
        at += length
    return phones or ["AH0"], True


@cache
def cmu_dictionary() -> dict[str, str]:
    """Return the words of pocketsphinx's CMU dictionary with their phones, without stress.

    Raises:
        MissingExtraError: it is not installed.
    """
    if find_spec("pocketsphinx") is None:
        raise MissingExtraError(
            "pocketsphinx (or the program espeak-ng)", extra=EXTRA, purpose="the pronunciation of words"
        )
    path = Path(str(files("pocketsphinx"))) / "model" / "en-us" / "cmudict-en-us.dict"
    rows = (line.split(None, 1) for line in read_text(path, subject="dictionary").splitlines())
    return {row[0]: row[1].strip() for row in rows if len(row) == 2}


def _legible(text: str, language: str) -> tuple[str, list[str]]:
    """The text without words in letters that English does not have, and these; others' letters are not known here.

    espeak-ng would say the names of such letters.

    Raises:
        InputError: no other word.
    """
    if not language.startswith("en"):
        return text, []
    words = text.split()
    foreign = [word for word in words if _is_foreign(word)]
    left = " ".join(word for word in words if word not in foreign)
    if foreign and not any(one.isalnum() for one in left):
        raise no_words(text)
    return left, [word.strip(PAUSES) for word in foreign]


def _is_foreign(word: str) -> bool:
    """Whether letters are of another script; one Greek letter alone is a sign, whose name is said."""
    letters = [unicodedata.name(one, "") for one in word if unicodedata.category(one) in ("Lu", "Ll", "Lt", "Lo")]
    strange = [name for name in letters if not name.startswith(("LATIN", "MICRO", "FEMININE", "MASCULINE"))]
    return bool(strange) and not (len(letters) == 1 and strange[0].startswith("GREEK"))


def _stressed(phones: str) -> list[str]:
    """Give a word its likely stress, which the dictionary leaves out: on its first full vowel, or its first.

    AH, ER and IH are seldom full, nor is IY at the end.
    """
    out = phones.split()
    vowels = [k for k, one in enumerate(out) if one[0] in "AEIOU"]
    full = [k for k in vowels if out[k] not in _SELDOM and (k, out[k]) != (len(out) - 1, "IY")]
    for k in vowels:
        out[k] += "1" if k == (full or vowels)[0] else "0"
    return out


def _by_espeak(program: str, text: str, language: str) -> str:
    """Ask the user's own espeak-ng; pauses are kept, which it drops."""
    parts = _BREAK.split(text)
    spoken = [part.strip() for part in parts[::2]]
    command = [program, "-q", "--ipa", "-b", "1", "-v", language, "--stdin"]
    out = ""
    for k, part in enumerate(spoken):
        if part:
            done = subprocess.run(command, input=part.encode(), capture_output=True, timeout=_WAIT, check=False)
            if done.returncode:
                said = done.stderr.decode(errors="replace").strip().splitlines() or ["it says nothing"]
                raise InputError(f"language {language}", expected="one that espeak-ng speaks", received=said[-1])
            # Names of languages in brackets say where it changes to another for a word.
            out += " " + " ".join(re.sub(r"\([a-z-]+\)", "", done.stdout.decode(errors="replace")).split())
        if 2 * k + 1 < len(parts):
            out += parts[2 * k + 1][0]
    return out.strip()


def _by_dictionary(text: str) -> Pronunciation:
    it = Pronunciation("")
    for token in _tokens(text):
        if token in PAUSES:
            it.ipa += token
            continue
        phones, guessed = phones_of(token)
        it.guessed += [token] if guessed and token not in it.guessed else []
        it.ipa += (" " if it.ipa else "") + ipa_from_arpabet(phones)
    if not it.ipa.strip(f" {PAUSES}"):
        raise no_words(text)
    return it


def _tokens(text: str) -> list[str]:
    """Words in lower case without accents, and pauses; numbers in words."""
    out: list[str] = []
    plain = "".join(one for one in unicodedata.normalize("NFKD", text) if not unicodedata.combining(one))
    for token in re.findall(rf"[a-z]+(?:'[a-z]+)?|\d+|[{re.escape(PAUSES)}]", plain.lower().replace("’", "'")):
        out += _in_words(token) if token.isdigit() else [token]
    return out


def _in_words(digits: str) -> list[str]:
    """A number in words below a million, its digits one by one from there."""
    value = int(digits) if len(digits) < 7 else 10**6
    if value >= 10**6 or (len(digits) > 1 and digits[0] == "0"):
        return [_ONES[int(one)] for one in digits]
    if value < 20:
        return [_ONES[value]]
    if value < 100:
        return [_TENS[value // 10 - 2], *([_ONES[value % 10]] if value % 10 else [])]
    unit, name = (100, "hundred") if value < 1000 else (1000, "thousand")
    rest = _in_words(str(value % unit)) if value % unit else []
    return [*_in_words(str(value // unit)), name, *rest]
