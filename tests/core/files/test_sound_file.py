"""Recordings in other files than WAV are the same sound; what cannot be decoded says what helps."""

from __future__ import annotations

import struct
import subprocess
import sys

import numpy as np
import pytest

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.sound_file import Sound, read_sound, wave_bytes

RATE = 22050
TONE = (0.5 * np.sin(2 * np.pi * 440 * np.arange(RATE // 2) / RATE)).astype(np.float32)


@pytest.fixture(scope="module")
def ffmpeg() -> str:
    return pytest.importorskip("imageio_ffmpeg", reason="the extra video has ffmpeg").get_ffmpeg_exe()


def aiff(samples: np.ndarray, rate: int) -> bytes:
    """One channel of big-endian 16 bits, by Apple's description: the rate is a float of 80 bits."""
    exponent = rate.bit_length() - 1
    long_float = struct.pack(">HQ", 16383 + exponent, rate << (63 - exponent))
    common = struct.pack(">hIh", 1, len(samples), 16) + long_float
    sound = struct.pack(">II", 0, 0) + np.round(samples * 32767).astype(">i2").tobytes()
    body = b"AIFF" + b"".join(
        name + struct.pack(">I", len(one)) + one for name, one in ((b"COMM", common), (b"SSND", sound))
    )
    return b"FORM" + struct.pack(">I", len(body)) + body


def test_aiff_is_the_same_sound_whatever_its_name(ffmpeg, tmp_path):
    (tmp_path / "speech.wav").write_bytes(aiff(TONE, RATE))
    sound = read_sound(tmp_path / "speech.wav")
    assert sound.rate == RATE
    np.testing.assert_allclose(sound.samples, TONE, atol=1e-4)


@pytest.mark.parametrize(("suffix", "exact"), [("flac", 1e-4), ("ogg", None), ("mp3", None), ("m4a", None)])
def test_what_ffmpeg_encodes_is_heard(ffmpeg, tmp_path, suffix, exact):
    (tmp_path / "a.wav").write_bytes(wave_bytes(Sound(TONE, RATE)))
    command = [ffmpeg, "-v", "error", "-i", str(tmp_path / "a.wav"), str(tmp_path / f"a.{suffix}")]
    subprocess.run(command, check=True, capture_output=True, timeout=900)
    sound = read_sound(tmp_path / f"a.{suffix}")
    assert sound.rate == RATE and abs(sound.seconds - 0.5) < 0.06
    if exact is not None:
        np.testing.assert_allclose(sound.samples, TONE, atol=exact)
    # The loudest frequency of a lossy file is the tone's.
    power = np.abs(np.fft.rfft(sound.samples))
    assert abs(np.fft.rfftfreq(len(sound.samples), 1 / RATE)[power.argmax()] - 440) < 3


def test_damaged_and_foreign_files_are_refused(ffmpeg, tmp_path):
    (tmp_path / "a.flac").write_bytes(b"fLaC" + bytes(200))
    with pytest.raises(InputError, match="FLAC with sound"):
        read_sound(tmp_path / "a.flac")
    (tmp_path / "a.txt").write_bytes(b"#EXTM3U\n#EXTINF:1,\nfile:///etc/hostname\n")
    with pytest.raises(InputError, match="WAV"):
        read_sound(tmp_path / "a.txt")


def test_without_ffmpeg_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.aiff").write_bytes(aiff(TONE, RATE))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(MissingExtraError, match=r"reading AIFF.*extra video"):
        read_sound(tmp_path / "a.aiff")
