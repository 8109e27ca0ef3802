"""Hold one conversation: take text or speech, answer sentence by sentence, and let anything new interrupt."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np
from jaxtyping import Int16

from avatar.conversation.frame_queue import FrameQueue, Line
from avatar.conversation.hearing import Activity, Listener, Recogniser, Recognisers, UtterancePart
from avatar.conversation.spoken_answer import MarkdownReader
from avatar.speech import SpeechAnimator
from avatar.speech.voice import PiperVoice
from smplxpp.body.model import BodyModel
from smplxpp.core.errors import InputError

# Limits of a conversation: characters of one message, characters and seconds of speech of one answer (digits are spoken
# five times as long as letters), and turns that a language model gets as context.
MOST_TYPED = 2000
_MOST_ANSWERED = 4000
_MOST_SPOKEN = 300.0
_REMEMBERED = 12
LONGEST_SENTENCE = 240
"""Characters after which a sentence is cut at a pause or between words, because a voice is synthesised by sentences."""
# Not behind a title, an abbreviation that a word follows, or several initials.
_ABBREVIATED = ("Dr", "Mr", "Mrs", "Ms", "Prof", "St", "Gen", "Lt", "Sgt", "Capt", "e.g", "i.e", "vs", "approx")
_INNER = "".join(rf"(?<!\b{re.escape(one)})" for one in _ABBREVIATED) + r"(?<!\b[A-Z]\.[A-Z])"
_END = re.compile(_INNER + "[.!?\u2026]+[\"'\u201d\u2019)\\]]*(?=\\s)|\n+")
_PAUSE = re.compile("[,;:\u2013\u2014]\\s")


class Partner(Protocol):
    """The answering side: rules or a language model."""

    name: str

    def answer(self, history: Sequence[tuple[str, str]]) -> Iterator[str]:
        """Yield the words of an answer to the last (role, text) of the history, as they arrive."""
        ...

    def cancel(self) -> None:
        """Stop waiting for the current answer."""

    def another(self) -> Partner:
        """Return a partner for another conversation, so that `cancel` stops the answers of one alone."""
        ...


@dataclass(frozen=True)
class ChatParts:
    """Engines that conversations are made of; several at a time share them.

    Attributes:
        voice: synthesises speech.
        partner: answers.
        animator: returns a new generator of motion.
        body: joints of the avatar.
        activity: returns a new detector of voice activity.
        recognisers: lend what recognises words; None allows typing alone.
    """

    voice: PiperVoice
    partner: Partner
    animator: Callable[[], SpeechAnimator]
    body: BodyModel
    activity: Callable[[], Activity]
    recognisers: Recognisers | None


@dataclass
class Turn:
    """A message of the person and its answer.

    Attributes:
        number: number of the turn, from 1.
        asked: the person's words.
        began: time of the clock at which the person had ended.
        spoken: whether the words were spoken and not typed.
        answered: sentences of the answer so far.
        marks: seconds from `began` to each part of the answer, in order.
        seconds: of speech so far.
        cancelled: whether a newer message has interrupted the turn.
    """

    number: int
    asked: str
    began: float
    spoken: bool
    answered: list[str] = field(default_factory=list)
    marks: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    cancelled: bool = False

    def mark(self, part: str) -> None:
        """Record the time of a part, the first time that it is done."""
        self.marks.setdefault(part, time.monotonic() - self.began)


class Conversation:
    """The conversation of a person in one page.

    Args:
        parts: engines.
        tell: called with messages for the page, objects with `kind`.
        show: called with the messages of the `FrameQueue`.
        report: called with a turn once its answer is heard and seen.
        wait_for_room: called before each sentence with a function that tells whether it is still wanted; returns once
            the page has taken most of what was sent.
    """

    def __init__(
        self,
        parts: ChatParts,
        tell: Callable[[dict[str, Any]], None],
        show: Callable[[bytes], None],
        report: Callable[[Turn], None] = lambda _: None,
        wait_for_room: Callable[[Callable[[], bool]], None] = lambda _: None,
    ) -> None:
        self._parts, self._tell, self._report, self._wait_for_room = parts, tell, report, wait_for_room
        self._partner, self._recogniser = parts.partner.another(), cast("Recogniser | None", None)
        self.frames = FrameQueue(parts.animator(), parts.body, show)
        self._listener = Listener(parts.activity())
        self._turns: list[Turn] = []
        self._turn: Turn | None = None
        self._answering: threading.Thread | None = None
        self._closed = threading.Event()
        self._pump = threading.Thread(target=self._keep_ahead, daemon=True)
        self._pump.start()

    def typed(self, text: str) -> None:
        """Take a typed message and interrupt the answer being spoken.

        Raises:
            InputError: an empty or too long message.
        """
        text = " ".join(text.split())
        if not text or len(text) > MOST_TYPED:
            raise InputError(
                "message", expected=f"1 to {MOST_TYPED} characters", received=str(len(text)), remedy="send it in parts"
            )
        self.stop()
        self._begin(text, time.monotonic(), spoken=False)

    def heard(self, samples: Int16[np.ndarray, " N"]) -> None:
        """Take sound of the microphone at 16 kHz; the beginning of speech interrupts the answer."""
        if self._parts.recognisers is None:
            raise InputError("sound", expected="text, because no recogniser is installed", received="sound")
        self._recogniser = self._recogniser or self._parts.recognisers.take()
        for part in self._listener.hear(samples):
            self._take(part, self._recogniser)

    def mute(self) -> None:
        """Drop an utterance that was begun, because the microphone is off."""
        self._listener = Listener(self._parts.activity())
        self.frames.listen(False)

    def stop(self) -> None:
        """End the answer at once and notify the page."""
        turn = self._turn
        if turn is not None:
            turn.cancelled = True
            self._turn = None
            self._partner.cancel()
        self.frames.interrupt()
        if turn is not None:
            # After the frames of the interruption, so that the page does not wait for the rest of the sentence.
            self._tell({"kind": "stopped", "turn": turn.number})

    def began(self, number: int, what: str) -> None:
        """Record that the page has begun to play or to show a turn's answer."""
        turn = self._turn
        if turn is None or turn.number != number or what not in ("sound", "picture"):
            return
        before = len(turn.marks)
        turn.mark({"sound": "heard", "picture": "seen"}[what])
        if len(turn.marks) > before and {"heard", "seen"} <= turn.marks.keys():
            self._tell({"kind": "latency", "turn": number, "parts": rounded(turn.marks)})
            self._report(turn)

    def close(self) -> None:
        """End the conversation and its threads; a partner that is still being connected is left to itself."""
        self._closed.set()
        if self._turn is not None:
            self._turn.cancelled = True
            self._partner.cancel()
        for thread in (self._pump, self._answering):
            if thread is not None:
                thread.join(2.0)  # seconds: the voice's longest part, on a busy machine
        if self._parts.recognisers is not None and self._recogniser is not None:
            self._parts.recognisers.give_back(self._recogniser)

    def _take(self, part: UtterancePart, recogniser: Recogniser) -> None:
        # Speech interrupts a running answer, and the avatar turns to the speaker.
        if part.begins:
            self.stop()
            self.frames.listen(True)
            self._tell({"kind": "listening"})
            recogniser.begin()
        recogniser.hear(part.samples)
        if not part.ends:
            return
        # Silence decides that an utterance ended, so that its true end lies that much earlier. The pause counts in the
        # delay that a turn reports.
        began = time.monotonic() - part.silent
        decided = time.monotonic()
        words = recogniser.end()
        self.frames.listen(False)
        if part.cut:
            self._note("Only the first half minute was heard.")
        if not words or recogniser.other_language:
            self._tell({"kind": "heard", "text": ""})
            self._note(recogniser.other_language or "I heard something, but no words.")
            return
        self._begin(words, began, spoken=True, pause=decided - began)

    def _begin(self, text: str, began: float, *, spoken: bool, pause: float = 0.0) -> None:
        number = self._turns[-1].number + 1 if self._turns else 1
        turn = Turn(number, text, began, spoken)
        if spoken:
            turn.marks["pause"] = pause
            turn.mark("recognised")
        self._turn = turn
        self._turns = [*self._turns, turn][-_REMEMBERED:]
        self._tell({"kind": "heard", "text": text, "turn": number, "spoken": spoken})
        self._answering = threading.Thread(target=self._answer, args=(turn,), daemon=True)
        self._answering.start()

    def _answer(self, turn: Turn) -> None:
        try:
            reader = MarkdownReader()
            for number, sentence in enumerate(sentences(self._words(turn))):
                if turn.cancelled:
                    break
                turn.mark("sentence")
                turn.answered.append(sentence)
                self._say(turn, number, sentence, reader.spoken(sentence))
                if turn.seconds > _MOST_SPOKEN:
                    self._note("The answer was too long and is cut here.")
                    break
        except InputError as error:
            if not turn.cancelled:
                self._note(str(error))
        except Exception as error:
            # The page waits for an end of the answer, whatever went wrong in a voice or a partner.
            logging.getLogger("smplxpp").exception("an answer failed")
            if not turn.cancelled:
                self._note(f"The answer failed: {type(error).__name__}.")
        if not turn.cancelled:
            self._tell({"kind": "answered", "turn": turn.number})

    def _words(self, turn: Turn) -> Iterator[str]:
        count = 0
        try:
            for piece in self._partner.answer(history(self._turns)):
                if turn.cancelled:
                    return
                turn.mark("first words")
                yield piece[: _MOST_ANSWERED - count]
                count += len(piece)
                if count >= _MOST_ANSWERED:
                    self._note("The answer was too long and is cut here.")
                    return
        except InputError as error:
            # What came before an answer broke off is spoken.
            if not count:
                raise
            if not turn.cancelled:
                self._note(str(error))

    def _say(self, turn: Turn, number: int, sentence: str, words: str) -> None:
        if not words:
            self._tell({"kind": "silent", "turn": turn.number, "line": number, "text": sentence})
            return
        self._wait_for_room(lambda: not turn.cancelled)
        if turn.cancelled:
            return
        try:
            spoken = self._parts.voice.say(words, wanted=lambda: not turn.cancelled)
        except InputError as error:  # another alphabet or punctuation alone is shown and not spoken
            if turn.cancelled:
                return
            self._tell({"kind": "silent", "turn": turn.number, "line": number, "text": sentence})
            if any(one.isalnum() for one in sentence):
                self._note(str(error))
            return
        turn.mark("voice")
        turn.seconds += spoken.sound.seconds
        self.frames.say(spoken, Line(turn.number, number, sentence), lambda: not turn.cancelled)
        turn.mark("sent")

    def _note(self, text: str) -> None:
        self._tell({"kind": "note", "text": text})

    def _keep_ahead(self) -> None:
        while not self._closed.is_set():
            self.frames.keep_ahead()
            self._closed.wait(0.1)  # seconds; much shorter than the queue of frames


def history(turns: Sequence[Turn]) -> list[tuple[str, str]]:
    """Return (role, text) in order, with role "user" or "assistant"; interrupted answers up to the interruption."""
    out = []
    for turn in turns:
        out += [("user", turn.asked), *([("assistant", " ".join(turn.answered))] if turn.answered else [])]
    return out


def rounded(marks: dict[str, float]) -> dict[str, float]:
    """Round the seconds of each part to milliseconds."""
    return {part: round(seconds, 3) for part, seconds in marks.items()}


def sentences(pieces: Iterable[str]) -> Iterator[str]:
    """Yield the sentences of a text that arrives in pieces, as early as possible, and the remainder at the end."""
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
    """Return where the first sentence ends, 0 if that is not known yet."""
    found = _END.search(text)
    if found is not None and found.end() <= LONGEST_SENTENCE:
        return found.end()
    if len(text) <= LONGEST_SENTENCE:
        return 0
    pauses = [pause.end() for pause in _PAUSE.finditer(text, 0, LONGEST_SENTENCE)]
    return pauses[-1] if pauses else text.rfind(" ", 0, LONGEST_SENTENCE) + 1 or LONGEST_SENTENCE


def _short(text: str) -> Iterator[str]:
    """Yield pieces of a remainder that are not too long."""
    while cut := _cut(text):
        yield text[:cut].strip()
        text = text[cut:]
    if text.strip():
        yield text.strip()
