"""Measure how well English is told from other languages in recordings, from the words that are recognised.

    python -m benchmarks spoken_languages --recordings DIR [--seconds 7]

DIR has a folder a language by its code (en, de, fr, ...) with recordings of people in any kind of file; nothing of
them is stored but figures. Of each the first seconds are heard. A recording is taken for English where
`avatar.speech.forced_alignment.Recognition` says so; of the voices that are refused the words are shown, too, because
an accent that the recogniser does not understand is better followed by its sounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from avatar.speech.forced_alignment import MIN_ENGLISH, load_recogniser, recognise
from benchmarks.support.results import store_results
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound, read_sound

_GATES = np.arange(0.0, 1.2, 0.01)


@dataclass(frozen=True)
class SpokenLanguages:
    """Hear, recognise, compare, store."""

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
        command = "python -m benchmarks spoken_languages --recordings DIR"
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
        wrong = [(english < gate).mean() + (rest >= gate).mean() for gate in _GATES]
        gate = float(_GATES[int(np.argmin(wrong))])
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
    tyro.cli(SpokenLanguages, prog="python -m benchmarks spoken_languages").run()
