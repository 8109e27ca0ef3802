"""Answer in a conversation: by a language model behind an OpenAI-compatible address, or by rules without any."""

from __future__ import annotations

import copy
import http.client
import json
import re
import socket
import ssl
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from avatar.conversation.spoken_answer import ThoughtFilter
from smplxpp.core import InputError, require_positive
from smplxpp.core.files.json_file import as_list, as_object, parse_json

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


class RulePartner:
    """A partner of rules for machines without a language model, which answers at once.

    In the manner of Weizenbaum's ELIZA (1966): the first pattern that matches gives an answer, with "you" for "I" in
    the words that it repeats. It understands nothing, and admits it when asked.
    """

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

    def another(self) -> RulePartner:
        """Return one without a first answer."""
        return RulePartner()

    def _next(self, answers: tuple[str, ...]) -> str:
        used = self._used.get(answers, 0)
        self._used[answers] = used + 1
        return answers[used % len(answers)]


def _exchange_pronouns(text: str) -> str:
    """Return the words with first and second person exchanged."""
    # Words; longer echoes sound mechanical.
    most_repeated = 12
    words = text.strip(" .!?").split()[:most_repeated]
    return " ".join(_PRONOUNS.get(word.lower(), word) for word in words)


SYSTEM_PROMPT = (
    "You speak aloud through an avatar. Answer in one to three short sentences of plain spoken English, "
    "without lists, markup or emoji."
)
# Tokens that an answer may take. Thoughts count too and are longer than answers; speech is bounded in characters
# (`avatar.conversation.conversation`).
_MOST_TOKENS = 2048
_PATH = "/chat/completions"
_MOST_LINE, _MOST_BYTES = 1 << 18, 4 << 20  # bounds of a line and of an answer in bytes, against endless streams
_REMEDY = "check that it runs and that --llm is its base address, for example http://127.0.0.1:8080/v1"


@dataclass
class Endpoint:
    """An address that answers `POST .../chat/completions`, streamed or whole.

    Attributes:
        url: base address, or the whole one.
        model: name of the model there.
        key: key of the account; "" if the address needs none.
        prompt: system prompt.
        connecting: seconds to wait for a connection.
        silent: seconds to wait for the next bytes.

    Raises:
        InputError: the address has another form.
    """

    url: str
    model: str = "default"
    key: str = field(default="", repr=False)
    prompt: str = SYSTEM_PROMPT
    connecting: float = 5.0
    silent: float = 30.0

    def __post_init__(self) -> None:
        try:
            parts = urlsplit(self.url)
            usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:
            usable = False
        if not usable or any(ord(one) <= 32 for one in self.url):
            raise InputError("option llm", expected="http://HOST... or https://HOST...", received=repr(self.url[:200]))
        for name in ("connecting", "silent"):
            require_positive(f"seconds {name}", getattr(self, name))
        self.name = f"{self.model} at {parts.hostname}"
        self._host, self._port, self._safe = parts.hostname or "", parts.port, parts.scheme == "https"
        path = parts.path.rstrip("/")
        self._path = path if path.endswith(_PATH) else path + _PATH
        self._waiting: set[socket.socket] = set()
        # The name under which the address takes the bound of tokens; "" where it takes none.
        self._bound = "max_tokens"
        self._thoughts = ThoughtFilter()

    def answer(self, history: Sequence[tuple[str, str]]) -> Iterator[str]:
        """Yield the model's words, without what it thinks.

        Args:
            history: (role, text) in order, with role "user" or "assistant".

        Raises:
            InputError: no connection, a timeout, an error status, a malformed answer, one that breaks off, or thoughts
                alone.
        """
        answered = False
        for words in self._thoughts.answer(self._pieces(history)):
            answered = answered or bool(words.strip())
            yield words
        if not answered:
            raise InputError(
                f"language model at {self._host}",
                expected="words",
                received=f"thoughts alone, up to {_MOST_TOKENS} tokens",
                remedy="choose a model that does not think, or switch its thoughts off",
            )

    def _pieces(self, history: Sequence[tuple[str, str]]) -> Iterator[str]:
        """Yield the answer as it arrives; ask again where the address knows another name of the bound of tokens."""
        messages = [{"role": "system", "content": self.prompt}]
        messages += [{"role": who, "content": what} for who, what in history]
        while True:
            bound = {self._bound: _MOST_TOKENS} if self._bound else {}
            body = json.dumps({"model": self.model, "messages": messages, "stream": True, **bound}).encode()
            try:
                yield from self._asked(body)
                return
            except _OtherBoundError as other:
                self._bound = other.name

    def _asked(self, body: bytes) -> Iterator[str]:
        subject = f"language model at {self._host}"
        headers = {"Content-Type": "application/json", "Accept": "text/event-stream, application/json"}
        headers |= {"Authorization": f"Bearer {self.key}"} if self.key else {}
        # The socket is kept where another thread can close it, so that a stopped answer ends at once.
        connection, waiting, reply = self._connection(), None, None
        try:
            connection.connect()
            waiting = connection.sock
            self._waiting.add(waiting)
            waiting.settimeout(self.silent)
            connection.request("POST", self._path, body, headers)
            reply = connection.getresponse()
            if reply.status != http.client.OK:
                words = " ".join(reply.read(1000).decode(errors="replace").split())
                self._look_for_other_bound(reply.status, words)
                # The server's own words name the cause of a refused request; others may have another address.
                remedy = "" if reply.status == http.client.BAD_REQUEST else _REMEDY
                raise InputError(
                    subject, expected="status 200", received=f"{reply.status} {words[:400]}", remedy=remedy
                )
            # Servers that do not stream send the whole answer as one JSON object.
            streamed = "event-stream" in (reply.getheader("Content-Type") or "")
            yield from _streamed(reply, subject) if streamed else _whole(reply, subject)
        except TimeoutError:
            raise InputError(
                subject, expected=f"words within {self.silent:g} s", received="silence", remedy=_REMEDY
            ) from None
        # UnicodeError: a host with an empty or too long part.
        except (OSError, http.client.HTTPException, UnicodeError) as error:
            received = f"{type(error).__name__}: {str(error)[:200]}"
            raise InputError(subject, expected="an answer", received=received, remedy=_REMEDY) from None
        finally:
            self._waiting.discard(waiting)
            connection.close()
            # A reply holds the socket as well, and an exception's traceback would keep it alive.
            if reply is not None:
                reply.close()

    def _look_for_other_bound(self, status: int, words: str) -> None:
        """Raise `_OtherBoundError` where a refused request says that the bound of tokens has another name, or none."""
        if status not in (400, 422) or not self._bound or self._bound not in words:
            return
        new = "max_completion_tokens"
        raise _OtherBoundError(new if self._bound != new and new in words else "")

    def another(self) -> Endpoint:
        """Return one that shares what was learned of the model's thoughts and is cancelled on its own."""
        other = copy.copy(self)
        other._waiting = set()
        return other

    def cancel(self) -> None:
        """Close the connections that wait for an answer; their readers get an error."""
        for waiting in list(self._waiting):
            with suppress(OSError):
                waiting.shutdown(socket.SHUT_RDWR)

    def _connection(self) -> http.client.HTTPConnection:
        if self._safe:
            context = ssl.create_default_context()
            return http.client.HTTPSConnection(self._host, self._port, timeout=self.connecting, context=context)
        return http.client.HTTPConnection(self._host, self._port, timeout=self.connecting)


class _OtherBoundError(Exception):
    """The address takes the bound of tokens by another name."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name


def _streamed(reply: http.client.HTTPResponse, subject: str) -> Iterator[str]:
    """Yield the words of server-sent events, lines `data: {...}` up to `data: [DONE]`."""
    # Lines and their sum are bounded, because the other side may be anything that answers at this address.
    read, answered, ended, half = 0, False, False, b""
    while line := reply.readline(_MOST_LINE):
        read += len(line)
        if read > _MOST_BYTES or (not line.endswith(b"\n") and len(line) == _MOST_LINE):
            raise InputError(subject, expected=f"at most {_MOST_BYTES >> 20} MiB of events", received="more")
        # Server-sent events have other fields and empty lines too, which carry no words.
        if not line.startswith(b"data:"):
            continue
        data = line[5:].strip()
        if data == b"[DONE]":
            ended = True
            break
        data, half = _with_whole_characters(data, half)
        words, finished = _words(data, "delta", subject)
        answered, ended = answered or bool(words), ended or finished
        if words:
            yield words
    if not answered:
        raise InputError(subject, expected="words", received="none", remedy=_REMEDY)
    if not ended:
        raise InputError(subject, expected="a whole answer", received="one that breaks off")


def _with_whole_characters(data: bytes, half: bytes) -> tuple[bytes, bytes]:
    """Put the escape of a character's first half before its second one in the next event; return the first half left.

    Models yield tokens, which may be parts of an emoji; JSON writes it as two escapes, and servers send one in each
    event.
    """
    second = re.search(rb"(?<!\\ud[89ab][0-9a-f]{2})\\ud[c-f][0-9a-f]{2}", data, re.IGNORECASE)
    if half and second:
        data, half = data[: second.start()] + half + data[second.start() :], b""
    first = re.search(rb"\\ud[89ab][0-9a-f]{2}(?!\\ud[c-f])", data, re.IGNORECASE)
    if first:
        data, half = data[: first.start()] + data[first.end() :], first[0]
    return data, half


def _whole(reply: http.client.HTTPResponse, subject: str) -> Iterator[str]:
    data = reply.read(_MOST_BYTES + 1)
    if len(data) > _MOST_BYTES:
        raise InputError(subject, expected=f"at most {_MOST_BYTES >> 20} MiB", received="more")
    words, _ = _words(data, "message", subject)
    if not words.strip():
        raise InputError(subject, expected="words", received="none", remedy=_REMEDY)
    yield words


def _words(data: bytes, part: str, subject: str) -> tuple[str, bool]:
    """Return the words of one event or of the whole answer, of which some have none, and whether it is the last."""
    value = as_object(parse_json(data, subject=subject, remedy=_REMEDY), subject=subject)
    if value.get("error"):
        raise InputError(subject, expected="an answer", received=str(value["error"])[:300], remedy=_REMEDY)
    choices = as_list(value.get("choices") or [], subject=f"{subject}: choices")
    if not choices:
        return "", False  # usage, at the end of some streams
    choice = as_object(choices[0], subject=subject)
    finished = bool(choice.get("finish_reason"))
    # Servers write null for what an event does not have.
    content = as_object(choice.get(part) or {}, subject=f"{subject}: {part}").get("content")
    if not isinstance(content, str | None):
        raise InputError(f"{subject}: content", expected="a text", received=type(content).__name__)
    return content or "", finished
