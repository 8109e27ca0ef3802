"""Rests of a recording: quiet stretches with known edges, whatever noise lies under them; lips rest in them."""

from __future__ import annotations

import numpy as np
import pytest

from avatar.speech import ARTICULATORS, Phoneme, Speech, articulate
from avatar.speech.audio_features import clear_pauses, find_pauses
from smplxpp.core.files.sound_file import Sound

RATE = 16_000
BURSTS = ((0.30, 1.10), (1.20, 1.75), (2.55, 3.20))
"""Seconds: the gap of .1 is a stop's closure, that of .8 a rest."""


def bursts(rate: int = RATE, seconds: float = 3.6, noise: float = 0.0) -> Sound:
    """Tones of a vowel's pitch with a background."""
    t = np.arange(round(seconds * rate)) / rate
    tone = 0.3 * sum(np.sin(2 * np.pi * 130.0 * k * t) / k for k in range(1, 9))
    loud = sum(((t >= start) & (t < end)).astype(np.float64) for start, end in BURSTS)
    noises = np.random.default_rng(3).normal(size=len(t))
    return Sound((tone * loud + noise * noises).astype(np.float32), rate)


@pytest.mark.parametrize("rate", [8_000, 16_000, 48_000])
@pytest.mark.parametrize("snr", [np.inf, 40.0, 20.0])
def test_rests_lie_between_bursts_of_tone(rate, snr):
    clean = bursts(rate)
    level = np.sqrt(np.mean(clean.samples[np.abs(clean.samples) > 0] ** 2))
    rests = find_pauses(bursts(rate, noise=level * 10.0 ** (-snr / 20.0)))
    np.testing.assert_allclose(rests, [[0.0, 0.30], [1.75, 2.55], [3.20, 3.6]], atol=0.025)


def test_there_are_no_rests_in_noise_music_or_a_blip():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=3 * RATE).astype(np.float32) * 0.1
    t = np.arange(4 * RATE) / RATE
    chords = sum(np.sin(2 * np.pi * f * t) for f in (220.0, 277.2, 329.6)) * (0.6 + 0.4 * np.exp(-8 * (t % 0.5)))
    for samples in (noise, 0.1 * chords.astype(np.float32), noise[:100], np.zeros(0, np.float32)):
        assert len(find_pauses(Sound(samples, RATE))) == 0


def test_sounds_leave_rests_free_and_stops_keep_their_closures():
    rests = np.array([[1.0, 2.0]])
    given = [
        Phoneme("AA", 0.5, 1.3),  # dragged into the rest
        Phoneme("S", 1.3, 1.5),  # within it
        Phoneme("P", 1.5, 2.05),  # its closure is at the end of the rest
        Phoneme("IY", 2.05, 2.4),
    ]
    kept = clear_pauses(given, rests)
    assert [(one.name, round(one.start, 3), round(one.end, 3)) for one in kept] == [
        ("AA", 0.5, 1.0),
        ("P", 1.92, 2.05),
        ("IY", 2.05, 2.4),
    ]
    assert clear_pauses([Phoneme("AA", 0.9, 2.6, 1)], rests) == [Phoneme("AA", 2.0, 2.6, 1)]
    assert clear_pauses(given, np.zeros((0, 2))) == given
    final = clear_pauses([Phoneme("AA", 0.5, 1.01), Phoneme("P", 1.01, 1.9)], rests)
    assert final == [Phoneme("AA", 0.5, 1.0), Phoneme("P", 1.01, 1.08)]


def test_lips_rest_in_a_pause_that_an_aligner_has_filled_with_a_vowel():
    """Phones cut into silence kept the jaw open for all of it."""
    rests = find_pauses(bursts())
    dragged = (Phoneme("AA", 0.30, 1.10), Phoneme("IY", 1.2, 1.6), Phoneme("AA", 1.6, 3.2))
    times = np.arange(0.0, 3.6, 1 / 30)
    within = (times > 2.0) & (times < 2.25)
    jaw = ARTICULATORS.index("jaw")
    assert articulate(Speech(dragged, 3.6), times)[within, jaw].min() > 0.8
    speech = Speech(tuple(clear_pauses(dragged, rests)), 3.6)
    curves = articulate(speech, times)
    assert curves[within].max() < 0.05
    assert curves[(times > 2.75) & (times < 3.0), jaw].min() > 0.8
