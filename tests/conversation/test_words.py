"""Text in pieces to sentences, and the partner of rules."""

from __future__ import annotations

import pytest

from avatar.conversation.answers import RulePartner
from avatar.conversation.conversation import LONGEST_SENTENCE, sentences
from avatar.conversation.spoken_answer import MarkdownReader


@pytest.mark.parametrize(
    ("pieces", "expected"),
    [
        (["Hel", "lo. How", " are you", "?"], ["Hello.", "How are you?"]),
        (["It is 3.5 m. Good."], ["It is 3.5 m.", "Good."]),
        (['He said "No." Then', " he went"], ['He said "No."', "Then he went"]),
        (["One\ntwo\n\nthree"], ["One", "two", "three"]),
        (["", "  ", "\n"], []),
        (["Dr. Smith of the U.S. left, e.g. by car. Good."], ["Dr. Smith of the U.S. left, e.g. by car.", "Good."]),
        (["Wait... what?!  Yes"], ["Wait...", "what?!", "Yes"]),
    ],
)
def test_sentences_come_whole_and_in_order(pieces, expected):
    assert list(sentences(pieces)) == expected


@pytest.mark.parametrize(
    ("lines", "spoken"),
    [
        (
            ["## A *plan*:", "- **Read** [it](https://a.b/c)", "1. `make` __now__", "* * *"],
            ["A plan:", "Read it", "1. make now", ""],
        ),
        (["Run this:", "```bash", "rm -rf *", "```", "Done."], ["Run this:", "", "", "", "Done."]),
        (["| a | b |", "|---|:-:|", "| 1 | 2 |"], ["a, b", "", "1, 2"]),
        (["2 * 3 * 4 is snake_case_name, a<br>b", "![a cat](c.png)"], ["2 * 3 * 4 is snake_case_name, a b", "a cat"]),
    ],
)
def test_markup_is_read_as_a_person_would(lines, spoken):
    reader = MarkdownReader()
    assert [reader.spoken(line) for line in lines] == spoken


def test_a_sentence_comes_as_soon_as_it_is_whole():
    given = iter(["First one. Se", "cond"])
    out = sentences(given)
    assert next(out) == "First one."
    assert next(given) == "cond"  # not read yet


def test_a_text_without_ends_is_cut_at_pauses_and_words_and_nothing_is_lost():
    words = [f"word{k}" for k in range(300)]
    for text in (" ".join(words), ", ".join(words), "x" * 1000):
        out = list(sentences([text]))
        assert all(0 < len(one) <= LONGEST_SENTENCE for one in out)
        assert "".join("".join(out).split()) == "".join(text.split())


@pytest.mark.parametrize(
    ("said", "word"),
    [
        ("Hello.", "Hello"),
        ("I am tired of my dog", "tired of your dog"),
        ("Who are you?", "rules"),
        ("My name is {0} {x} %s", "{0} {x} %s"),
        ("", "tell me"),
        ("Привет", "tell me"),
        ("{" * 2000, "tell me"),
    ],
)
def test_rules_answer_anything(said, word):
    assert word in "".join(RulePartner().answer([("user", said)]))


def test_rules_do_not_say_the_same_twice():
    partner = RulePartner()
    first, second = ("".join(partner.answer([("user", "hello")])) for _ in range(2))
    assert first != second
