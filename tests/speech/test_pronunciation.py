"""Texts to be said: what is refused, numbers in words, and pronunciation where the dictionary is installed."""

from __future__ import annotations

import re
import shutil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar.speech.pronunciation import MAX_CHARACTERS, check_text, phones_from_word, pronounce, words_from_text
from avatar.speech.spoken_text import speak_text
from avatar.speech.voice import _pieces
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
        ("12345678", "twelve million three hundred forty five thousand six hundred seventy eight"),
        ("1" * 16, "one " * 16),
        ("Ünder — «mañana»", "under manana"),
        ("½ 3²", "a half three squared"),
    ],
)
def test_words(text, words):
    assert words_from_text(text) == words.split()


@pytest.mark.parametrize(
    ("text", "spoken"),
    [
        ("Pi is 3.14, not .5.", "Pi is three point one four, not point five."),
        ("It costs $100,000 or €2.50.", "It costs one hundred thousand dollars or two euros and fifty cents."),
        (
            "£1.01, $1.5 million, $10-20, 5€",
            "one pound and one penny, one point five million dollars, ten to twenty dollars, five euros",
        ),
        ("-5 degrees, 20°C, 50% off", "minus five degrees, twenty degrees Celsius, fifty percent off"),
        ("salt & pepper", "salt and pepper"),
        ("2 + 2 = 4 < 5", "two plus two equals four less than five"),
        ("the 21st, 2nd and 112th", "the twenty first, second and one hundred twelfth"),
        (
            "Dr. Smith met Mr. Jones on Main St. in St. Paul.",
            "doctor Smith met mister Jones on Main street. in saint Paul.",
        ),
        ("At 3:05 p.m. Then at 15:00 or 10am.", "At three oh five p m. Then at fifteen o'clock or ten a m."),
        ("Nov. 21, 2026", "November twenty first twenty twenty six"),
        (
            "2026-11-27 or 12/25/2024",
            "November twenty seventh twenty twenty six or December twenty fifth twenty twenty four",
        ),
        ("In 1999 and the 1990s 2000 left.", "In nineteen ninety nine and the nineteen nineties two thousand left."),
        ("5 kg at 60 km/h for 1 min", "five kilograms at sixty kilometers per hour for one minute"),
        ("1/2 cup, 1½ cups, 24/7", "one half cup, one and a half cups, twenty four seven"),
        ("pages 10-20, No. 5, #7", "pages ten to twenty, number five, number seven"),
        ("v1.2.3 of me@foo.com", "v one point two point three of me at foo dot com"),
        ("See https://www.example.com/a-b.", "See example dot com slash a dash b."),
        ("5'10\" and/or 7-eleven", "five foot ten and or seven-eleven"),
        ("1,234,567 people", "one million two hundred thirty four thousand five hundred sixty seven people"),
        ("You may 5 times on May 5", "You may five times on May fifth"),
        (
            "a 20 kg bag, 20 kg of 1920x2 at 10x",
            "a twenty kilogram bag, twenty kilograms of one thousand nine hundred twenty by two at ten times",
        ),
    ],
)
def test_numbers_signs_and_abbreviations_are_spoken(text, spoken):
    assert speak_text(text) == spoken


# Numbers, money, dates, times, units and abbreviations, and the words of each as they are spoken.
SIXTY = """
I have 7 cats. | i have seven cats
It holds 1,024 files. | it holds one thousand twenty four files
Pi is 3.14159. | pi is three point one four one five nine
There were 100,000 people. | there were one hundred thousand people
It is -12 outside. | it is minus twelve outside
Room 305 is free. | room three hundred five is free
Add 2 + 2 = 4. | add two plus two equals four
A 4x4 grid | a four by four grid
3/4 of them | three quarters of them
0.5 seconds | zero point five seconds
1,000,000 users | one million users
He came 1st, she 2nd, I 23rd. | he came first she second i twenty third
It costs $100,000. | it costs one hundred thousand dollars
$3.50 please | three dollars and fifty cents please
Only $1! | only one dollar
That is €20. | that is twenty euros
£5.99 each | five pounds and ninety nine pence each
$1.5 million was raised | one point five million dollars was raised
$2bn deal | two billion dollars deal
between $10 and $20 | between ten dollars and twenty dollars
It is $0.99. | it is ninety nine cents
¥500 is enough | five hundred yen is enough
Born on July 4, 1976. | born on july fourth nineteen seventy six
On 2024-03-15 we met. | on march fifteenth twenty twenty four we met
since 1999 | since nineteen ninety nine
in 2005 | in two thousand five
the 1980s | the nineteen eighties
Jan. 1st | january first
5 May 2021 | may fifth twenty twenty one
March 3 | march third
in 1905 | in nineteen oh five
the 21st century | the twenty first century
Meet at 3:30 pm. | meet at three thirty p m
at 10:05 | at ten oh five
at 12:00 | at twelve o'clock
by 9 a.m. | by nine a m
15:45 sharp | fifteen forty five sharp
at 7pm | at seven p m
It took 2h. | it took two hours
wait 30 min | wait thirty minutes
5 km away | five kilometers away
drive 60 mph | drive sixty miles per hour
weighs 70 kg | weighs seventy kilograms
20°C today | twenty degrees celsius today
a 50% discount | a fifty percent discount
16 GB of memory | sixteen gigabytes of memory
1 kg of rice | one kilogram of rice
a 2.5 m wall | a two point five meter wall
3 GHz | three gigahertz
6 ft tall | six feet tall
Dr. Smith met Mr. Jones. | doctor smith met mister jones
Mrs. Hill lives on Main St. | missus hill lives on main street
salt & pepper | salt and pepper
e.g. apples | for example apples
i.e. now | that is now
cats, dogs, etc. | cats dogs et cetera
No. 5 is alive | number five is alive
you vs. me | you versus me
Write to me@site.com | write to me at site dot com
#1 choice | number one choice
"""


@pytest.mark.parametrize("program", [None, shutil.which("espeak-ng")])
def test_sixty_texts_are_pronounced_as_the_words_that_are_spoken(program, monkeypatch):
    """Whichever program finds the sounds, it is given the same words, and knows nearly all of them."""
    pairs = [line.split(" | ") for line in SIXTY.strip().splitlines()]
    assert len(pairs) == 60
    for text, words in pairs:
        assert re.sub(r"[^a-z' ]+", " ", speak_text(text).lower().replace("-", " ")).split() == words.split()
    if program is None:
        pytest.importorskip("pocketsphinx", reason="the dictionary is part of the extra talk")
    else:
        pairs = pairs[::8]  # it starts anew between pauses
    monkeypatch.setattr(shutil, "which", lambda _: program)
    written, spoken = (
        pronounce(". ".join(one).replace("..", ".").replace("!.", ".")) for one in zip(*pairs, strict=True)
    )
    bare, other = (re.sub(r"[ ,.;:!?ˈˌ]", "", one.ipa) for one in (written, spoken))
    assert bare == other and len(spoken.guessed) <= 1


@given(st.text(max_size=60))
def test_no_digit_and_no_sign_of_money_is_left_for_the_voice(text):
    said = speak_text(text)
    assert not re.search("[0-9]", said) and said == " ".join(said.split())


@given(st.text("ab ,;ˈ", max_size=3000))
def test_long_sentences_are_cut_and_nothing_is_lost(ipa):
    pieces = _pieces(ipa.strip())
    assert max(map(len, pieces)) <= 400
    assert "".join("".join(pieces).split()) == "".join(ipa.split())


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


@pytest.mark.parametrize(
    ("text", "voice"),
    [("Привет, как дела?", "ru_RU"), ("你好 世界!", "zh_CN"), ("Καλημέρα", "el_GR"), ("สวัสดี", "text's")],
)
def test_letters_that_english_does_not_have_are_no_words_of_it(text, voice):
    """The voice said "chinese letter" for each of them, or, by the dictionary, ended in a ValueError."""
    with pytest.raises(InputError, match="voice's language") as caught:
        pronounce(text)
    assert voice in str(caught.value) and "rhasspy/piper-voices" in str(caught.value)


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
