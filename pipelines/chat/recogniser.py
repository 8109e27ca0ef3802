"""Words of an utterance by pocketsphinx, while it is still being spoken: what is left at its end takes little time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int16

from pipelines.chat.voice_activity import RATE
from smplxpp.core.errors import MissingExtraError


class Recogniser:
    """English words, one utterance after the other.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
    """

    def __init__(self) -> None:
        try:
            import pocketsphinx
        except ImportError:
            raise MissingExtraError("pocketsphinx", extra="chat", purpose="words that are spoken") from None
        self._decoder = pocketsphinx.Decoder(samprate=float(RATE), loglevel="FATAL")
        self._open = False

    def begin(self) -> None:
        """Begin an utterance; what was not ended is dropped."""
        if self._open:
            self._decoder.end_utt()
        self._decoder.start_utt()
        self._open = True

    def hear(self, samples: Int16[np.ndarray, " N"]) -> None:
        """Take the next samples of the utterance."""
        self._decoder.process_raw(samples.astype("<i2").tobytes())

    def end(self) -> str:
        """Return the words of the utterance, "" where it has none."""
        self._decoder.end_utt()
        self._open = False
        found = self._decoder.hyp()
        words = [] if found is None else found.hypstr.split()
        return " ".join(word for word in words if word[0] not in "<[+")
