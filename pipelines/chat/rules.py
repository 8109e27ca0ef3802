"""Answer by rules, for machines without a language model.

In the manner of Weizenbaum's ELIZA (1966): the first pattern that matches gives an answer, with "you" for "I" in the
words that it repeats. It understands nothing, and admits it when asked.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

_PRONOUNS = {
    **{"i": "you", "me": "you", "my": "your", "mine": "yours", "am": "are", "myself": "yourself", "i'm": "you're"},
    **{"you": "I", "your": "my", "yours": "mine", "are": "am", "yourself": "myself", "you're": "I'm", "i've": "you've"},
}
# The first match answers. `{}` is the matched rest with pronouns exchanged; several answers are used in turn.
_RULES: tuple[tuple[str, tuple[str, ...]], ...] = (
    (r"\b(?:hello|hi|hey|good (?:morning|evening|day))\b", ("Hello! I am glad that you are here.", "Hello again.")),
    (r"\b(?:bye|goodbye|see you)\b", ("Goodbye. It was nice to talk with you.",)),
    (r"\bwho are you\b|\bwhat are you\b|\bare you (?:a|an|real)\b", ("I am an avatar, and a few rules speak for me.",)),
    (r"\bwhat(?:'s| is) your name\b", ("I have no name yet. What would you call me?",)),
    (r"\bmy name is (.+)", ("Nice to meet you, {}.",)),
    (r"\bhow(?: are|'re) you\b", ("I am well, thank you. And you?",)),
    (r"\bthank", ("You are welcome.",)),
    (r"\bi (?:want|need|would like) (.+)", ("What would it mean to you to have {}?", "Why {}?")),
    (r"\bi(?: am|'m) (.+)", ("How long have you been {}?", "Why are you {}?")),
    (r"\bi feel (.+)", ("Do you often feel {}?",)),
    (r"\bi (?:think|believe) (.+)", ("What makes you think {}?",)),
    (r"\bbecause (.+)", ("Is that the only reason?",)),
    (r"\bcan you (.+)", ("Perhaps I can {}. Shall I try?",)),
    (r"\?\s*$|^(?:what|why|who|where|when|how)\b", ("That is a good question. What do you think?", "Why do you ask?")),
)
_ELSE = ("Please tell me more about that.", "I see. And then?", "You said: {}. How does that make you feel?")
_MOST_REPEATED = 12  # words; longer echoes sound mechanical


class RulePartner:
    """A partner of rules that answers at once."""

    name = "rules (a stand-in; --llm URL asks a language model)"

    def __init__(self) -> None:
        self._used: dict[tuple[str, ...], int] = {}

    def answer(self, history: Sequence[tuple[str, str]]) -> Iterator[str]:
        """Yield the answer to the last message, in one piece."""
        text = " ".join(history[-1][1].split())
        for pattern, answers in _RULES:
            found = re.search(pattern, text, re.IGNORECASE)
            if found is not None:
                yield self._next(answers).format(_exchange_pronouns(found[found.lastindex or 0]))
                return
        yield self._next(_ELSE).format(_exchange_pronouns(text))

    def cancel(self) -> None:
        """Do nothing, because rules never wait."""

    def _next(self, answers: tuple[str, ...]) -> str:
        used = self._used.get(answers, 0)
        self._used[answers] = used + 1
        return answers[used % len(answers)]


def _exchange_pronouns(text: str) -> str:
    """Return the words with first and second person exchanged."""
    words = text.strip(" .!?").split()[:_MOST_REPEATED]
    return " ".join(_PRONOUNS.get(word.lower(), word) for word in words)
