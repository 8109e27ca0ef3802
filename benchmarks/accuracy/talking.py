"""Compare times of closed lips and of phonemes with the times at which a synthetic voice spoke.

    python -m benchmarks talking

A Piper voice (extra `[talk]`) says sentences and tells how long each of its phonemes was: the truth here. The aligner
hears the sound, once with the words and once without. Measured are starts of phonemes that both name, and the pictures
in which the lips are closed, at 30 a second, against the middle of each bilabial.
"""

from __future__ import annotations

import difflib
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

from avatar.speech import ARTICULATORS, Speech, articulate
from avatar.speech.forced_alignment import align
from avatar.speech.phonemes import BILABIALS, SILENCE
from avatar.speech.voice import PiperVoice
from benchmarks.support.results import store_results

SPEEDS = (0.8, 1.0, 1.25)
"""Factors of the voice's durations."""
SENTENCES = (
    "Please bring my umbrella before the big storm.",
    "People may put both blue boats by the pier!",
    "She sells fresh fish from a shop near the bay.",
    "Remember, the problem is simple: move up, then stop.",
    "Five very brave men opened the heavy door.",
)
VISEMES = {
    "lips closed": ("P", "B", "M"),
    "lip at teeth": ("F", "V"),
    "tongue ahead": ("TH", "DH", "T", "D", "N", "L"),
    "tongue behind": ("K", "G", "NG", "HH", "Y"),
    "teeth": ("S", "Z"),
    "teeth, round": ("CH", "JH", "SH", "ZH", "R", "ER"),
    "open": ("AA", "AE", "AH", "AY", "AW"),
    "half open": ("EH", "EY", "IH", "IY"),
    "round": ("AO", "OW", "OY", "UH", "UW", "W"),
}
"""Phonemes that look alike."""
PICTURES = 30
CLOSED = 0.95
"""Value of the lips' pressing from which they count as closed."""
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
        confused: dict[str, Counter[tuple[str, str]]] = {}
        by_speed: dict[float, list[float]] = {}
        phonemes = bilabials = 0
        for text in SENTENCES:
            began = time.process_time()
            spoken = voice.say(text)
            factors.setdefault("synthesis", []).append((time.process_time() - began) / spoken.sound.seconds)
            # The synthesiser knows when its phonemes begin; the aligner hears the sound, with and without its text.
            heard = {"the voice": spoken.speech}
            for name, words in (("words given", text), ("words recognised", None)):
                began = time.process_time()
                heard[name] = align(spoken.sound, words)
                factors.setdefault(name, []).append((time.process_time() - began) / spoken.sound.seconds)
                starts.setdefault(name, []).extend(starts_apart(spoken.speech, heard[name]))
            phonemes += len(spoken.speech.spoken)
            bilabials += sum(phoneme.name in BILABIALS for phoneme in spoken.speech.spoken)
            for name in ("words given", "words recognised"):
                confused.setdefault(name, Counter()).update(visemes_apart(spoken.speech, heard[name]))
            # A bias of the aligner that depends on the speed cannot be corrected by one constant.
            for slower in SPEEDS:
                slow = spoken if slower == 1.0 else voice.say(text, slower=slower)
                aligned = heard["words given"] if slower == 1.0 else align(slow.sound, text)
                by_speed.setdefault(slower, []).extend(starts_apart(slow.speech, aligned))
            for name, speech in heard.items():
                found, lost = closures_apart(spoken.speech, speech)
                closures.setdefault(name, []).extend(found)
                missed[name] = missed.get(name, 0) + lost
        figures = {
            "sentences": len(SENTENCES),
            "phonemes": phonemes,
            "bilabials": bilabials,
            "starts of phonemes, ms": {k: {"matched": len(v), **milliseconds(v)} for k, v in starts.items()},
            "lips closed, ms": {k: {"missed": missed[k], **milliseconds(v)} for k, v in closures.items()},
            "mouth shapes, % of the time": {k: shares(v) for k, v in confused.items()},
            "starts by speed, words given, ms": {str(k): milliseconds(v) for k, v in by_speed.items()},
            # Leave one speed out: its bias is estimated on the others.
            "the same, less the other speeds' bias": {
                str(k): milliseconds(np.asarray(v) - np.mean([np.mean(w) for j, w in by_speed.items() if j != k]))
                for k, v in by_speed.items()
            },
            "seconds of CPU a second of sound": {k: round(float(np.mean(v)), 3) for k, v in factors.items()},
        }
        for name, value in figures.items():
            print(f"{name:34s} {value}")
        print(f"stored {store_results('talking', 'python -m benchmarks talking', figures).name}")


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


def visemes_apart(truth: Speech, other: Speech) -> Counter[tuple[str, str]]:
    """Return how many hundredths of a second one mouth shape was taken for another, (true, taken), equal ones too."""
    out: Counter[tuple[str, str]] = Counter()
    for t in np.arange(0.005, truth.seconds, 0.01):
        out[_viseme(truth, t), _viseme(other, t)] += 1
    return out


def shares(counts: Counter[tuple[str, str]]) -> dict[str, float]:
    """Return the percentage of right mouth shapes, by true shape, and the commonest mistakes."""
    spoken = Counter({pair: n for pair, n in counts.items() if pair[0] != SILENCE})
    right = sum(n for pair, n in spoken.items() if pair[0] == pair[1])
    out = {"right": round(100.0 * right / spoken.total(), 1)}
    for shape in sorted({pair[0] for pair in spoken}):
        mine = sum(n for pair, n in spoken.items() if pair[0] == shape)
        out[f"right of {shape}"] = round(100.0 * spoken[shape, shape] / mine, 1)
    wrong = Counter({pair: n for pair, n in spoken.items() if pair[0] != pair[1]})
    for (one, taken), n in wrong.most_common(5):
        out[f"{one} taken for {taken}"] = round(100.0 * n / spoken.total(), 1)
    return out


def _viseme(speech: Speech, time: float) -> str:
    name = next((one.name for one in speech.phonemes if one.start <= time < one.end), SILENCE)
    return next((viseme for viseme, names in VISEMES.items() if name in names), SILENCE)


def milliseconds(apart: Sequence[float] | Float[np.ndarray, " N"]) -> dict[str, Any]:
    """Return bias, and the sizes' mean, median and 95th percentile, of some times."""
    ms = 1e3 * np.asarray(apart)
    return {
        "bias": round(float(ms.mean())),
        "mean": round(float(np.abs(ms).mean())),
        "median": round(float(np.median(np.abs(ms)))),
        "p95": round(float(np.percentile(np.abs(ms), 95))),
    }


if __name__ == "__main__":
    tyro.cli(Talking, prog="python -m benchmarks talking").run()
