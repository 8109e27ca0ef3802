"""A stream of sound to utterances."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
import pytest

from avatar.conversation.hearing import RATE, ListenConfig, Listener, LoudnessActivity, UtterancePart, find_activity

LEVEL = 8000


def sound(*parts: tuple[str, float]) -> np.ndarray:
    """Seconds of tone, hiss and silence, 16 bits."""
    rng = np.random.default_rng(0)
    out = []
    for kind, seconds in parts:
        times = np.arange(int(seconds * RATE)) / RATE
        wave = {"tone": np.sin(2 * np.pi * 200 * times), "hiss": rng.normal(size=len(times)) * 0.3}
        out.append(LEVEL * wave.get(kind, np.zeros(len(times))))
    return np.concatenate(out).astype(np.int16)


def heard(samples: np.ndarray, piece: int = 1000, config: ListenConfig | None = None) -> list[UtterancePart]:
    listener = Listener(LoudnessActivity(), config or ListenConfig())
    return [one for k in range(0, len(samples), piece) for one in listener.hear(samples[k : k + piece])]


@pytest.mark.parametrize("piece", [1, 333, 512, 100_000])
def test_two_utterances_are_heard_whole_with_what_is_before(piece):
    speech = sound(("quiet", 1.0), ("tone", 1.0), ("quiet", 1.0), ("tone", 0.5), ("quiet", 1.0))
    speech = speech[: 3 * RATE] if piece == 1 else speech
    out = heard(speech, piece)
    assert [one.begins for one in out if one.begins or one.ends].count(True) == (1 if piece == 1 else 2)
    first = out[: next(k for k, one in enumerate(out) if one.ends) + 1]
    assert first[0].begins and not any(one.begins for one in first[1:])
    samples = np.concatenate([one.samples for one in first])
    start = np.argmax(np.abs(samples) > 0) / RATE
    assert 0.2 < start < 0.45 and (np.abs(samples) > 100).sum() / RATE == pytest.approx(1.0, abs=0.03)
    assert first[-1].silent == pytest.approx(ListenConfig().pause, abs=0.04)


def test_silence_and_clicks_are_no_speech():
    assert heard(sound(("quiet", 5.0))) == []
    assert heard(sound(*([("quiet", 0.7), ("tone", 0.03)] * 5))) == []


def test_steady_noise_becomes_the_room():
    out = heard(sound(("hiss", 20.0)))
    assert sum(one.begins for one in out) <= 1
    assert not out or any(one.ends for one in out)


def test_who_never_pauses_is_cut():
    config = ListenConfig(longest=2.0)
    listener = Listener(lambda block: 1.0, config)
    out = list(listener.hear(sound(("tone", 5.0))))
    assert sum(one.cut for one in out) == 2


@pytest.mark.skipif(find_spec("silero_vad") is None or find_spec("onnxruntime") is None, reason="extra chat")
def test_sileros_model_knows_speech_from_hiss_and_brings_no_torch():
    activity = find_activity()
    assert activity.name == "silero-vad" and "silero_vad" not in sys.modules
    hiss = sound(("hiss", 2.0)).astype(np.float32) / 32768
    assert max(activity(block) for block in hiss[: len(hiss) // 512 * 512].reshape(-1, 512)) < 0.5
