"""Compare times of closed lips and of phonemes with the times at which a synthetic voice spoke.

    python -m benchmarks talking

A Piper voice (extra `[talk]`) says sentences and tells how long each of its phonemes was: the truth here. The aligner
hears the sound, once with the words and once without. Measured are starts of phonemes that both name, and the pictures
in which the lips are closed, at 30 a second, against the middle of each bilabial. flite and espeak-ng, voices that
nothing here was trained on, stand below with phonemes in time by their own account; other benchmarks hear them.
"""

from __future__ import annotations

import ctypes
import difflib
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

from avatar.speech import ARTICULATORS, SILENCE, Phoneme, Speech, articulate
from avatar.speech.forced_alignment import align
from avatar.speech.phonemes import BILABIALS, CONSONANTS, VOWELS, arpabet_from_ipa
from avatar.speech.voice import PiperVoice
from benchmarks.support.results import store_results
from smplxpp.core.files.sound_file import Sound, read_wave

FLITE = ("slt", "awb", "rms")
ESPEAK = {
    **{"en-us": ("en-us", 175, 50), "en-us f2": ("en-us+f2", 160, 60), "rp slow": ("en-gb-x-rp", 130, 30)},
    **{"en-us m3 fast": ("en-us+m3", 220, 45), "scotland f5": ("en-gb-scotland+f5", 150, 70)},
    "klatt": ("en-us+klatt2", 160, 50),
}
"""Voice, words a minute and pitch."""
_FESTIVAL = {"ax": "AH", "axr": "ER", "dx": "D", "ix": "IH", "pau": SILENCE, "ssil": SILENCE}
_STOPS = frozenset(("P", "B", "T", "D", "K", "G", "CH", "JH"))
_PHONEME, _SYNCHRONOUS, _PHONEMES_IN_IPA, _UTF8 = 7, 2, 3, 1
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


def by_flite(program: Path, voice: str, text: str) -> tuple[Sound, Speech]:
    """Say a text with flite, whose `-psdur` prints when each phoneme ends."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "spoken.wav"
        command = [str(program), "-voice", voice, "-psdur", "-t", text, "-o", str(out)]
        printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=900).stdout
        sound = read_wave(out)
    times, last = [], 0.0
    for one in printed.split():
        name, end = one.split(":")
        times.append((_FESTIVAL.get(name, name.upper()), last, float(end)))
        last = float(end)
    return sound, _speech(times, sound.seconds)


class _Event(ctypes.Structure):
    class Name(ctypes.Union):
        _fields_ = [("number", ctypes.c_int), ("pointer", ctypes.c_char_p), ("text", ctypes.c_char * 8)]

    _fields_ = [
        *((name, ctypes.c_int) for name in ("kind",)),
        ("identifier", ctypes.c_uint),
        *((name, ctypes.c_int) for name in ("position", "length", "milliseconds", "sample")),
        ("own", ctypes.c_void_p),
        ("name", Name),
    ]


class Espeak:
    """The library of an espeak-ng that is installed, which tells the sample at which each phoneme begins.

    Raises:
        OSError: there is none.
    """

    def __init__(self) -> None:
        self._library = ctypes.CDLL("libespeak-ng.so.1")
        self._rate = int(self._library.espeak_Initialize(_SYNCHRONOUS, 0, None, _PHONEMES_IN_IPA))
        self._samples: list[np.ndarray] = []
        self._events: list[tuple[int, str]] = []
        kind = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.POINTER(_Event))
        self._callback = kind(self._take)
        self._library.espeak_SetSynthCallback(self._callback)

    def say(self, text: str, voice: str, speed: int, pitch: int) -> tuple[Sound, Speech]:
        """Say a text. A stop begins with its silence, which the library gives to the sound before."""
        self._samples, self._events = [], []
        self._library.espeak_SetVoiceByName(voice.encode())
        self._library.espeak_SetParameter(1, speed, 0)
        self._library.espeak_SetParameter(3, pitch, 0)
        data = text.encode()
        self._library.espeak_Synth(data, len(data) + 1, 0, 1, 0, _UTF8, None, None)
        self._library.espeak_Synchronize()
        samples = np.concatenate(self._samples)
        times: list[tuple[str, float, float]] = []
        for (at, ipa), (end, _) in zip(self._events[:-1], self._events[1:], strict=True):
            names = [name for name in (arpabet_from_ipa(ipa, k)[0] for k in range(len(ipa))) if name]
            begin = at
            if names and names[0] in _STOPS and times and times[-1][0] != SILENCE:
                while begin and abs(int(samples[begin - 1])) < 2:
                    begin -= 1
                name, start, behind = times[-1]
                times[-1] = (name, start, min(behind, begin / self._rate))
            if end > at:
                times.append((names[0] if names else SILENCE, begin / self._rate, end / self._rate))
        sound = Sound((samples / 32768.0).astype(np.float32), self._rate)
        return sound, _speech(times, sound.seconds)

    def _take(self, samples: object, count: int, events: object) -> int:
        if samples and count > 0:
            self._samples.append(np.ctypeslib.as_array(samples, (count,)).copy())  # type: ignore[call-overload]
        k = 0
        while events[k].kind != 0:  # type: ignore[index]
            if events[k].kind == _PHONEME:  # type: ignore[index]
                event = events[k]  # type: ignore[index]
                self._events.append((event.sample, event.name.text.decode("utf8", "replace")))
            k += 1
        return 0


def _speech(times: list[tuple[str, float, float]], seconds: float) -> Speech:
    """Return the phonemes within the sound, in order."""
    out: list[Phoneme] = []
    for name, start, end in times:
        start, end = max(start, out[-1].end if out else 0.0), min(end, seconds)
        if name in VOWELS | CONSONANTS and end > start:
            out.append(Phoneme(name, start, end))
    return Speech(tuple(out), seconds)


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
