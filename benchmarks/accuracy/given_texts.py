"""Count the texts that the aligner accepts for a recording: its own, and those of other recordings.

    python -m benchmarks given_texts [--flite PROGRAM]

The voices of `benchmarks.accuracy.live_lips` speak its twenty sentences. Each recording is given its own text and six
others. A text that the recogniser can align is accepted if `avatar.speech.lips.alignment_score` finds that it fits the
sound.
The gate is 0 for all voices; beside it stands the result of the gate with the fewest errors on all other voices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from avatar.speech import Speech
from avatar.speech.forced_alignment import MIN_SCORE_OF_TEXT, force_align, load_recogniser
from avatar.speech.lips import LipNetwork, alignment_score
from benchmarks.accuracy.live_lips import MORE, said_by_voices
from benchmarks.accuracy.talking import SENTENCES, milliseconds, starts_apart
from benchmarks.support.results import store_results
from smplxpp.core.files.sound_file import Sound

OTHERS = (1, 4, 7, 8, 11, 13)
"""Offsets from a sentence to its wrong texts."""
_GATES = np.arange(-0.5, 1.0, 0.01)


@dataclass
class Taken:
    """Counts of accepted and refused texts.

    Attributes:
        right, wrong: agreement of the texts that the recogniser could align. texts: number given of each kind.
        apart: delay of phoneme starts of right texts, in seconds.
    """

    right: list[float] = field(default_factory=list)
    wrong: list[float] = field(default_factory=list)
    texts: list[int] = field(default_factory=lambda: [0, 0])
    apart: list[float] = field(default_factory=list)

    def give(self, sound: Sound, texts: Sequence[str], recogniser: Any, truth: Speech | None = None) -> None:
        """Give a recording its own text and behind it others."""
        heard = LipNetwork.shipped()(sound)
        for k, text in enumerate(texts):
            found = force_align(sound, text, recogniser)
            self.texts[k > 0] += 1
            if found is not None:
                (self.wrong if k else self.right).append(alignment_score(heard, found))
                self.apart += starts_apart(truth, found) if truth is not None and k == 0 else []

    def errors(self, gate: float = MIN_SCORE_OF_TEXT) -> tuple[int, int]:
        """Return how many right texts are refused, by either, and how many wrong ones are taken."""
        return self.texts[0] - sum(one >= gate for one in self.right), sum(one >= gate for one in self.wrong)

    def figures(self) -> dict[str, Any]:
        """Return the counts of one voice."""
        refused, taken = self.errors()
        return {
            "right texts": self.texts[0],
            "refused": refused,
            "of these without a way": self.texts[0] - len(self.right),
            "wrong texts": self.texts[1],
            "with a way": len(self.wrong),
            "taken": taken,
            "least agreement of a right text": round(min(self.right), 2),
            "most of a wrong one": round(max(self.wrong), 2) if self.wrong else None,
        }


@dataclass(frozen=True)
class GivenTexts:
    """Say, give, count, store."""

    flite: Path | None = None
    """The program flite, for its voices."""

    def run(self) -> None:
        """Print and store the figures."""
        texts, recogniser = (*SENTENCES, *MORE), load_recogniser()
        voices: dict[str, Taken] = {}
        for name, utterances in said_by_voices(self.flite):
            it = voices[name] = Taken()
            for k, (sound, truth) in enumerate(utterances):
                given = [texts[(k + far) % len(texts)] for far in (0, *OTHERS)]
                it.give(sound, given, recogniser, truth)
            print(f"{name:34s} {it.figures()} {milliseconds(it.apart)}", flush=True)
        figures = {
            "texts": {name: it.figures() for name, it in voices.items()},
            "starts of phonemes, ms": {name: milliseconds(it.apart) for name, it in voices.items()},
            "with a gate chosen on the other voices": {name: _left_out(voices, name) for name in voices},
        }
        command = "python -m benchmarks given_texts --flite PROGRAM"
        print(f"stored {store_results('given_texts', command, figures).name}")


def _left_out(voices: dict[str, Taken], name: str) -> dict[str, Any]:
    others = [it for other, it in voices.items() if other != name]
    counts = [sum(sum(it.errors(gate)) for it in others) for gate in _GATES]
    gate = float(_GATES[int(np.argmin(counts))])
    refused, taken = voices[name].errors(gate)
    return {"gate": round(gate, 2), "right texts refused": refused, "wrong texts taken": taken}


if __name__ == "__main__":
    tyro.cli(GivenTexts, prog="python -m benchmarks given_texts").run()
