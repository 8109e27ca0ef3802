"""Measure the lips' network on voices that it never heard: mouth shapes, closures, delays.

    python -m benchmarks live_lips [--flite PROGRAM]

The voice that it was trained on says other sentences, as it is, faster and higher, slower and lower, with noise and
through a telephone. Nothing was trained on voices of flite (where its program is named) and of espeak-ng (where its
library is installed). In Node (`npm ci` in `web/`) the page's network is timed.
"""

from __future__ import annotations

import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.signal import butter, resample_poly, sosfilt

from avatar.speech import ARTICULATORS, SILENCE, Phoneme, Speech, articulate
from avatar.speech.audio_features import FRAME, RATE
from avatar.speech.lips import PHONES, WEIGHTS, LipNetwork, LipPrediction, recognise_phonemes, smooth_mouth
from avatar.speech.phonemes import BILABIALS, VOWELS
from avatar.speech.voice import PiperVoice
from benchmarks.accuracy.talking import CLOSED, ESPEAK, FLITE, SENTENCES, VISEMES, Espeak, by_flite
from benchmarks.support.results import store_results
from smplxpp.core.files.sound_file import Sound

MORE = (
    "The young child watched a yellow bird over the garden.",
    "We are going to the station at noon, are you coming?",
    "A thin cat jumped on the kitchen table and ate the cheese.",
    "His father bought a new coat with four large pockets.",
    "Nobody knows why the old clock stopped at eleven.",
    "Take this letter to the post office, then come home.",
    "The music was loud, but the singer had a good voice.",
    "Three thick leather books lay on the dusty shelf.",
    "Can you show me where the garage key is?",
    "It usually rains in autumn, so wear your warm hat.",
    "Jack found a huge orange fish under the bridge.",
    "The boy enjoyed the sound of the noisy toy train.",
    "How much would a quick journey to the lake cost?",
    "My mother thinks that both brothers are right.",
    "Put the milk away, wash the cup and go to bed.",
)
FIFTEEN = {
    **{"PP": ("P", "B", "M"), "FF": ("F", "V"), "TH": ("TH", "DH"), "DD": ("T", "D"), "kk": ("K", "G")},
    **{"CH": ("CH", "JH"), "SS": ("S", "Z", "SH", "ZH", "HH"), "nn": ("N", "NG"), "RR": ("R", "L", "Y", "W")},
    **{"aa": ("AA", "AY", "AW", "AE"), "E": ("EH", "EY", "ER", "AH"), "I": ("IY", "IH")},
    **{"O": ("OW", "AO", "OY"), "U": ("UW", "UH")},
}
"""The shapes that other programs of live lips have, beside silence, and our phonemes among them."""
NEAR = 0.1
"""Seconds from a bilabial's middle within which lips that close are its own."""
_NOISE = 10.0  # dB that speech is above it
_LAGS = np.arange(-0.1, 0.2001, 0.005)  # seconds
_NODE = """
const { unpackTensors, LipNetwork, Ear, Steady } = m, bytes = readFileSync(given);
const network = new LipNetwork(unpackTensors(new Uint8Array(bytes), "lips")), ear = new Ear(), steady = new Steady();
let rows = 0, least = Infinity;
for (let turn = 0; turn < 20; ++turn) {
  const samples = Float32Array.from({ length: 32000 }, (_, k) => 0.1 * Math.sin(k * 0.07 * (1 + Math.sin(k / 4000))));
  const began = performance.now();
  ear.push(samples, (row) => { steady.push(network.push(row).mouth); ++rows; });
  least = Math.min(least, performance.now() - began);
}
const result = least / 2;
"""


@dataclass(frozen=True)
class LiveLipsFigures:
    """Say, hear, measure, store."""

    flite: Path | None = None
    """The program flite, for its voices."""

    def run(self) -> None:
        """Print and store the figures."""
        network = LipNetwork.shipped()
        figures: dict[str, Any] = {
            "weights, bytes": WEIGHTS.stat().st_size,
            "told of, ms before a row's last sample": round(1e3 * network.delay),
        }
        voices = {}
        for name, utterances in said_by_voices(self.flite):
            voices[name] = measure(network, utterances)
            print(f"{name:34s} {voices[name]}")
        figures["voices"] = voices
        sound = next(said_by_voices(self.flite))[1][0][0]
        long = Sound(np.tile(sound.samples, 20), sound.rate).at_rate(RATE)
        began = time.process_time()
        network(long)
        figures["milliseconds of CPU a second of sound"] = {
            "numpy": round(1e3 * (time.process_time() - began) / long.seconds, 1),
            **({"TypeScript in Node": round(value, 1)} if (value := in_node()) is not None else {}),
        }
        print(figures["milliseconds of CPU a second of sound"])
        command = "python -m benchmarks live_lips --flite PROGRAM"
        print(f"stored {store_results('live_lips', command, figures).name}")


def said_by_voices(flite: Path | None) -> Iterator[tuple[str, list[tuple[Sound, Speech]]]]:
    """Yield each voice's name and the twenty sentences with their truth; flite's where its program is given."""
    voice, rng = PiperVoice(threads=1), np.random.default_rng(0)
    spoken = [voice.say(text) for text in (*SENTENCES, *MORE)]
    own = [(one.sound, one.speech) for one in spoken]
    yield "the training's voice", own
    for up, down, words in ((5, 4, "1.25 times as slow and low"), (4, 5, "1.25 times as fast and high")):
        yield f"it, {words}", [_played(sound, speech, up, down) for sound, speech in own]
    yield "it, white noise 10 dB below", [(_noisy(sound, rng), speech) for sound, speech in own]
    yield "it, 300 to 3400 Hz", [(_narrow(sound), speech) for sound, speech in own]
    if flite is not None:
        for name in FLITE:
            yield f"flite {name}", [by_flite(flite, name, text) for text in (*SENTENCES, *MORE)]
    try:
        espeak = Espeak()
    except OSError:
        return
    for name, options in ESPEAK.items():
        yield f"espeak-ng {name}", [espeak.say(text, *options) for text in (*SENTENCES, *MORE)]


def measure(network: LipNetwork, utterances: list[tuple[Sound, Speech]]) -> dict[str, float]:
    """Return the figures of one voice."""
    nine, fifteen, kinds, alone = Counter[bool](), Counter[bool](), Counter[bool](), Counter[bool]()
    closed = missed = wrong = 0
    shown, wanted, quiet = [], [], []
    for sound, speech in utterances:
        heard = network(sound)
        names = np.array([_name(speech, t) for t in heard.times])
        # Frame by frame, while somebody speaks: the right one of nine or fifteen mouth shapes.
        spoken = names != SILENCE
        for shapes, counts in ((VISEMES, nine), (FIFTEEN, fifteen)):
            counts.update((_shapes(heard, shapes) == _places(names, shapes))[spoken].tolist())
        coarse = {"vowel": tuple(VOWELS), "consonant": tuple(set(PHONES) - VOWELS - {SILENCE})}
        kinds.update((_shapes(heard, coarse) == _places(names, coarse)).tolist())
        # The same of a recogniser of phonemes that hears the whole sound: what more time and a larger model bring.
        found = recognise_phonemes(sound)
        others = np.array([_name(found, t) for t in heard.times])
        alone.update((_places(others, VISEMES) == _places(names, VISEMES))[spoken].tolist())
        mouth = smooth_mouth(heard.mouth)
        truth = articulate(speech, heard.times)
        shown.append(mouth)
        wanted.append(truth)
        quiet.append(mouth[~spoken, ARTICULATORS.index("jaw")])
        hits, misses, false = closures(mouth, heard.times, speech)
        closed, missed, wrong = closed + hits, missed + misses, wrong + false
    # The delay at which the jaw correlates best with the truth's, in seconds, and that correlation.
    lag, jaw = _best_lag(shown, wanted)
    return {
        "right of nine shapes, %": _share(nine),
        "right of fifteen shapes, %": _share(fifteen),
        "vowel, consonant, silence told apart, %": _share(kinds),
        "bilabials, of which lips close, %": round(100.0 * closed / (closed + missed), 1),
        "lips close without one, of all closures, %": round(100.0 * wrong / max(closed + wrong, 1), 1),
        "jaw, correlation with the truth's": jaw,
        "jaw is late by, ms": round(1e3 * lag),
        "jaw in silence, of its opening, %": round(100.0 * float(np.concatenate(quiet).mean()), 1),
        "jitter, of the truth's": round(_jitter(shown) / _jitter(wanted), 2),
        "sounds without words, right of nine, %": _share(alone),
    }


def closures(mouth: np.ndarray, times: np.ndarray, speech: Speech) -> tuple[int, int, int]:
    """Return how many bilabials have lips that close near them, how many not, and closures that have none."""
    pressed = mouth[:, ARTICULATORS.index("press")] > CLOSED
    starts = np.flatnonzero(np.diff(np.concatenate([[False], pressed]).astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.concatenate([pressed, [False]]).astype(int)) == -1)
    spans = [(times[a], times[b]) for a, b in zip(starts, ends, strict=True)]
    middles = [0.5 * (one.start + one.end) for one in speech.spoken if one.name in BILABIALS]
    near = [any(a - NEAR < middle < b + NEAR for a, b in spans) for middle in middles]
    false = sum(not any(a - NEAR < middle < b + NEAR for middle in middles) for a, b in spans)
    return sum(near), len(near) - sum(near), false


def in_node() -> float | None:
    """Return the milliseconds that the page's features and network take for a second of sound; None without tools."""
    from tests.web.modules import TOOLS, node

    if shutil.which("node") is None or not (TOOLS / "esbuild").exists():
        return None
    try:
        return float(node(_NODE, given=str(WEIGHTS)))
    except subprocess.CalledProcessError as error:
        raise SystemExit(error.stderr) from None


def _name(speech: Speech, time: float) -> str:
    return next((one.name for one in speech.phonemes if one.start <= time < one.end), SILENCE)


def _places(names: np.ndarray, shapes: dict[str, tuple[str, ...]]) -> np.ndarray:
    of = {name: k for k, group in enumerate(shapes.values(), 1) for name in group}
    return np.array([of.get(name, 0) for name in names])


def _shapes(heard: LipPrediction, shapes: dict[str, tuple[str, ...]]) -> np.ndarray:
    """The likeliest shape of each row: silence is 0, then they are counted."""
    places = _places(np.array(PHONES), shapes)
    sums = np.stack([heard.phones[:, places == k].sum(axis=1) for k in range(len(shapes) + 1)], axis=1)
    return sums.argmax(axis=1)


def _best_lag(shown: list[np.ndarray], wanted: list[np.ndarray]) -> tuple[float, float]:
    """Return the delay of the jaw, without the network's own, in seconds, and the correlation at that delay."""
    best = (0.0, -1.0)
    column = ARTICULATORS.index("jaw")
    for lag in _LAGS:
        pairs = []
        for mouth, truth in zip(shown, wanted, strict=True):
            at = np.arange(len(truth)) * FRAME
            pairs.append((mouth[:, column], np.interp(at - lag, at, truth[:, column])))
        a, b = (np.concatenate(one) for one in zip(*pairs, strict=True))
        value = float(np.corrcoef(a, b)[0, 1])
        if value > best[1]:
            best = (float(lag), round(value, 3))
    return best


def _jitter(curves: list[np.ndarray]) -> float:
    """Return the mean change of the articulators' speed from one row to the next."""
    return float(np.mean(np.concatenate([np.abs(np.diff(one, 2, axis=0)) for one in curves])))


def _share(counts: Counter[bool]) -> float:
    return round(100.0 * counts[True] / counts.total(), 1)


def _played(sound: Sound, speech: Speech, up: int, down: int) -> tuple[Sound, Speech]:
    """The same at another speed of the tape."""
    samples = resample_poly(sound.samples.astype(np.float64), up, down).astype(np.float32)
    seconds = len(samples) / sound.rate
    ends = [min(one.end * up / down, seconds) for one in speech.phonemes]
    phonemes = [
        Phoneme(one.name, one.start * up / down, end)
        for one, end in zip(speech.phonemes, ends, strict=True)
        if end > one.start * up / down
    ]
    return Sound(samples, sound.rate), Speech(tuple(phonemes), seconds)


def _noisy(sound: Sound, rng: np.random.Generator) -> Sound:
    level = float(np.sqrt(np.mean(np.square(sound.samples)))) * 10.0 ** (-_NOISE / 20.0)
    return Sound((sound.samples + level * rng.standard_normal(len(sound.samples))).astype(np.float32), sound.rate)


def _narrow(sound: Sound) -> Sound:
    band = butter(6, (300.0, 3400.0), "bandpass", fs=sound.rate, output="sos")
    return Sound(sosfilt(band, sound.samples).astype(np.float32), sound.rate)


if __name__ == "__main__":
    tyro.cli(LiveLipsFigures, prog="python -m benchmarks live_lips").run()
