"""Sound files: every coding reads as the same sound, other rates keep it, foreign files are refused."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest

from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound, read_wave, wave_bytes

TONE = (0.5 * np.sin(2 * np.pi * 440 * np.arange(8000) / 16000)).astype(np.float32)


def file_of(
    data: bytes, kind: int, bits: int, *, channels: int = 1, rate: int = 16000, extensible: bool = False
) -> bytes:
    block = channels * bits // 8
    form = struct.pack("<HHIIHH", 0xFFFE if extensible else kind, channels, rate, rate * block, block, bits)
    if extensible:
        form += struct.pack("<HHIH", 22, bits, 0, kind) + bytes(14)
    chunks = b"".join(
        name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)
        for name, body in ((b"fmt ", form), (b"LIST", b"odd"), (b"data", data))
    )
    return b"RIFF" + struct.pack("<I", len(chunks) + 4) + b"WAVE" + chunks


def coded(samples: np.ndarray, kind: int, bits: int) -> bytes:
    if kind == 3:
        return samples.astype(f"<f{bits // 8}").tobytes()
    if bits == 8:
        return np.round(samples * 127 + 128).astype(np.uint8).tobytes()
    whole = np.round(samples.astype(np.float64) * (2 ** (bits - 1) - 1)).astype("<i4")
    return whole.view(np.uint8).reshape(-1, 4)[:, : bits // 8].tobytes()


@pytest.mark.parametrize("extensible", [False, True])
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize(("kind", "bits"), [(1, 8), (1, 16), (1, 24), (1, 32), (3, 32), (3, 64)])
def test_every_coding_is_the_same_sound(tmp_path, kind, bits, channels, extensible):
    data = coded(np.repeat(TONE, channels), kind, bits)
    (tmp_path / "a.wav").write_bytes(file_of(data, kind, bits, channels=channels, extensible=extensible))
    sound = read_wave(tmp_path / "a.wav")
    assert sound.rate == 16000 and sound.seconds == 0.5
    np.testing.assert_allclose(sound.samples, TONE, atol=0.01 if bits == 8 else 1e-4)


def test_what_is_written_reads_back_and_is_cut_off_without_harm(tmp_path):
    data = wave_bytes(Sound(TONE, 22050))
    (tmp_path / "a.wav").write_bytes(data)
    np.testing.assert_allclose(read_wave(tmp_path / "a.wav").samples, TONE, atol=1e-4)
    (tmp_path / "b.wav").write_bytes(data[:-1001])
    assert len(read_wave(tmp_path / "b.wav").samples) == len(TONE) - 501


@pytest.mark.parametrize("rate", [8000, 22050, 48000])
def test_another_rate_is_the_same_tone(rate):
    sound = Sound(TONE, 16000).at_rate(rate)
    assert sound.seconds == pytest.approx(0.5, abs=1e-3)
    t = np.arange(len(sound.samples)) / rate
    inner = (t > 0.02) & (t < 0.48)
    np.testing.assert_allclose(sound.samples[inner], 0.5 * np.sin(2 * np.pi * 440 * t)[inner], atol=0.01)


@pytest.mark.parametrize("given", [16001, 44099, 383_999])
def test_odd_rates_take_no_filter_of_millions_of_taps(given):
    """Rates without a common factor made a filter of as many taps as twenty times the rate: 7.7 million."""
    t = np.arange(given // 2) / given
    sound = Sound((0.5 * np.sin(2 * np.pi * 440 * t)).astype(np.float32), given)
    tracemalloc.start()
    other = sound.at_rate(16000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(other.samples) == -(-len(t) * 16000 // given)
    assert peak < 8 * sound.samples.nbytes + 20e6
    t = np.arange(len(other.samples)) / 16000
    inner = (t > 0.02) & (t < 0.48)
    np.testing.assert_allclose(other.samples[inner], 0.5 * np.sin(2 * np.pi * 440 * t)[inner], atol=0.01)


@pytest.mark.parametrize(("kind", "bits", "channels"), [(1, 8, 1), (1, 16, 2), (1, 24, 2), (3, 32, 1)])
def test_a_recording_takes_little_more_than_its_samples(tmp_path, kind, bits, channels):
    """It took ten times the size of its file."""
    data = coded(np.tile(TONE, 250 * channels), kind, bits)
    (tmp_path / "a.wav").write_bytes(file_of(data, kind, bits, channels=channels))
    tracemalloc.start()
    sound = read_wave(tmp_path / "a.wav")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The file, the samples, and a block of a million samples in float64 with what its conversion needs.
    assert peak < len(data) + 1.1 * sound.samples.nbytes + 4 * (8 << 20)


def test_recordings_over_two_hours_are_refused(tmp_path):
    (tmp_path / "a.wav").write_bytes(file_of(bytes(4000 * 7201), 1, 8, rate=4000))
    with pytest.raises(InputError, match=r"at most two hours, received 2\.00 hours\. Cut it"):
        read_wave(tmp_path / "a.wav")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ID3 an MP3",
        b"RIFF\0\0\0\0WAVE",
        file_of(TONE.tobytes(), 6, 8),
        file_of(TONE.tobytes(), 1, 16, rate=100),
        file_of(TONE.tobytes(), 1, 16, channels=0),
        file_of(np.full(9, np.nan, "<f4").tobytes(), 3, 32),
    ],
)
def test_foreign_files_are_refused(tmp_path, content):
    (tmp_path / "a.wav").write_bytes(content)
    with pytest.raises(InputError, match="sound"):
        read_wave(tmp_path / "a.wav")
