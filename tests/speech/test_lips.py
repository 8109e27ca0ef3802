"""The lips' network: what it hears, that it sees the past alone, and that mouths close where lips do."""

from __future__ import annotations

import numpy as np
import pytest

from avatar.speech import ARTICULATORS, SILENCE, Phoneme, Speech, articulate
from avatar.speech.audio_features import BANDS, HOP, RATE, log_mel, mel_filters
from avatar.speech.lips import (
    PHONES,
    WEIGHTS,
    LipNetwork,
    LipPrediction,
    alignment_score,
    recognise_phonemes,
    smooth_mouth,
)
from avatar.speech.phonemes import BILABIALS, VOWELS
from pipelines.commands.talk import Talk
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound
from smplxpp.core.files.tensor_bytes import unpack_tensors

JAW, PRESS = ARTICULATORS.index("jaw"), ARTICULATORS.index("press")


def tone(hertz: float, level: float = 0.1, seconds: float = 0.5) -> np.ndarray:
    times = np.arange(int(seconds * RATE)) / RATE
    return (level * np.sin(2.0 * np.pi * hertz * times)).astype(np.float32)


def test_a_tone_is_heard_in_its_band_at_forty_decibels_above_nothing():
    """Its power in all bands is 0 dB below the loudest, which is row 0 + 40 dB, or 2 units."""
    hertz = 1127.0 * np.log1p(1000.0 / 700.0)
    lowest, highest = (1127.0 * np.log1p(one / 700.0) for one in (60.0, 7600.0))
    row = log_mel(tone(1000.0))[-1]
    assert int(row.argmax()) == round((hertz - lowest) / (highest - lowest) * (BANDS + 1)) - 1
    power = (10.0 ** (2.0 * row - 4.0)).sum()
    assert power == pytest.approx(1.0, rel=1e-3)
    assert row[int(row.argmax()) + 6 :].max() < 0.0  # 40 dB less


def test_bands_are_triangles_that_add_up_to_one_between_their_middles():
    bands = mel_filters()
    inside = bands[(np.arange(257) * RATE / 512 > 120.0) & (np.arange(257) * RATE / 512 < 7000.0)]
    np.testing.assert_allclose(inside.sum(axis=1), 1.0, atol=1e-9)


def test_rows_know_nothing_of_later_samples_and_levels_nothing_of_the_gain(spoken):
    sound = spoken.sound.at_rate(RATE).samples
    rows = log_mel(sound)
    np.testing.assert_array_equal(log_mel(sound[: 100 * HOP]), rows[:100])
    loud = log_mel(np.concatenate([tone(300.0), sound]))[50:]
    quiet = log_mel(0.25 * np.concatenate([tone(300.0), sound]))[50:]
    np.testing.assert_allclose(loud[loud > 0.0], quiet[loud > 0.0], atol=0.01)
    assert log_mel(np.zeros(HOP - 1, np.float32)).shape == (0, BANDS)


def test_the_network_says_nothing_of_a_time_later_than_its_delay(spoken):
    """Other samples behind a time do not change what was told of `delay` before it."""
    network, sound = LipNetwork.shipped(), spoken.sound.at_rate(RATE)
    cut = 120 * HOP
    noise = np.random.default_rng(0).standard_normal(len(sound.samples) - cut).astype(np.float32)
    one, other = network(sound), network(Sound(np.concatenate([sound.samples[:cut], noise]), RATE))
    before = one.times <= 1.2 - network.delay + 1e-9
    np.testing.assert_allclose(one.mouth[before], other.mouth[before], atol=1e-6)
    assert np.abs(one.mouth[~before] - other.mouth[~before]).max() > 0.1
    np.testing.assert_allclose(one.phones.sum(axis=1), 1.0, atol=1e-5)
    assert network.delay <= 0.08 and WEIGHTS.stat().st_size < 100_000


def test_convolutions_are_those_of_a_loop_in_double_precision():
    """The first two layers of random sound, row by row."""
    rows = np.random.default_rng(1).standard_normal((40, BANDS))
    tensors, about = unpack_tensors(WEIGHTS.read_bytes(), subject="lips")
    network = LipNetwork(tensors, about)
    weights = {
        name: tensors[f"{name}.weight"] * tensors[f"{name}.scale"][:, None, None] for name in ("first", "middle0")
    }

    def layer(name: str, h: np.ndarray) -> np.ndarray:
        weight, out = weights[name].astype(np.float64), np.zeros((len(h), weights[name].shape[0]))
        for t in range(len(h)):
            out[t] = tensors[f"{name}.bias"]
            for k in range(weight.shape[2]):
                back = t - (weight.shape[2] - 1 - k)
                out[t] += weight[:, :, k] @ h[back] if back >= 0 else 0.0
        return out

    first = np.maximum(layer("first", rows), 0.0)
    second = np.maximum(first + layer("middle0", first), 0.0)
    np.testing.assert_allclose(network.layer(1, network.layer(0, rows.T.astype(np.float32))).T, second, atol=1e-4)


def test_the_mouth_closes_for_bilabials_opens_for_vowels_and_rests_in_silence(spoken):
    silence = np.zeros(spoken.sound.rate, np.float32)
    heard = LipNetwork.shipped()(Sound(np.concatenate([spoken.sound.samples, silence]), spoken.sound.rate))
    mouth = smooth_mouth(heard.mouth)
    closed = heard.times[mouth[:, PRESS] > 0.95]
    middles = [0.5 * (one.start + one.end) for one in spoken.speech.spoken if one.name in BILABIALS]
    near = [np.abs(closed - middle).min() < 0.1 for middle in middles]
    assert len(near) == 8 and sum(near) > 4  # most of them, in a sentence full of them
    assert mouth[heard.times > spoken.speech.seconds + 0.4][:, [JAW, PRESS]].max() < 0.15
    truth = articulate(spoken.speech, heard.times)
    assert np.corrcoef(mouth[:, JAW], truth[:, JAW])[0, 1] > 0.7
    assert np.all((mouth >= 0.0) & (mouth <= 1.0))


def test_a_steady_mouth_follows_and_lips_that_are_likely_closed_are():
    mouth = np.zeros((40, 6), np.float32)
    mouth[10:30, PRESS], mouth[:, JAW] = 0.75, 0.8
    out = smooth_mouth(mouth)
    assert out[29, PRESS] == pytest.approx(1.0, abs=1e-6) and out[29, JAW] == pytest.approx(0.0, abs=1e-6)
    assert out[9, PRESS] == 0.0 and out[39, PRESS] == pytest.approx(0.0, abs=1e-2)
    assert out[9, JAW] == pytest.approx(0.8, abs=1e-2) and out[39, JAW] == pytest.approx(0.8, abs=1e-2)
    mouth[:, PRESS] = 0.25  # not likely: as it is
    np.testing.assert_allclose(smooth_mouth(mouth)[-1, [JAW, PRESS]], [0.8, 0.25], atol=1e-6)


def test_sounds_are_found_without_words(spoken):
    """Most of the time the vowels are where they are said, at another rate and level too."""
    for sound in (spoken.sound, Sound(0.1 * spoken.sound.at_rate(48_000).samples, 48_000)):
        speech = recognise_phonemes(sound)
        assert speech.seconds == pytest.approx(sound.seconds) and len(speech.spoken) > 15
        times = np.arange(0.0, sound.seconds, 0.01)

        def vowels(speech, times=times) -> np.ndarray:
            names = [next((one.name for one in speech.phonemes if one.start <= t < one.end), SILENCE) for t in times]
            return np.isin(names, sorted(VOWELS))

        assert np.mean(vowels(speech) == vowels(spoken.speech)) > 0.8


@pytest.mark.parametrize(
    ("samples", "word"),
    [
        (np.zeros(16_000), "silence"),
        (np.zeros(10), "seconds"),
        (0.05 * np.random.default_rng(0).standard_normal(32_000), "no phoneme"),
    ],
)
def test_what_says_nothing_is_refused(samples, word):
    with pytest.raises(InputError, match=word):
        recognise_phonemes(Sound(np.asarray(samples, np.float32), RATE))


def test_another_version_is_refused():
    tensors, about = unpack_tensors(WEIGHTS.read_bytes(), subject="lips")
    assert tuple(about["phones"]) == PHONES
    with pytest.raises(InputError, match="version 1"):
        LipNetwork(tensors, {**about, "version": 2})


@pytest.mark.parametrize("options", [{"text": "hello"}, {"text": "hello", "audio": "a.wav"}])
def test_sounds_are_heard_in_a_recording_alone(tmp_path, options):
    with pytest.raises(InputError, match="hear"):
        Talk(tmp_path, tmp_path / "a.npz", hear="sounds", **options).run()


def test_phonemes_agree_with_what_is_heard_at_their_times_alone():
    """Rows that are sure of five phonemes in turn: their own order is worth some log 5, another is below 0."""
    names, rows = ("AA", "M", "S", "IY", "T"), 40
    phones = np.full((5 * rows, len(PHONES)), 1e-6, np.float32)
    for k, name in enumerate(names):
        phones[k * rows : (k + 1) * rows, PHONES.index(name)] = 1.0
    heard = LipPrediction(
        (np.arange(len(phones)) + 0.5) * 0.01, phones, np.zeros((len(phones), len(ARTICULATORS)), np.float32)
    )

    def said(order):
        each = rows * 0.01
        spoken = tuple(Phoneme(name, k * each, (k + 1) * each) for k, name in enumerate(order))
        return alignment_score(heard, Speech(spoken, 5 * each))

    even = (rows + 100.0 / len(PHONES)) / (5 * rows + 100.0)
    assert said(names) == pytest.approx(-np.log(even), abs=0.01)
    assert said(names[1:] + names[:1]) < -3.0
    assert alignment_score(heard, Speech((), 2.0)) == -np.inf
