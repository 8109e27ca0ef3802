"""An avatar through time: frames a little ahead of the present, sentences with their sound where they fit."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from avatar.speech import Performer
from avatar.speech.voice import Spoken
from smplxpp.body.model import BodyModel
from smplxpp.core.files.tensor_bytes import pack_tensors
from smplxpp.core.params import BodyParams

AHEAD = 1.0
"""Seconds of frames that a page has in hand."""
SOON = 0.12
"""Seconds from now at which what changes may begin: so long a message may take to be shown."""


@dataclass(frozen=True)
class Line:
    """What is said: the turn of the conversation that it belongs to, its place there, its words."""

    turn: int
    number: int
    text: str


class Stage:
    """Frames of one performer, numbered from 0 at its rate, sent as they are made.

    A message holds `rows` (T, 3 J + 3 + E) float32 of the frames `first` and on: axis-angle vectors of the joints,
    hands complete, translation in metres, expressions. It replaces what was sent of these and later frames. With
    `sound` (N,) int16 at `rate` somebody speaks from the first of them on. `now` is the present, in seconds.

    Args:
        performer: who acts. body: its joints, as `avatar.runtime.skeleton.skeleton_body` gives them.
        send: takes a message. clock: seconds.
    """

    def __init__(
        self,
        performer: Performer,
        body: BodyModel,
        send: Callable[[bytes], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._performer, self._body, self._send, self._clock = performer, body, send, clock
        self._began = clock()
        self._lock = threading.Lock()
        self._listening = False
        self._said_until = 0.0

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self._performer.config.fps

    @property
    def now(self) -> float:
        """Seconds since it began."""
        return self._clock() - self._began

    @property
    def speaking(self) -> bool:
        """Whether a sentence is not over."""
        return self.now < self._said_until

    def keep_ahead(self) -> None:
        """Make frames of somebody who waits or listens, up to `AHEAD` of the present."""
        with self._lock:
            missing = self.now + AHEAD - self._performer.seconds
            if missing > 0.25 * AHEAD:
                self._idle(missing)

    def listen(self, listening: bool) -> None:
        """Begin or end to listen; at once, unless somebody speaks."""
        with self._lock:
            if listening == self._listening:
                return
            self._listening = listening
            if not self.speaking:
                self._performer.cut(self.now + SOON)
                self._idle(AHEAD)

    def say(self, spoken: Spoken, line: Line, wanted: Callable[[], bool] = lambda: True) -> None:
        """Speak next: at once, or behind what is being said; nothing where it is not wanted any more."""
        with self._lock:
            if not wanted():
                return
            self._performer.cut(max(self.now + SOON, self._said_until))
            first = self._number
            motion = self._performer.talk(spoken.speech, more=True)
            self._said_until = self._performer.seconds
            sound = {"sound": spoken.sound.integers()}
            about = {"rate": spoken.sound.rate, "turn": line.turn, "line": line.number, "text": line.text}
            self._tell(first, motion, sound, about)
            # What comes behind it, in case that the page is asked for it before the next sentence is there.
            self._idle(AHEAD)

    def hush(self) -> None:
        """Stop speaking."""
        with self._lock:
            if self.speaking:
                self._performer.cut(self.now + SOON)
                self._said_until = 0.0
                self._idle(AHEAD)

    @property
    def _number(self) -> int:
        return round(self._performer.seconds * self.fps)

    def _idle(self, seconds: float) -> None:
        first = self._number
        self._tell(first, self._performer.idle(seconds, listening=self._listening), {}, {})

    def _tell(self, first: int, motion: BodyParams, more: dict[str, np.ndarray], about: dict[str, object]) -> None:
        said = {"first": first, "fps": self.fps, "now": round(self.now, 4), **about}
        self._send(pack_tensors({"rows": rows_of(self._body, motion), **more}, said))


def rows_of(body: BodyModel, motion: BodyParams) -> Float32[np.ndarray, "T W"]:
    """Frames as a page takes them: axis-angle vectors of all joints, translation, expressions, side by side."""
    turns = body.axis_angles(motion).reshape(len(motion), -1)
    return np.concatenate([turns, motion.transl, motion.expression], axis=1).astype(np.float32)
