"""Voices that nothing here was trained on, with phonemes in time by their own account: flite's and espeak-ng's.

Both are programs of the user's own (flite 2.2: an MIT-like licence; espeak-ng 1.51: GPL), asked for figures alone.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from avatar.speech import SILENCE, Phoneme, Speech
from avatar.speech.phonemes import CONSONANTS, VOWELS, arpabet_from_ipa
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
