"""Grapheme-to-phoneme conversion: by espeak-ng where it is installed, else by the CMU dictionary of pocketsphinx."""

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
from avatar.speech.spoken_text import speak_text
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.paths import read_text

MAX_CHARACTERS = 20_000
"""Longest text that is spoken at once: about twenty minutes."""
PAUSES = ".,;:!?"
"""Punctuation marks that are spoken as pauses."""
EXTRA = "talk"
"""The optional dependencies of this room."""
# Marks at which a sentence breaks, except within numbers, after a single letter and after a title.
_POINT = "".join(rf"(?<!\b{title})" for title in ("[A-Za-z]", "Dr", "Mr", "Ms", "St", "Mrs", "Prof")) + r"\."
_BREAK = re.compile(rf"((?:{_POINT}|[,;:!?])[{re.escape(PAUSES)}]*)(?=[\s\"'”’)\]]|$)")

# Function words, which carry no stress in a sentence.
_UNSTRESSED_WORDS = frozenset(
    "a an the and or but nor as at by for from in into of on to with than that if is are was were be been am do does "
    "did has have had he him his i it its me my she her them they their us we our you your can could shall should will "
    "would may might must there some".split()
)

# Spelling rules for words that are not in the dictionary; longer spellings are tried first.
_SPELLING_RULES = {
    **{"tion": "SH AH0 N", "igh": "AY1", "tch": "CH", "ch": "CH", "sh": "SH", "th": "TH", "ph": "F", "ck": "K"},
    **{"ng": "NG", "qu": "K W", "wh": "W", "ee": "IY1", "ea": "IY1", "oo": "UW1", "ou": "AW1", "ow": "OW1"},
    **{"ai": "EY1", "ay": "EY1", "oi": "OY1", "oy": "OY1", "au": "AO1", "aw": "AO1", "er": "ER0", "ar": "AA1 R"},
    **{"or": "AO1 R", "ir": "ER1", "ur": "ER1", "a": "AE1", "b": "B", "c": "K", "d": "D", "e": "EH1", "f": "F"},
    **{"g": "G", "h": "HH", "i": "IH1", "j": "JH", "k": "K", "l": "L", "m": "M", "n": "N", "o": "AA1", "p": "P"},
    **{"q": "K", "r": "R", "s": "S", "t": "T", "u": "AH1", "v": "V", "w": "W", "x": "K S", "y": "IY0", "z": "Z"},
}


@dataclass
class Pronunciation:
    """The pronunciation of a text in IPA.

    Attributes:
        ipa: as espeak-ng writes it, words separated by spaces, with the text's pauses.
        guessed: words pronounced by spelling rules.
        foreign: words left out, because the language does not have their letters.
    """

    ipa: str
    guessed: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)


def check_text(text: str) -> str:
    """Return a text with single spaces, checked to have something to speak.

    Raises:
        InputError: no word, or more than `MAX_CHARACTERS`.
    """
    text = " ".join(text.split())
    if not any(one.isalnum() for one in text):
        raise InputError("text", expected="at least one word", received=repr(text[:40]) if text else "none")
    if len(text) > MAX_CHARACTERS:
        raise InputError(
            "text",
            expected=f"at most {MAX_CHARACTERS} characters",
            received=str(len(text)),
            remedy="speak it in parts; the films can be joined",
        )
    return text


# By the script as Unicode names it: languages that are written in it, and how Piper's voices of them begin.
_VOICES = {
    **{"CYRILLIC": "Russian (ru_RU), Ukrainian (uk_UA) or Serbian (sr_RS)", "GREEK": "Greek (el_GR)"},
    **{"ARABIC": "Arabic (ar_JO) or Persian (fa_IR)", "DEVANAGARI": "Hindi (hi_IN) or Nepali (ne_NP)"},
    **{"HIRAGANA": "Japanese", "KATAKANA": "Japanese", "HANGUL": "Korean", "CJK": "Chinese (zh_CN)"},
    **{"GEORGIAN": "Georgian (ka_GE)", "MALAYALAM": "Malayalam (ml_IN)", "TELUGU": "Telugu (te_IN)"},
}


def pronounce(text: str, *, language: str = "en-us") -> Pronunciation:
    """Return the pronunciation of a text.

    Args:
        text: words of the language.
        language: as espeak-ng names it; the dictionary has American English only.

    Raises:
        InputError: no word, a language that cannot be pronounced, an espeak-ng that fails.
        MissingExtraError: neither the program nor the dictionary is installed.
    """
    text, foreign = _drop_foreign_words(check_text(text), language)
    text = speak_text(text) if language.startswith("en") else text
    program = shutil.which("espeak-ng")
    if program is not None:
        return Pronunciation(_by_espeak(program, text, language), foreign=foreign)
    if not language.startswith("en"):
        raise InputError(
            f"language {language}",
            expected="English, the language of the dictionary",
            received="another language, without the program espeak-ng",
            remedy="apt-get install espeak-ng",
        )
    return replace(_by_dictionary(text), foreign=foreign)


def no_words_error(text: str) -> InputError:
    """Return the error for a text without a word that can be pronounced: it names the voices that a script needs."""
    names = " ".join(unicodedata.name(one, "") for one in text)
    needed = next((voices for script, voices in _VOICES.items() if script in names), "the text's language")
    return InputError(
        "text",
        expected="words that the voice's language has",
        received=repr(text[:40]),
        remedy=f"give a voice of {needed} with --voice NAME.onnx, NAME.onnx.json beside it (Piper's are at "
        "https://huggingface.co/rhasspy/piper-voices; the program espeak-ng pronounces their languages), or a recording"
        ", whose sounds are followed in any language, with --audio",
    )


def words_from_text(text: str) -> list[str]:
    """Return the words of a text as the dictionary spells them, numbers spelled out."""
    return [token for token in _tokens(text) if token not in PAUSES]


def phones_from_word(word: str) -> tuple[list[str], bool]:
    """Return the ARPAbet phones of a word, with stress, and whether spelling rules guessed them.

    Raises:
        MissingExtraError: pocketsphinx, whose dictionary is read, is not installed.
    """
    # The dictionary, with the possessive taken off where needed.
    known = cmu_dictionary().get(word)
    if known is not None and word in _UNSTRESSED_WORDS:
        return [one + "0" if one[0] in "AEIOU" else one for one in known.split()], False
    if known is not None:
        return _add_stress(known), False
    if word.endswith("'s") and word[:-2] in cmu_dictionary():
        return [*_add_stress(cmu_dictionary()[word[:-2]]), "Z"], False
    # Spelling rules, the longest that matches first.
    phones: list[str] = []
    at = 0
    while at < len(word):
        for length in (4, 3, 2, 1):
            sound = _SPELLING_RULES.get(word[at : at + length])
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
    # One word a line, followed by its phones; alternative pronunciations have names such as "word(2)".
    path = Path(str(files("pocketsphinx"))) / "model" / "en-us" / "cmudict-en-us.dict"
    rows = (line.split(None, 1) for line in read_text(path, subject="dictionary").splitlines())
    return {row[0]: row[1].strip() for row in rows if len(row) == 2}


def _drop_foreign_words(text: str, language: str) -> tuple[str, list[str]]:
    """Split an English text into what can be pronounced and the words in foreign scripts.

    espeak-ng would spell such words letter by letter. Texts of other languages are returned whole.

    Raises:
        InputError: all words are foreign.
    """
    if not language.startswith("en"):
        return text, []
    words = text.split()
    foreign = [word for word in words if _is_foreign(word)]
    left = " ".join(word for word in words if word not in foreign)
    if foreign and not any(one.isalnum() for one in left):
        raise no_words_error(text)
    return left, [word.strip(PAUSES) for word in foreign]


def _is_foreign(word: str) -> bool:
    """Return whether a word has letters of another script; a single Greek letter is a symbol with a name."""
    # Unicode names begin with the script: "LATIN SMALL LETTER A". Ordinal and micro signs count as Latin.
    letters = [unicodedata.name(one, "") for one in word if unicodedata.category(one) in ("Lu", "Ll", "Lt", "Lo")]
    strange = [name for name in letters if not name.startswith(("LATIN", "MICRO", "FEMININE", "MASCULINE"))]
    return bool(strange) and not (len(letters) == 1 and strange[0].startswith("GREEK"))


def _add_stress(phones: str) -> list[str]:
    """Add the likely stress, which the dictionary lacks: on the first full vowel, or else the first vowel.

    AH, ER, IH and a final IY are counted as reduced vowels.
    """
    # ARPAbet's vowels are the phones that begin with a vowel letter.
    out = phones.split()
    vowels = [k for k, one in enumerate(out) if one[0] in "AEIOU"]
    full = [k for k in vowels if out[k] not in ("AH", "ER", "IH") and (k, out[k]) != (len(out) - 1, "IY")]
    for k in vowels:
        out[k] += "1" if k == (full or vowels)[0] else "0"
    return out


def _by_espeak(program: str, text: str, language: str) -> str:
    """Run espeak-ng on the parts between pauses, because it drops the pauses."""
    parts = _BREAK.split(text)
    spoken = [part.strip() for part in parts[::2]]
    command = [program, "-q", "--ipa", "-b", "1", "-v", language, "--stdin"]
    out = ""
    for k, part in enumerate(spoken):
        if part:
            done = subprocess.run(command, input=part.encode(), capture_output=True, timeout=60.0, check=False)
            if done.returncode:
                message = done.stderr.decode(errors="replace").strip().splitlines() or ["an error without a message"]
                raise InputError(f"language {language}", expected="one that espeak-ng speaks", received=message[-1])
            # Remove the names of languages in brackets, which mark words of another language.
            out += " " + " ".join(re.sub(r"\([a-z-]+\)", "", done.stdout.decode(errors="replace")).split())
        if 2 * k + 1 < len(parts):
            out += parts[2 * k + 1][0]
    return out.strip()


def _by_dictionary(text: str) -> Pronunciation:
    out = Pronunciation("")
    for token in _tokens(text):
        if token in PAUSES:
            out.ipa += token
            continue
        phones, guessed = phones_from_word(token)
        out.guessed += [token] if guessed and token not in out.guessed else []
        out.ipa += (" " if out.ipa else "") + ipa_from_arpabet(phones)
    if not out.ipa.strip(f" {PAUSES}"):
        raise no_words_error(text)
    return out


def _tokens(text: str) -> list[str]:
    """Return words in lower case without accents, numbers and signs as they are spoken, and pauses."""
    out: list[str] = []
    # NFKD splits accented letters into letter and accent, which is dropped: "cafe" is in the dictionary, "café" is
    # not.
    plain = "".join(one for one in unicodedata.normalize("NFKD", speak_text(text)) if not unicodedata.combining(one))
    for token in re.findall(rf"[A-Za-z]+(?:'[A-Za-z]+)?|[{re.escape(PAUSES)}]", plain):
        # Short words in capitals that no dictionary has are said by their letters.
        spelled = token.isupper() and 2 <= len(token) <= 5 and token.lower() not in cmu_dictionary()
        out += list(token.lower()) if spelled else [token.lower()]
    return out
