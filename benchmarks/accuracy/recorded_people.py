"""Measure aligner, recogniser and the lips' network on recordings of people.

    pip download --no-deps --no-binary :all: pocketsphinx    # or the file pocketsphinx-5.1.1.tar.gz of PyPI by hand
    tar xzf pocketsphinx-5.1.1.tar.gz
    python -m benchmarks recorded_people --recordings pocketsphinx-5.1.1

The tests of pocketsphinx contain twelve recordings with known words: five sentences of a novel, read for LibriVox
(public domain), and seven of playing cards, a command and digits. Their phonemes are not annotated. The truth is the
recogniser's own alignment of the right words, so that the figures compare recognition with alignment of known words;
of the aligner itself they only tell which texts it accepts. The recordings stay in their folder.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from avatar.speech import Phoneme, Speech
from avatar.speech.forced_alignment import align, load_recogniser, recognised_words
from avatar.speech.lips import LipNetwork, recognise_phonemes
from avatar.speech.phonemes import CONSONANTS, VOWELS
from avatar.speech.pronunciation import words_from_text
from benchmarks.accuracy.aligner_gates import Taken
from benchmarks.accuracy.live_lips import measure
from benchmarks.accuracy.talking import closures_apart, milliseconds, shares, starts_apart, visemes_apart
from benchmarks.support.results import store_results
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes, read_text
from smplxpp.core.files.sound_file import Sound, read_wave

_RAW = {"goforward.raw": "go forward ten meters", "tidigits/dhd.2934z.raw": "two nine three four zero"}
"""Texts as the tests' grammar and the digits' name (z: zero) have them; 16 kHz, 16 bits."""
_LINE = re.compile(r"<s>(.*?)</s>\s*\((.*?)\)")


@dataclass(frozen=True)
class Recording:
    """A recording of a person who reads a text.

    Attributes:
        name: of its file. theirs: phonemes by the alignment that lies beside it, if one does.
    """

    name: str
    sound: Sound
    text: str
    theirs: Speech | None


@dataclass(frozen=True)
class RecordedPeople:
    """Read, hear, measure, store."""

    recordings: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """An unpacked source distribution of pocketsphinx 5."""

    def run(self) -> None:
        """Print and store the figures."""
        read = read_recordings(self.recordings / "test" / "data")
        groups = {
            "a novel, read aloud": [one for one in read if one.theirs is not None],
            "cards, a command, digits": [one for one in read if one.theirs is None],
        }
        recogniser = load_recogniser()
        figures: dict[str, Any] = {name: measured(group, read, recogniser) for name, group in groups.items()}
        for name, value in figures.items():
            print(f"{name}: {json.dumps(value, indent=1)}")
        command = "python -m benchmarks recorded_people --recordings DIR"
        print(f"stored {store_results('recorded_people', command, figures).name}")


def read_recordings(folder: Path) -> list[Recording]:
    """Return the recordings of pocketsphinx's `test/data` whose words are known.

    Raises:
        InputError: no such files.
    """
    out = []
    for listing in ("librivox/transcription", "cards/cards.transcription"):
        for text, name in _LINE.findall(read_text(folder / listing, subject="list of what is spoken")):
            path = (folder / listing).parent / f"{name}.wav"
            phones = path.with_suffix(".phone.json")
            sound = read_wave(path)
            theirs = _aligned_there(phones, sound.seconds) if phones.exists() else None
            out.append(Recording(path.name, sound, text.strip(), theirs))
    for name, text in _RAW.items():
        samples = np.frombuffer(read_bytes(folder / name, subject="recording"), "<i2")
        out.append(Recording(name, Sound((samples / 32768.0).astype(np.float32), 16_000), text, None))
    return out


def measured(group: list[Recording], everyone: list[Recording], recogniser: Any) -> dict[str, Any]:
    """Return the figures of some recordings, each given the texts of everyone."""
    taken, alone = Taken(), Counter[tuple[str, str]]()
    errors = words = refused = missed = bilabials = 0
    spoken, heard_starts, their_starts = [], [], []
    recognised, sounds = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    for one in group:
        # A text of another recording must be refused, the own one taken.
        others = list(dict.fromkeys(other.text for other in everyone if other.text != one.text))
        taken.give(one.sound, [one.text, *others], recogniser)
        got = _words(one.sound, recogniser)
        errors += word_errors(words_from_text(one.text), got)
        words += len(words_from_text(one.text))
        try:
            given = align(one.sound, one.text, recogniser=recogniser)
        except InputError:
            refused += 1
            continue
        spoken.append((one.sound, given))
        if one.theirs is not None:
            their_starts += starts_apart(one.theirs, given)
            alone.update(visemes_apart(one.theirs, given))
        # Without the text the words are recognised first; the alignment to the text is the reference.
        free = align(one.sound, recogniser=recogniser)
        heard_starts += starts_apart(given, free)
        recognised.update(visemes_apart(given, free))
        found, lost = closures_apart(given, free)
        missed, bilabials = missed + lost, bilabials + lost + len(found)
        sounds.update(visemes_apart(given, recognise_phonemes(one.sound)))
    phonemes = sum(len(speech.spoken) for _, speech in spoken)
    theirs = {"matched": len(their_starts), **milliseconds(their_starts)} if their_starts else None
    return {
        "recordings": {
            "number": len(group),
            "seconds": round(sum(one.sound.seconds for one in group), 1),
            "phonemes": phonemes,
            "bilabials": bilabials,
        },
        "texts, own and the other recordings'": taken.figures(),
        **({"starts against the alignment beside the recordings, ms": theirs} if theirs is not None else {}),
        "recognised without words": {
            "words": words,
            "word errors": errors,
            "phonemes also found": len(heard_starts),
            "their starts' mean distance, ms": milliseconds(heard_starts)["mean"],
            "bilabials without closed lips": missed,
        },
        "right of nine mouth shapes, % of the time": {
            **({"aligner, by the alignment beside them": shares(alone)["right"]} if their_starts else {}),
            "recognised": shares(recognised)["right"],
            "by sounds alone": shares(sounds)["right"],
        },
        "the lips' network": measure(LipNetwork.shipped(), spoken),
    }


def word_errors(spoken: list[str], heard: list[str]) -> int:
    """Return the least words to be changed, left out and put in (Levenshtein's distance)."""
    best = list(range(len(heard) + 1))
    for k, word in enumerate(spoken, 1):
        before, best[0] = best[0], k
        for j, other in enumerate(heard, 1):
            before, best[j] = best[j], min(best[j] + 1, best[j - 1] + 1, before + (word != other))
    return best[-1]


def _words(sound: Sound, recogniser: Any) -> list[str]:
    try:
        return recognised_words(sound, recogniser)
    except InputError:
        return []


def _aligned_there(path: Path, seconds: float) -> Speech:
    """The alignment that pocketsphinx's own program wrote: words with phones, of begin `b`, duration `d`, text `t`."""
    whole = json.loads(read_text(path, subject="alignment"))
    phones = [phone for word in whole["w"] for phone in word["w"]]
    return Speech(
        tuple(
            Phoneme(one["t"], one["b"], min(one["b"] + one["d"], seconds))
            for one in phones
            if one["t"] in VOWELS | CONSONANTS and one["b"] + 1e-9 < min(one["b"] + one["d"], seconds)
        ),
        seconds,
    )


if __name__ == "__main__":
    tyro.cli(RecordedPeople, prog="python -m benchmarks recorded_people").run()
