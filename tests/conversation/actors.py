"""Stand-ins for the parts of a conversation: a voice that hums, somebody who dances, a partner with a script."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from avatar.conversation.conversation import ChatParts
from avatar.conversation.hearing import LoudnessActivity
from avatar.runtime import load_bundle
from avatar.runtime.skeleton import skeleton_body
from avatar.speech import Phoneme, Speech
from avatar.speech.voice import SynthesizedSpeech
from smplxpp.body.model import BodyModel
from smplxpp.core import BodyParams, InputError
from smplxpp.core.files.sound_file import Sound
from tests.dolls.dancing import dance
from tests.web.avatars import write_avatar

RATE = 22050
A_CHARACTER = 0.05
"""Seconds that a character is hummed for."""


class Hum:
    """A voice: so long as the text, one vowel, loud."""

    def say(self, text: str, *, wanted: Callable[[], bool] = lambda: True) -> SynthesizedSpeech:
        if not text.isascii():
            raise InputError("text", expected="English", received=text)
        samples = np.full(int(len(text) * A_CHARACTER * RATE), 0.5, np.float32)
        sound = Sound(samples, RATE)
        return SynthesizedSpeech(sound, Speech((Phoneme("AA", 0.0, sound.seconds),), sound.seconds), [])


class Dancer:
    """A animator: frame k is the dance's frame k, whatever is asked for; what was asked for is kept."""

    def __init__(self, fps: float = 30.0) -> None:
        self.config = SimpleNamespace(fps=fps)
        self.made = 0
        self.asked: list[tuple[Any, ...]] = []

    @property
    def seconds(self) -> float:
        return self.made / self.config.fps

    def _frames(self, count: int) -> BodyParams:
        motion = dance()
        at = np.arange(self.made, self.made + count) % len(motion)
        self.made += count
        return replace(motion.select(at.tolist()), fps=self.config.fps)

    def talk(self, speech: Speech, *, more: bool = False) -> BodyParams:
        self.asked.append(("talk", self.made, speech.seconds))
        return self._frames(int(np.ceil(speech.seconds * self.config.fps - 1e-9)))

    def idle(self, seconds: float, *, listening: bool = False) -> BodyParams:
        self.asked.append(("idle", self.made, listening))
        return self._frames(int(np.ceil(seconds * self.config.fps - 1e-9)))

    def rewind(self, seconds: float) -> None:
        self.made = min(self.made, round(seconds * self.config.fps))


@dataclass
class Script:
    """A partner that says pieces, and the first time waits at the piece "..." until it is cancelled."""

    pieces: Sequence[str] = ("Hello there. ", "How are ", "you?")
    name: str = "a script"
    asked: list[list[tuple[str, str]]] = field(default_factory=list)
    cancelled: threading.Event = field(default_factory=threading.Event)

    def answer(self, history: Sequence[tuple[str, str]]) -> Iterator[str]:
        self.asked.append(list(history))
        for piece in self.pieces:
            if piece == "..." and len(self.asked) > 1:
                continue
            if piece == "...":
                assert self.cancelled.wait(900)
                raise InputError("partner", expected="an answer", received="an end")
            yield piece

    def cancel(self) -> None:
        self.cancelled.set()

    def another(self) -> Script:
        return self


class Words:
    """A recogniser that hears the same words in every utterance."""

    other_language = ""

    def __init__(self, words: str = "hello") -> None:
        self.words, self.samples, self.open = words, 0, False

    def begin(self) -> None:
        self.samples, self.open = 0, True

    def hear(self, samples: np.ndarray) -> None:
        assert self.open
        self.samples += len(samples)

    def end(self) -> str:
        self.open = False
        return self.words


@cache
def _doll(folder: Path) -> tuple[bytes, BodyModel]:
    data = write_avatar(folder / "doll.avatar")
    return data, skeleton_body(load_bundle(folder / "doll.avatar"))


def doll(folder: Path) -> tuple[bytes, BodyModel]:
    """The doll's file and its joints."""
    return _doll(folder)


def cast(body: BodyModel, **changes: Any) -> ChatParts:
    """Everybody of a conversation."""
    parts: dict[str, Any] = {
        "voice": Hum(),
        "partner": Script(),
        "animator": Dancer,
        "body": body,
        "activity": LoudnessActivity,
        "recogniser": Words(),
    }
    parts = {**parts, **changes}
    words = parts.pop("recogniser")
    lent = SimpleNamespace(take=lambda: words, give_back=lambda _: None)
    return ChatParts(**parts, recognisers=lent)
