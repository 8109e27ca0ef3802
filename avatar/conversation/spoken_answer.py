"""What of a language model's answer is spoken: no thoughts, and Markdown as a person would read it aloud."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from smplxpp.core.errors import InputError

# Marks between which models put what they think: DeepSeek, Qwen and most others (`think` and its siblings), Mistral,
# Kimi, and the channels of gpt-oss, whose last one is the answer.
_NAMES = r"(?:seed:)?(?:think(?:ing)?|thoughts?|reason(?:ing)?|reflection|analysis|scratchpad)"
_OPENS = re.compile(rf"<{_NAMES}>|\[THINK\]|\u25c1think\u25b7|<\|channel\|>(?:analysis|commentary)\b", re.IGNORECASE)
_CLOSES = re.compile(rf"</{_NAMES}>|\[/THINK\]|\u25c1/think\u25b7|<\|channel\|>final(?:<\|message\|>)?", re.IGNORECASE)
_STARTS = re.compile(r"[<\[\u25c1][^\s>\]\u25b7]*(?:>?[a-z]*)$", re.IGNORECASE)


class ThoughtFilter:
    """Passes the answer in a stream of pieces on and drops the thoughts.

    Some models' answers begin within the thoughts, because their template has opened them: only the mark that closes
    them tells. Until one answer without such a mark has come to its end, answers are therefore held back whole.

    Attributes:
        opened_before: whether the model's answers begin within thoughts; None until an answer tells.
    """

    def __init__(self) -> None:
        self.opened_before: bool | None = None

    def answer(self, pieces: Iterable[str]) -> Iterator[str]:
        """Yield the pieces of the answer; nothing where the model only thought.

        Raises:
            InputError: what `pieces` raises, after all that came before.
        """
        longest_mark = 40  # characters, with a margin: the end of a piece may hold the beginning of a mark
        inside, held, heard = self.opened_before is True, "", ""
        waiting, failure = self.opened_before is None, None
        stream = iter(pieces)
        while True:
            try:
                held += next(stream)
            except StopIteration:
                break
            except InputError as error:
                failure = error
                break
            # All marks that are whole.
            while found := (_CLOSES if inside else _EITHER).search(held):
                closes = _CLOSES.fullmatch(found[0]) is not None
                if closes and not inside and waiting:
                    # All before the mark was thought, although nothing had opened it.
                    heard, self.opened_before, waiting = "", True, False
                elif not inside:
                    heard += held[: found.start()]
                inside, held = not closes, held[found.end() :]
            # What may be the beginning of a mark waits for the next piece.
            start = _STARTS.search(held, max(0, len(held) - longest_mark))
            cut = len(held) if start is None else start.start()
            heard, held = heard if inside else heard + held[:cut], held[cut:]
            if heard and not waiting:
                yield heard
                heard = ""
        heard += "" if inside else held
        if self.opened_before is None and not inside and heard.strip() and failure is None:
            self.opened_before = False
        if heard:
            yield heard
        if failure is not None:
            try:
                raise failure
            finally:
                del failure  # its traceback refers to this frame


_EITHER = re.compile(f"{_OPENS.pattern}|{_CLOSES.pattern}", re.IGNORECASE)
_FENCE = re.compile(r"^\s*(?:```|~~~)")
# In their order: pictures before links, strong emphasis before emphasis.
_MARKS = [
    (re.compile(pattern), replacement)
    for pattern, replacement in (
        (r"!\[([^\]]*)\]\([^)]*\)", r"\1"),
        (r"\[([^\]]+)\]\([^)]*\)", r"\1"),
        (r"</?[A-Za-z][^<>]{0,80}>", " "),
        (r"^\s*\|?(?:\s*:?-+:?\s*\|)+(?:\s*:?-+:?)?\s*$|^\s*(?:[-*_]\s*){3,}$", ""),
        (r"^\s*#{1,6}\s+|^\s*>\s?|^\s*[-*+\u2022]\s+(?:\[[ xX]\]\s+)?", ""),
        (r"^\s*\|\s*|\s*\|\s*$", ""),
        (r"\s+\|\s+", ", "),
        (r"(\*\*|__|~~)(?=\S)(.+?)(?<=\S)\1", r"\2"),
        (r"(?<!\w)([*_])(?=\S)(.+?)(?<=\S)\1(?!\w)", r"\2"),
        (r"`+([^`]+)`+", r"\1"),
        (r"\*\*|__(?!\w)|`+", ""),
    )
]


class MarkdownReader:
    """Turns the sentences of one answer into speech, line by line; code in fences is shown and not spoken."""

    def __init__(self) -> None:
        self._in_code = False

    def spoken(self, sentence: str) -> str:
        """Return the words of a sentence without its marks; "" where there is nothing to say.

        Example:
            >>> MarkdownReader().spoken("- **Read** [the page](https://example.org) about `make`.")
            'Read the page about make.'
        """
        if _FENCE.match(sentence):
            # A fence that opens and closes in one line leaves the state as it is.
            self._in_code ^= len(re.findall("```|~~~", sentence)) % 2 == 1
            return ""
        if self._in_code:
            return ""
        for pattern, replacement in _MARKS:
            sentence = pattern.sub(replacement, sentence)
        return " ".join(sentence.split())
