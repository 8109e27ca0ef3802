"""Whether somebody speaks: Silero's model where its package is there, else the loudness above the room's."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Int16

from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.validation import require_positive

RATE = 16_000
"""Samples a second that are listened to."""
BLOCK = 512
"""Samples that are judged at once: 32 ms."""
_PACKAGE = "silero_vad"
_CONTEXT = 64  # samples of the last block that Silero's model sees again
_STATE = (2, 1, 128)
_LOUDER = 4.0  # times the room's level, from which it counts as speech
_QUIETEST = 0.004  # of full scale: below it nobody speaks
_ROOM = 0.02  # share by which the room's level follows what is louder than it


class Activity(Protocol):
    """A judge of blocks; `name` says which."""

    name: str

    def __call__(self, block: Float32[np.ndarray, " 512"]) -> float:
        """Return how sure it is that somebody speaks, 0 to 1."""
        ...


class SileroActivity:
    """The ONNX model inside the package silero-vad (MIT); of the package itself nothing is imported, nor torch.

    Raises:
        InputError: the package's file is damaged.
        MissingExtraError: no onnxruntime.
    """

    name = "silero-vad"

    def __init__(self, model: Path) -> None:
        self._model = OnnxModel(model, kind="voice activity", extra="chat", threads=1)
        self._rate = np.array(RATE, np.int64)
        self._state = np.zeros(_STATE, np.float32)
        self._before = np.zeros(_CONTEXT, np.float32)

    def __call__(self, block: Float32[np.ndarray, " 512"]) -> float:
        whole = np.concatenate([self._before, block])[None]
        said, self._state = self._model.run({"input": whole, "state": self._state, "sr": self._rate})
        self._before = block[-_CONTEXT:]
        return float(np.ravel(said)[0])


class LoudnessActivity:
    """Louder than the room is speech: simple, and taken in by any noise that comes and goes."""

    name = "loudness (silero-vad is not installed)"

    def __init__(self) -> None:
        self._room = _QUIETEST / _LOUDER

    def __call__(self, block: Float32[np.ndarray, " 512"]) -> float:
        level = float(np.sqrt(np.mean(np.square(block))))
        self._room += (level - self._room) * (_ROOM if level > self._room else 0.5)
        return float(level > max(_LOUDER * self._room, _QUIETEST))


def find_activity() -> Activity:
    """Return Silero's model if its package is installed, else the loudness."""
    spec = find_spec(_PACKAGE)
    if spec is None or spec.origin is None or find_spec("onnxruntime") is None:
        return LoudnessActivity()
    model = Path(spec.origin).parent / "data" / "silero_vad.onnx"
    return SileroActivity(model) if model.is_file() else LoudnessActivity()


@dataclass(frozen=True, kw_only=True)
class ListenConfig:
    """When somebody has begun to speak, and when to answer.

    Attributes:
        sure: of a block, from which it counts. begin: seconds of speech that begin an utterance: coughs are shorter.
        pause: seconds of silence that end it. before: seconds ahead of its beginning that are heard too.
        longest: seconds after which it is cut.
    """

    sure: float = 0.5
    begin: float = 0.1
    pause: float = 0.55
    before: float = 0.35
    longest: float = 30.0

    def __post_init__(self) -> None:
        for name in ("sure", "begin", "pause", "before", "longest"):
            require_positive(name, getattr(self, name))


@dataclass(frozen=True, eq=False)
class Heard:
    """What a piece of sound brings.

    Attributes:
        samples: of an utterance, to be recognised. begins, ends: it does, with these samples.
        silent: seconds since its last speech, where it ends. cut: it ends because it is too long.
    """

    samples: Int16[np.ndarray, " N"]
    begins: bool = False
    ends: bool = False
    silent: float = 0.0
    cut: bool = False


@dataclass
class Listener:
    """Cuts a stream of sound into utterances.

    Attributes:
        activity: which blocks are speech. config: where utterances begin and end.
    """

    activity: Activity
    config: ListenConfig = field(default_factory=ListenConfig)

    def __post_init__(self) -> None:
        self._left = np.zeros(0, np.int16)
        kept = int(np.ceil((self.config.before + self.config.begin) * RATE / BLOCK))
        self._past: deque[np.ndarray] = deque(maxlen=kept)
        self._speaking = False
        self._speech = self._silence = self._length = 0

    def hear(self, samples: Int16[np.ndarray, " N"]) -> Iterator[Heard]:
        """Take the next samples at `RATE`; yield what is to be recognised, as soon as it is known."""
        whole = np.concatenate([self._left, samples])
        count = len(whole) // BLOCK
        self._left = whole[count * BLOCK :]
        for block in whole[: count * BLOCK].reshape(-1, BLOCK):
            sure = self.activity(block.astype(np.float32) / np.float32(32768.0)) >= self.config.sure
            heard = self._within(block, sure) if self._speaking else self._outside(block, sure)
            if heard is not None:
                yield heard

    def _outside(self, block: np.ndarray, speech: bool) -> Heard | None:
        self._past.append(block)
        self._speech = self._speech + 1 if speech else 0
        if self._speech * BLOCK < self.config.begin * RATE:
            return None
        samples = np.concatenate(self._past)
        self._past.clear()
        self._speaking, self._silence, self._length, self._speech = True, 0, len(samples), 0
        return Heard(samples, begins=True)

    def _within(self, block: np.ndarray, speech: bool) -> Heard:
        self._silence = 0 if speech else self._silence + BLOCK
        self._length += BLOCK
        cut = self._length >= self.config.longest * RATE
        ends = cut or self._silence >= self.config.pause * RATE
        self._speaking = not ends
        return Heard(block, ends=ends, silent=self._silence / RATE, cut=cut)
