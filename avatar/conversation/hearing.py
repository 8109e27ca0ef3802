"""Detect speech in a microphone stream, cut it into utterances, and recognise their words.

Voice activity comes from Silero's model where its package is installed, else from the loudness above the room's.
Words come from pocketsphinx while they are spoken, so that little is left to do at the end of an utterance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Int16

from avatar.speech.forced_alignment import NotEnglishError, hypothesis, judge, listen_for_words
from smplxpp.core import InputError, require_positive
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.files.sound_file import Sound
from smplxpp.core.lazy import import_extra

# Sample rate (Hz) and block length (samples, 32 ms) of Silero's model; pocketsphinx takes the same rate.
RATE = 16_000
BLOCK = 512


class Activity(Protocol):
    """A detector of voice activity with a `name` for the terminal."""

    name: str

    def __call__(self, block: Float32[np.ndarray, " 512"]) -> float:
        """Return the probability of speech in a block, 0 to 1."""
        ...


class SileroActivity:
    """The ONNX model inside the package silero-vad (MIT), run without importing the package or torch.

    Raises:
        InputError: the package's file is damaged.
        MissingExtraError: no onnxruntime.
    """

    name = "silero-vad"
    context = 64
    """Samples of the previous block that the model takes in front of a block; given by the model."""

    def __init__(self, model: Path) -> None:
        self._model = OnnxModel(model, kind="voice activity", extra="chat", threads=1)
        self._rate = np.array(RATE, np.int64)
        self._state = np.zeros((2, 1, 128), np.float32)  # shape of the model's recurrent state
        self._before = np.zeros(self.context, np.float32)

    def __call__(self, block: Float32[np.ndarray, " 512"]) -> float:
        whole = np.concatenate([self._before, block])[None]
        probability, self._state = self._model.run({"input": whole, "state": self._state, "sr": self._rate})
        self._before = block[-self.context :]
        return float(np.ravel(probability)[0])


class LoudnessActivity:
    """Speech is what is louder than the room: simple, and deceived by any intermittent noise.

    Attributes:
        ratio: RMS level over the room's from which a block counts as speech (12 dB).
        floor: RMS level, of full scale, below which nothing counts as speech.
    """

    name = "loudness (silero-vad is not installed)"
    ratio = 4.0
    floor = 0.004

    def __init__(self) -> None:
        self._room = self.floor / self.ratio

    def __call__(self, block: Float32[np.ndarray, " 512"]) -> float:
        level = float(np.sqrt(np.mean(np.square(block))))
        # The room's level follows quiet blocks at once and loud ones slowly (2 % a block, about 1.6 s), because loud
        # blocks are mostly speech.
        self._room += (level - self._room) * (0.02 if level > self._room else 0.5)
        return float(level > max(self.ratio * self._room, self.floor))


def find_activity() -> Activity:
    """Return Silero's model if its package is installed, else the loudness."""
    spec = find_spec("silero_vad")
    if spec is None or spec.origin is None or find_spec("onnxruntime") is None:
        return LoudnessActivity()
    model = Path(spec.origin).parent / "data" / "silero_vad.onnx"
    return SileroActivity(model) if model.is_file() else LoudnessActivity()


@dataclass(frozen=True, kw_only=True)
class ListenConfig:
    """Thresholds that begin and end an utterance.

    Attributes:
        threshold: probability from which a block counts as speech.
        begin: seconds of speech that begin an utterance; coughs are shorter.
        pause: seconds of silence that end it. Shorter pauses cut sentences, longer ones delay the answer.
        before: seconds before its beginning that belong to it, because soft onsets are detected late.
        longest: seconds after which it is cut.
    """

    threshold: float = 0.5
    begin: float = 0.1
    pause: float = 0.55
    before: float = 0.35
    longest: float = 30.0

    def __post_init__(self) -> None:
        for name in ("threshold", "begin", "pause", "before", "longest"):
            require_positive(name, getattr(self, name))


@dataclass(frozen=True, eq=False)
class UtterancePart:
    """A piece of sound of an utterance.

    Attributes:
        samples: sound to be recognised.
        begins: whether the utterance begins with these samples.
        ends: whether it ends with them.
        silent: seconds since its last speech, where it ends.
        cut: whether it ends because it is too long.
    """

    samples: Int16[np.ndarray, " N"]
    begins: bool = False
    ends: bool = False
    silent: float = 0.0
    cut: bool = False


@dataclass
class Listener:
    """Cut a stream of sound into utterances.

    Attributes:
        activity: detector of voice activity.
        config: bounds of an utterance.
    """

    activity: Activity
    config: ListenConfig = field(default_factory=ListenConfig)

    def __post_init__(self) -> None:
        self._remainder = np.zeros(0, np.int16)
        kept = int(np.ceil((self.config.before + self.config.begin) * RATE / BLOCK))
        self._past: deque[np.ndarray] = deque(maxlen=kept)
        self._speaking = False
        self._speech = self._silence = self._length = 0

    def hear(self, samples: Int16[np.ndarray, " N"]) -> Iterator[UtterancePart]:
        """Take the next samples at `RATE` and yield the parts of utterances in them, as early as possible."""
        whole = np.concatenate([self._remainder, samples])
        count = len(whole) // BLOCK
        self._remainder = whole[count * BLOCK :]
        for block in whole[: count * BLOCK].reshape(-1, BLOCK):
            speech = self.activity(block.astype(np.float32) / np.float32(32768.0)) >= self.config.threshold
            part = self._within(block, speech) if self._speaking else self._outside(block, speech)
            if part is not None:
                yield part

    def _outside(self, block: np.ndarray, speech: bool) -> UtterancePart | None:
        """Return the beginning of an utterance once `begin` seconds of speech have come, else None."""
        self._past.append(block)
        self._speech = self._speech + 1 if speech else 0
        if self._speech * BLOCK < self.config.begin * RATE:
            return None
        samples = np.concatenate(self._past)
        self._past.clear()
        self._speaking, self._silence, self._length, self._speech = True, 0, len(samples), 0
        return UtterancePart(samples, begins=True)

    def _within(self, block: np.ndarray, speech: bool) -> UtterancePart:
        """Return the next block of an utterance, and whether it is the last."""
        self._silence = 0 if speech else self._silence + BLOCK
        self._length += BLOCK
        cut = self._length >= self.config.longest * RATE
        ends = cut or self._silence >= self.config.pause * RATE
        self._speaking = not ends
        return UtterancePart(block, ends=ends, silent=self._silence / RATE, cut=cut)


class Recogniser:
    """Recognise English words with pocketsphinx, one utterance after the other.

    Words of low confidence are aligned with their sound: those that do not match it are another language or noise.

    Attributes:
        other_language: of the last utterance: why its words are none of English, a sentence; "" where they are.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
    """

    _sure = 0.7
    """Confidence from which words are not aligned, which would take a third of the utterance's time; among the
    recordings of `python -m benchmarks spoken_languages` no other language reaches it."""
    _shortest = 1.0
    """Seconds below which an utterance is not doubted: a word or two tell no language."""

    def __init__(self) -> None:
        pocketsphinx = import_extra("pocketsphinx", extra="chat", purpose="recognising spoken words")
        self._decoder = pocketsphinx.Decoder(samprate=float(RATE), loglevel="FATAL")
        self._open = False
        self._samples: list[np.ndarray] = []
        self.other_language = ""

    def begin(self) -> None:
        """Begin an utterance and drop one that was not ended."""
        if self._open:
            self._decoder.end_utt()
        self._samples = []
        listen_for_words(self._decoder)
        self._decoder.start_utt()
        self._open = True

    def hear(self, samples: Int16[np.ndarray, " N"]) -> None:
        """Take the next samples of the utterance."""
        self._samples.append(samples)
        self._decoder.process_raw(samples.astype("<i2").tobytes())

    def end(self) -> str:
        """Return the words of the utterance, "" if it has none; `other_language` tells whether they are English."""
        self._decoder.end_utt()
        self._open, self.other_language = False, ""
        try:
            words, confidence = hypothesis(self._decoder)
        except NotEnglishError:
            return ""
        spoken = " ".join(words)
        sound = Sound(np.concatenate(self._samples).astype(np.float32) / np.float32(32768.0), RATE)
        if confidence < self._sure and sound.seconds >= self._shortest:
            try:
                english = judge(sound, words, confidence, recogniser=self._decoder).english
            except InputError:  # no better than at random, or hardly a sound
                english = False
            self.other_language = (
                "" if english else f'That did not sound like English; the nearest words are "{spoken}".'
            )
        return spoken


class Recognisers:
    """Lends recognisers to conversations, which need one each for what they have heard: 0.3 s and 92 MB.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
    """

    def __init__(self) -> None:
        self._free = [Recogniser()]

    def take(self) -> Recogniser:
        """Return a free one, a new one if need be."""
        try:
            return self._free.pop()
        except IndexError:
            return Recogniser()

    def give_back(self, recogniser: Recogniser) -> None:
        """Take one back, for the next conversation."""
        self._free.append(recogniser)
