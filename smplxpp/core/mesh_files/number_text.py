"""Numbers in text, as ASCII mesh files hold them: read at once, and none skipped, cut or guessed."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from smplxpp.core.errors import InputError

# By byte: tab, line feed, vertical tab, form feed, carriage return, space.
IS_SPACE = np.isin(np.arange(256), (9, 10, 11, 12, 13, 32))


def parse_numbers(text: bytes, *, subject: str) -> Float64[np.ndarray, " n"]:
    """The numbers of a text that holds nothing else, separated by blanks and line ends.

    Raises:
        InputError: a word that is no number; it is named.
    """
    count = len(word_starts(text))
    # numpy only warns where a text goes wrong, and takes "1-2" for two numbers: their count tells both.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            values = np.fromstring(text, dtype=np.float64, sep=" ") if count else np.empty(0)
        except ValueError:
            values = np.empty(0)
    if len(values) != count:
        raise InputError(subject, expected="numbers", received=_first_bad_word(text))
    return values


def word_starts(text: bytes) -> Int64[np.ndarray, " n"]:
    """Where the words of a text begin."""
    space = IS_SPACE[as_bytes(text)]
    return np.flatnonzero(~space & np.concatenate([[True], space[:-1]]))


def count_between(places: Int64[np.ndarray, " n"], starts: Int64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """How many of the increasing places lie between each start and the next."""
    return np.diff(np.append(np.searchsorted(places, starts), len(places)))


def as_bytes(text: bytes) -> UInt8[np.ndarray, " n"]:
    """A text as an array, not copied."""
    return np.frombuffer(text, dtype=np.uint8)


def _first_bad_word(text: bytes) -> str:
    for word in text.split():
        try:
            float(word)
        except ValueError:
            return f"the word {word[:40].decode('latin1')!r}"
    return "words that are no numbers"
