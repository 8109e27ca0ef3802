"""Measure the gates of the aligner: the texts that it accepts for a recording, and the languages taken for English.

python -m benchmarks aligner_gates texts [--flite PROGRAM]
python -m benchmarks aligner_gates languages --recordings DIR [--seconds 7]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from avatar.speech import Speech
from avatar.speech.forced_alignment import MIN_ENGLISH, MIN_SCORE_OF_TEXT, force_align, load_recogniser, recognise
from avatar.speech.lips import LipNetwork, alignment_score
from benchmarks.accuracy.live_lips import MORE, said_by_voices
from benchmarks.accuracy.talking import SENTENCES, milliseconds, starts_apart
from benchmarks.support.results import store_results
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound, read_sound

OTHERS = (1, 4, 7, 8, 11, 13)
"""Offsets from a sentence to its wrong texts."""
_TEXT_GATES = np.arange(-0.5, 1.0, 0.01)


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
    """Count the texts that the aligner accepts for a recording: its own, and those of other recordings.

    The voices of `benchmarks.accuracy.live_lips` speak its twenty sentences. Each recording is given its own text and
    six others. A text that the recogniser can align is accepted if `avatar.speech.lips.alignment_score` finds that it
    fits the sound. The gate is 0 for all voices; beside it stands the result of the gate with the fewest errors on
    all other voices.
    """

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
        command = "python -m benchmarks aligner_gates texts --flite PROGRAM"
        print(f"stored {store_results('given_texts', command, figures).name}")


def _left_out(voices: dict[str, Taken], name: str) -> dict[str, Any]:
    others = [it for other, it in voices.items() if other != name]
    counts = [sum(sum(it.errors(gate)) for it in others) for gate in _TEXT_GATES]
    gate = float(_TEXT_GATES[int(np.argmin(counts))])
    refused, taken = voices[name].errors(gate)
    return {"gate": round(gate, 2), "right texts refused": refused, "wrong texts taken": taken}


_ENGLISH_GATES = np.arange(0.0, 1.2, 0.01)


@dataclass(frozen=True)
class SpokenLanguages:
    """Measure how well English is told from other languages in recordings, from the words that are recognised.

    DIR has a folder a language by its code (en, de, fr, ...) with recordings of people in any kind of file; nothing
    of them is stored but figures. Of each the first seconds are heard. A recording is taken for English where
    `avatar.speech.forced_alignment.Recognition` says so; of the voices that are refused the words are shown, too,
    because an accent that the recogniser does not understand is better followed by its sounds.
    """

    recordings: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """A folder of folders of recordings, each named by a language's code."""
    seconds: float = 7.0
    """Length of what is heard of each."""

    def run(self) -> None:
        """Print and store the figures."""
        recogniser, rows = load_recogniser(), []
        files = sorted(path for path in self.recordings.glob("*/*") if path.is_file())
        if not {path.parent.name for path in files} > {"en"}:
            raise InputError(
                f"folder {self.recordings}", expected="en and other languages", received=f"{len(files)} files"
            )
        for path in files:
            rows.append(self._row(path, recogniser))
            print(rows[-1], flush=True)
        # What people say is not stored.
        stored = [{key: value for key, value in row.items() if key != "words"} for row in rows]
        figures = {"languages": by_language(rows), "gates": gates(rows), "recordings": stored}
        print(figures["languages"], figures["gates"], sep="\n")
        command = "python -m benchmarks aligner_gates languages --recordings DIR"
        print(f"stored {store_results('spoken_languages', command, figures).name}")

    def _row(self, path: Path, recogniser: Any) -> dict[str, Any]:
        sound = read_sound(path)
        sound = Sound(sound.samples[: round(self.seconds * sound.rate)], sound.rate)
        row: dict[str, Any] = {"language": path.parent.name, "name": path.stem, "seconds": round(sound.seconds, 1)}
        try:
            found = recognise(sound, recogniser=recogniser)
        except InputError:  # no words of English, or a silent beginning
            return row | {"agreement": None, "confidence": None, "score": None, "words": ""}
        return row | {
            "agreement": round(found.agreement, 2),
            "confidence": round(found.confidence, 2),
            "score": round(found.score, 2),
            "words": found.speech.transcript,
        }


def by_language(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each language how many recordings are taken for English, and the least and the greatest score."""
    out = {}
    for language in dict.fromkeys(row["language"] for row in rows):
        scores = _scores(rows, language)
        out[language] = {
            "recordings": len(scores),
            "taken for English": int((scores >= MIN_ENGLISH).sum()),
            "least": round(float(scores.min()), 2),
            "median": round(float(np.median(scores)), 2),
            "greatest": round(float(scores.max()), 2),
        }
    return out


def gates(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the errors of the gate in use, and the gate that has the fewest on the other languages' recordings."""
    english = _scores(rows, "en")
    others = {one: _scores(rows, one) for one in dict.fromkeys(row["language"] for row in rows) if one != "en"}
    every = np.concatenate(list(others.values()))
    left_out = {}
    for name, own in others.items():
        rest = np.concatenate([scores for other, scores in others.items() if other != name] or [every])
        wrong = [(english < gate).mean() + (rest >= gate).mean() for gate in _ENGLISH_GATES]
        gate = float(_ENGLISH_GATES[int(np.argmin(wrong))])
        left_out[name] = {"gate": round(gate, 2), "taken for English": int((own >= gate).sum()), "of": len(own)}
    return {
        "gate": MIN_ENGLISH,
        "English refused": int((english < MIN_ENGLISH).sum()),
        "others taken": int((every >= MIN_ENGLISH).sum()),
        "chosen without a language": left_out,
    }


def _scores(rows: list[dict[str, Any]], language: str) -> np.ndarray:
    """Scores of a language's recordings; -1 where no words were found."""
    return np.array([-1.0 if row["score"] is None else row["score"] for row in rows if row["language"] == language])


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"texts": GivenTexts, "languages": SpokenLanguages}).run()
