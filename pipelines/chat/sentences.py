"""A stream of text to sentences that can be spoken, each as soon as it is whole."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

LONGEST = 240
"""Characters after which a sentence is cut at a pause or between words: a voice reads ahead as long as that."""
_END = re.compile("[.!?\u2026]+[\"'\u201d\u2019)\\]]*(?=\\s)|\n+")
_PAUSE = re.compile("[,;:\u2013\u2014]\\s")


def sentences(pieces: Iterable[str]) -> Iterator[str]:
    """Yield the sentences of a text that comes in pieces; what is behind the last end is one too."""
    rest = ""
    for piece in pieces:
        rest += piece
        while cut := _cut(rest):
            sentence, rest = rest[:cut].strip(), rest[cut:]
            if sentence:
                yield sentence
    if rest.strip():
        yield from _short(rest.strip())


def _cut(text: str) -> int:
    """Where the first sentence ends; 0 where it is not known yet."""
    found = _END.search(text)
    if found is not None and found.end() <= LONGEST:
        return found.end()
    if len(text) <= LONGEST:
        return 0
    pauses = [pause.end() for pause in _PAUSE.finditer(text, 0, LONGEST)]
    return pauses[-1] if pauses else text.rfind(" ", 0, LONGEST) + 1 or LONGEST


def _short(text: str) -> Iterator[str]:
    while cut := _cut(text):
        yield text[:cut].strip()
        text = text[cut:]
    if text.strip():
        yield text.strip()
