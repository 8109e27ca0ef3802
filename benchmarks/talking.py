"""When lips close and phonemes begin, against the times that a voice spoke at.

    python -m benchmarks.talking

A Piper voice (extra `[talk]`) says sentences and tells how long each of its phonemes was: the truth here. The aligner
hears the sound, once with the words and once without. Measured are starts of phonemes that both name, and the pictures
in which the lips are closed, at 30 a second, against the middle of each bilabial.
"""

from __future__ import annotations

import difflib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

from avatar.speech import ARTICULATORS, Speech, articulate
from avatar.speech.aligner import align
from avatar.speech.phonemes import BILABIALS
from avatar.speech.voice import PiperVoice
from benchmarks.machine import store_results

SENTENCES = (
    "Please bring my umbrella before the big storm.",
    "People may put both blue boats by the pier!",
    "She sells fresh fish from a shop near the bay.",
    "Remember, the problem is simple: move up, then stop.",
    "Five very brave men opened the heavy door.",
)
PICTURES = 30
CLOSED = 0.95
"""Of the lips' pressing, from which they count as closed."""
NEAR = 0.15
"""Seconds from the middle of a bilabial within which lips that close belong to it."""


@dataclass(frozen=True)
class Talking:
    """Say, hear, measure, store."""

    def run(self) -> None:
        """Print and store the figures."""
        voice = PiperVoice(threads=1)
        starts: dict[str, list[float]] = {}
        closures: dict[str, list[float]] = {}
        factors: dict[str, list[float]] = {}
        missed: dict[str, int] = {}
        phonemes = bilabials = 0
        for text in SENTENCES:
            began = time.process_time()
            said = voice.say(text)
            factors.setdefault("synthesis", []).append((time.process_time() - began) / said.sound.seconds)
            heard = {"the voice": said.speech}
            for name, words in (("words given", text), ("words recognised", None)):
                began = time.process_time()
                heard[name] = align(said.sound, words)
                factors.setdefault(name, []).append((time.process_time() - began) / said.sound.seconds)
                starts.setdefault(name, []).extend(starts_apart(said.speech, heard[name]))
            phonemes += len(said.speech.spoken)
            bilabials += sum(phoneme.name in BILABIALS for phoneme in said.speech.spoken)
            for name, speech in heard.items():
                found, lost = closures_apart(said.speech, speech)
                closures.setdefault(name, []).extend(found)
                missed[name] = missed.get(name, 0) + lost
        figures = {
            "sentences": len(SENTENCES),
            "phonemes": phonemes,
            "bilabials": bilabials,
            "starts of phonemes, ms": {k: {"matched": len(v), **milliseconds(v)} for k, v in starts.items()},
            "lips closed, ms": {k: {"missed": missed[k], **milliseconds(v)} for k, v in closures.items()},
            "seconds of CPU a second of sound": {k: round(float(np.mean(v)), 3) for k, v in factors.items()},
        }
        for name, value in figures.items():
            print(f"{name:34s} {value}")
        print(f"stored {store_results('talking', 'python -m benchmarks.talking', figures).name}")


def starts_apart(truth: Speech, other: Speech) -> list[float]:
    """Return how much later phonemes that both name in the same order begin, seconds."""
    ours, theirs = truth.spoken, other.spoken
    matcher = difflib.SequenceMatcher(None, [p.name for p in ours], [p.name for p in theirs], autojunk=False)
    return [
        theirs[block.b + k].start - ours[block.a + k].start
        for block in matcher.get_matching_blocks()
        for k in range(block.size)
    ]


def closures_apart(truth: Speech, other: Speech) -> tuple[list[float], int]:
    """Return how much later lips are closed than in the middle of each bilabial, seconds, and how many they miss."""
    times = np.arange(int(other.seconds * PICTURES) + 1) / PICTURES
    closed = times[articulate(other, times)[:, ARTICULATORS.index("press")] > CLOSED]
    found, missed = [], 0
    for phoneme in truth.spoken:
        if phoneme.name not in BILABIALS:
            continue
        away = closed - 0.5 * (phoneme.start + phoneme.end)
        nearest = away[np.abs(away).argmin()] if len(away) else np.inf
        if abs(nearest) < NEAR:
            found.append(float(nearest))
        else:
            missed += 1
    return found, missed


def milliseconds(apart: Sequence[float] | Float[np.ndarray, " N"]) -> dict[str, Any]:
    """Return bias, mean and 95th percentile of the sizes of some times."""
    ms = 1e3 * np.asarray(apart)
    return {
        "bias": round(float(ms.mean())),
        "mean": round(float(np.abs(ms).mean())),
        "p95": round(float(np.percentile(np.abs(ms), 95))),
    }


if __name__ == "__main__":
    tyro.cli(Talking, prog="python -m benchmarks.talking").run()
