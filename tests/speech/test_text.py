"""Texts to be said: what is refused, numbers in words, and pronunciation where the dictionary is installed."""

from __future__ import annotations

import shutil

import pytest

from avatar.speech.text import MOST_CHARACTERS, checked_text, phones_of, pronounce, words_of
from smplxpp.core.errors import InputError


@pytest.mark.parametrize(
    ("text", "word"), [("", "none"), ("  \n", "none"), ("?! ...", "word"), ("a " * 20_000, "parts")]
)
def test_nothing_to_say_and_too_much_is_refused(text, word):
    with pytest.raises(InputError, match=word):
        checked_text(text)
    assert len(checked_text("a" * MOST_CHARACTERS)) == MOST_CHARACTERS


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("I’m 21, you 0!", "i'm twenty one you zero"),
        ("1999 is 007", "one thousand nine hundred ninety nine is zero zero seven"),
        ("100 300000", "one hundred three hundred thousand"),
        ("12345678", "one two three four five six seven eight"),
        ("Ünder — «mañana»", "nder ma ana"),
    ],
)
def test_words(text, words):
    assert words_of(text) == words.split()


def test_words_of_the_dictionary_and_others():
    pytest.importorskip("pocketsphinx", reason="the dictionary is part of the extra talk")
    assert phones_of("hello") == (["HH", "AH0", "L", "OW1"], False)
    assert phones_of("dog's")[0][-1] == "Z"
    phones, guessed = phones_of("brimblesh")
    assert guessed and [one.rstrip("012") for one in phones] == ["B", "R", "IH", "M", "B", "L", "EH", "SH"]
    if shutil.which("espeak-ng") is None:
        said = pronounce("Hello, brimblesh.")
        assert said.ipa.startswith("həlˈoʊ, ") and said.ipa.endswith(".") and said.guessed == ["brimblesh"]
        with pytest.raises(InputError, match="espeak-ng"):
            pronounce("Guten Tag", language="de")
