"""Queue the frames of a talking avatar a little ahead of the present, each sentence with its sound."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from avatar.driving import rows_of
from avatar.speech import SpeechAnimator
from avatar.speech.voice import SynthesizedSpeech
from smplxpp.body.model import BodyModel
from smplxpp.core.files.tensor_bytes import pack_tensors
from smplxpp.core.params import BodyParams

# Two times trade latency against gaps in the motion, both in seconds.
AHEAD = 1.0
"""Length of the queue: a page that misses messages for less than this keeps moving."""
LEAD_TIME = 0.12
"""Minimum lead time of a change. It covers the latency of a message until the page shows it."""


@dataclass(frozen=True)
class Line:
    """A sentence of an answer.

    Attributes:
        turn: number of the turn in the conversation.
        number: index of the sentence in its turn, from 0.
        text: the words.
    """

    turn: int
    number: int
    text: str


class FrameQueue:
    """Frames of one avatar, numbered from 0 at its frame rate and sent as they are made.

    A message holds `rows` (T, 3 J + 3 + E) float32 of the frames from `first` on: axis-angle vectors of the joints,
    hands complete, translation in metres, expressions. It replaces these and all later frames of earlier messages.
    With `sound` (N,) int16 at `rate` a sentence begins at its first frame. `now` is the present, in seconds.

    Args:
        animator: generates the motion.
        body: joints of the avatar, as `avatar.runtime.skeleton.skeleton_body` gives them.
        send: called with each message.
        clock: returns seconds.
    """

    def __init__(
        self,
        animator: SpeechAnimator,
        body: BodyModel,
        send: Callable[[bytes], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._animator, self._body, self._send, self._clock = animator, body, send, clock
        self._began = clock()
        self._lock = threading.Lock()
        self._listening = False
        self._speaks_until = 0.0

    @property
    def fps(self) -> float:
        """Return the frame rate, frames a second."""
        return self._animator.config.fps

    @property
    def now(self) -> float:
        """Return the seconds since the queue began."""
        return self._clock() - self._began

    @property
    def speaking(self) -> bool:
        """Return whether a sentence is being spoken now."""
        return self.now < self._speaks_until

    def keep_ahead(self) -> None:
        """Add idle or listening frames until the queue reaches `AHEAD` from the present."""
        # Share of the queue that may be missing before it is refilled, so that messages stay few.
        refill = 0.25
        with self._lock:
            missing = self.now + AHEAD - self._animator.seconds
            if missing > refill * AHEAD:
                self._idle(missing)

    def listen(self, listening: bool) -> None:
        """Begin or end listening, at once unless a sentence is being spoken."""
        with self._lock:
            if listening == self._listening:
                return
            self._listening = listening
            if not self.speaking:
                self._animator.rewind(self.now + LEAD_TIME)
                self._idle(AHEAD)

    def say(self, spoken: SynthesizedSpeech, line: Line, wanted: Callable[[], bool] = lambda: True) -> None:
        """Queue a sentence: at once, or after the one being spoken.

        Args:
            spoken: sound and phonemes.
            line: the sentence as the page shows it.
            wanted: asked once the queue is free; a sentence of a cancelled turn is dropped.
        """
        with self._lock:
            if not wanted():
                return
            self._animator.rewind(max(self.now + LEAD_TIME, self._speaks_until))
            first = self._number
            motion = self._animator.talk(spoken.speech, more=True)
            self._speaks_until = self._animator.seconds
            sound = {"sound": spoken.sound.integers()}
            about = {"rate": spoken.sound.rate, "turn": line.turn, "line": line.number, "text": line.text}
            self._push(first, motion, sound, about)
            # The avatar moves on after the sentence even if the next one is late.
            self._idle(AHEAD)

    def interrupt(self) -> None:
        """Stop the sentence being spoken."""
        with self._lock:
            if self.speaking:
                self._animator.rewind(self.now + LEAD_TIME)
                self._speaks_until = 0.0
                self._idle(AHEAD)

    @property
    def _number(self) -> int:
        return round(self._animator.seconds * self.fps)

    def _idle(self, seconds: float) -> None:
        first = self._number
        self._push(first, self._animator.idle(seconds, listening=self._listening), {}, {})

    def _push(self, first: int, motion: BodyParams, more: dict[str, np.ndarray], about: dict[str, object]) -> None:
        header = {"first": first, "fps": self.fps, "now": round(self.now, 4), **about}
        self._send(pack_tensors({"rows": rows_of(self._body, motion), **more}, header))
