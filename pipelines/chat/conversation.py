"""One conversation: what is typed or said goes in, answers go out by sentences, anything new stops the old."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from jaxtyping import Int16

from avatar.speech import Performer
from avatar.speech.voice import PiperVoice
from pipelines.chat.recogniser import Recogniser
from pipelines.chat.sentences import sentences
from pipelines.chat.stage import Line, Stage
from pipelines.chat.voice_activity import Activity, Heard, Listener
from smplxpp.body.model import BodyModel
from smplxpp.core.errors import InputError

MOST_TYPED = 2000
"""Characters of one message."""
_MOST_ANSWERED = 4000  # characters of one answer: some five minutes
_REMEMBERED = 12  # turns that the partner is told again
_WAIT = 0.1  # seconds between looks at whether frames are missing


class Partner(Protocol):
    """Who answers: rules, or a language model."""

    name: str

    def answer(self, history: Sequence[tuple[str, str]]) -> Iterator[str]:
        """Yield the words of an answer to the last of (who, what), as they come."""
        ...

    def cancel(self) -> None:
        """Stop waiting for them."""


@dataclass(frozen=True)
class Cast:
    """What a conversation is made of.

    Attributes:
        voice, partner: who speaks, who answers. performer: makes somebody who acts. body: its joints.
        activity: makes a judge of whether somebody speaks. recogniser: of words; None: typing alone.
    """

    voice: PiperVoice
    partner: Partner
    performer: Callable[[], Performer]
    body: BodyModel
    activity: Callable[[], Activity]
    recogniser: Recogniser | None


@dataclass
class Turn:
    """One thing said and its answer.

    Attributes:
        number: from 1. asked, answered: what the person said, and the sentences that were said to it.
        began: the clock's time when the person had ended. spoken: aloud, or else typed.
        marks: seconds from there to each part, in order. cancelled: something new has come.
    """

    number: int
    asked: str
    began: float
    spoken: bool
    answered: list[str] = field(default_factory=list)
    marks: dict[str, float] = field(default_factory=dict)
    cancelled: bool = False

    def mark(self, part: str) -> None:
        """Note that a part is done, the first time."""
        self.marks.setdefault(part, time.monotonic() - self.began)


class Conversation:
    """A page's partner.

    Args:
        cast: who takes part. tell: takes what the page is to know (an object with `kind`). show: takes messages of
            the `Stage`. report: takes turns whose answer is heard and seen.
    """

    def __init__(
        self,
        cast: Cast,
        tell: Callable[[dict[str, Any]], None],
        show: Callable[[bytes], None],
        report: Callable[[Turn], None] = lambda _: None,
    ) -> None:
        self._cast, self._tell, self._report = cast, tell, report
        self.stage = Stage(cast.performer(), cast.body, show)
        self._listener = Listener(cast.activity())
        self._turns: list[Turn] = []
        self._turn: Turn | None = None
        self._answering: threading.Thread | None = None
        self._closed = threading.Event()
        self._pump = threading.Thread(target=self._keep_ahead, daemon=True)
        self._pump.start()

    def typed(self, text: str) -> None:
        """Take something typed; what is being said is stopped.

        Raises:
            InputError: nothing, or too much.
        """
        text = " ".join(text.split())
        if not text or len(text) > MOST_TYPED:
            raise InputError(
                "message", expected=f"1 to {MOST_TYPED} characters", received=str(len(text)), remedy="say it in parts"
            )
        self.stop()
        self._begin(text, time.monotonic(), spoken=False)

    def heard(self, samples: Int16[np.ndarray, " N"]) -> None:
        """Take sound of the microphone, at 16 kHz; who begins to speak stops the answer."""
        if self._cast.recogniser is None:
            raise InputError("sound", expected="text: nothing here recognises words", received="sound")
        for part in self._listener.hear(samples):
            self._take(part, self._cast.recogniser)

    def mute(self) -> None:
        """The microphone is off: what was begun is dropped."""
        self._listener = Listener(self._cast.activity())
        self.stage.listen(False)

    def stop(self) -> None:
        """End the answer at once; the page is told of it."""
        turn = self._turn
        if turn is not None:
            turn.cancelled = True
            self._turn = None
            self._cast.partner.cancel()
        self.stage.hush()
        if turn is not None:
            # Behind what was sent of it before.
            self._tell({"kind": "stopped", "turn": turn.number})

    def began(self, number: int, what: str) -> None:
        """The page has begun to be heard or to show a turn's answer."""
        turn = self._turn
        if turn is None or turn.number != number or what not in ("sound", "picture"):
            return
        before = len(turn.marks)
        turn.mark({"sound": "heard", "picture": "seen"}[what])
        if len(turn.marks) > before and {"heard", "seen"} <= turn.marks.keys():
            self._tell({"kind": "latency", "turn": number, "parts": rounded(turn.marks)})
            self._report(turn)

    def close(self) -> None:
        """End everything."""
        self._closed.set()
        if self._turn is not None:
            self._turn.cancelled = True
            self._cast.partner.cancel()
        for thread in (self._pump, self._answering):
            if thread is not None:
                thread.join()

    def _take(self, part: Heard, recogniser: Recogniser) -> None:
        if part.begins:
            self.stop()
            self.stage.listen(True)
            self._tell({"kind": "listening"})
            recogniser.begin()
        recogniser.hear(part.samples)
        if not part.ends:
            return
        began = time.monotonic() - part.silent
        decided = time.monotonic()
        words = recogniser.end()
        self.stage.listen(False)
        if part.cut:
            self._note("That was long: what came after half a minute was not heard.")
        if not words:
            self._tell({"kind": "heard", "text": ""})
            self._note("I heard something, but no word that I know.")
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
            for number, sentence in enumerate(sentences(self._words(turn))):
                if turn.cancelled:
                    break
                turn.mark("sentence")
                turn.answered.append(sentence)
                self._say(turn, number, sentence)
        except InputError as error:
            if not turn.cancelled:
                self._note(str(error))
        if not turn.cancelled:
            self._tell({"kind": "answered", "turn": turn.number})

    def _words(self, turn: Turn) -> Iterator[str]:
        count = 0
        for piece in self._cast.partner.answer(history(self._turns)):
            if turn.cancelled:
                return
            turn.mark("first words")
            yield piece[: _MOST_ANSWERED - count]
            count += len(piece)
            if count >= _MOST_ANSWERED:
                self._note("The answer goes on; it is cut here.")
                return

    def _say(self, turn: Turn, number: int, sentence: str) -> None:
        try:
            spoken = self._cast.voice.say(sentence)
        except InputError as error:  # another script, or signs alone: shown, not spoken
            self._tell({"kind": "silent", "turn": turn.number, "line": number, "text": sentence})
            if any(one.isalnum() for one in sentence):
                self._note(str(error))
            return
        turn.mark("voice")
        self.stage.say(spoken, Line(turn.number, number, sentence), lambda: not turn.cancelled)
        turn.mark("sent")

    def _note(self, text: str) -> None:
        self._tell({"kind": "note", "text": text})

    def _keep_ahead(self) -> None:
        while not self._closed.is_set():
            self.stage.keep_ahead()
            self._closed.wait(_WAIT)


def history(turns: Sequence[Turn]) -> list[tuple[str, str]]:
    """Who ("user", "assistant") said what, in order; of answers that were stopped what was said of them."""
    out = []
    for turn in turns:
        out += [("user", turn.asked), *([("assistant", " ".join(turn.answered))] if turn.answered else [])]
    return out


def rounded(marks: dict[str, float]) -> dict[str, float]:
    """Seconds in whole milliseconds."""
    return {part: round(seconds, 3) for part, seconds in marks.items()}
