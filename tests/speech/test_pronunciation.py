"""Texts to be said: what is refused, numbers in words, and pronunciation where the dictionary is installed."""

from __future__ import annotations

import shutil

import pytest

from avatar.speech.pronunciation import MAX_CHARACTERS, check_text, phones_from_word, pronounce, words_from_text
from smplxpp.core.errors import InputError


@pytest.mark.parametrize(
    ("text", "word"), [("", "none"), ("  \n", "none"), ("?! ...", "word"), ("a " * 20_000, "parts")]
)
def test_nothing_to_say_and_too_much_is_refused(text, word):
    with pytest.raises(InputError, match=word):
        check_text(text)
    assert len(check_text("a" * MAX_CHARACTERS)) == MAX_CHARACTERS


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("I’m 21, you 0!", "i'm twenty one you zero"),
        ("1999 is 007", "one thousand nine hundred ninety nine is zero zero seven"),
        ("100 300000", "one hundred three hundred thousand"),
        ("12345678", "one two three four five six seven eight"),
        ("Ünder — «mañana»", "under manana"),
        ("½ ²", "one two two"),
    ],
)
def test_words(text, words):
    assert words_from_text(text) == words.split()


def test_words_of_the_dictionary_and_others():
    pytest.importorskip("pocketsphinx", reason="the dictionary is part of the extra talk")
    assert phones_from_word("hello") == (["HH", "AH0", "L", "OW1"], False)
    assert phones_from_word("dog's")[0][-1] == "Z"
    phones, guessed = phones_from_word("brimblesh")
    assert guessed and [one.rstrip("012") for one in phones] == ["B", "R", "IH", "M", "B", "L", "EH", "SH"]
    if shutil.which("espeak-ng") is None:
        said = pronounce("Hello, brimblesh.")
        assert said.ipa.startswith("həlˈoʊ, ") and said.ipa.endswith(".") and said.guessed == ["brimblesh"]
        with pytest.raises(InputError, match="espeak-ng"):
            pronounce("Guten Tag", language="de")


@pytest.mark.parametrize("text", ["Привет, как дела?", "你好 世界!", "Καλημέρα"])
def test_letters_that_english_does_not_have_are_no_words_of_it(text):
    """The voice said "chinese letter" for each of them, or, by the dictionary, ended in a ValueError."""
    with pytest.raises(InputError, match="voice's language"):
        pronounce(text)


@pytest.mark.parametrize("program", [None, shutil.which("espeak-ng")])
def test_words_in_other_letters_are_left_out_and_named(program, monkeypatch):
    if program is None:
        pytest.importorskip("pocketsphinx", reason="the dictionary is part of the extra talk")
    monkeypatch.setattr(shutil, "which", lambda _: program)
    said = pronounce("Hello Привет, café 你好.")
    assert said.foreign == ["Привет", "你好"] and not said.guessed
    assert said.ipa.startswith("həl") and "lɛɾɚ" not in said.ipa


def test_a_text_without_a_word_of_the_dictionary_is_refused(monkeypatch):
    pytest.importorskip("pocketsphinx", reason="the dictionary is part of the extra talk")
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(InputError, match="voice's language"):
        pronounce("π")
    assert pronounce("x² is 4").ipa
