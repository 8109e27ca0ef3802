"""Read sound files of any usual kind and write WAV; what is no WAV (FLAC, AIFF, MP3, Ogg, M4A) is decoded by ffmpeg.

The format is recognised by the first bytes and named to ffmpeg, so that a playlist cannot make it open other files.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.paths import read_bytes

# Codes of the sample format in a WAV file; an extensible header holds the code in its second part.
_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
_EXPECTED = "a WAV file (RIFF): integers of 8, 16, 24 or 32 bits, or floats"
REMEDY = "`ffmpeg -i INPUT -ac 1 -ar 16000 speech.wav` makes one of any recording"
"""What helps where a recording cannot be read."""
MAX_BYTES = 1 << 30
"""Size from which a sound file is refused."""
_LONGEST = 7200  # seconds that are read; 16 bits of two channels at 48 kHz stay below `MAX_BYTES`
_BLOCK = 1 << 20  # samples of all channels that are converted at a time, which bounds the work space
# Largest relative change of a rate by rounding, 18 ms in an hour: half a frame of a film. Filters of 4 to 384 kHz then
# have thousands of taps, at worst a million, in the place of twenty times the rate.
_DRIFT = 5e-6


@dataclass(frozen=True, eq=False)
class Sound:
    """Samples of one channel of sound at a constant rate.

    Attributes:
        samples: amplitudes from -1 to 1.
        rate: samples per second.
    """

    samples: Float32[np.ndarray, " N"]
    rate: int

    @property
    def seconds(self) -> float:
        """Duration of the sound in seconds."""
        return len(self.samples) / self.rate

    def at_rate(self, rate: int) -> Sound:
        """Return the sound resampled to another rate, with a low-pass filter against aliasing.

        The ratio of odd rates is rounded to small numbers, within `_DRIFT`, as the filter grows with them.
        """
        if rate == self.rate or not len(self.samples):
            return Sound(self.samples, rate)
        # Imported here, because it takes half a second, which a command pays that reads no sound.
        from scipy.signal import resample_poly

        ratio = _rounded(Fraction(rate, self.rate))
        samples = resample_poly(self.samples, ratio.numerator, ratio.denominator)
        # The last samples, which the rounding may add or lose.
        count = -(-len(self.samples) * rate // self.rate)
        samples = np.pad(samples[:count], (0, max(0, count - len(samples))))
        return Sound(samples.astype(np.float32), rate)

    def integers(self) -> np.ndarray:
        """Return the samples as 16-bit integers, clipped to [-1, 1]."""
        return np.round(np.clip(self.samples, -1.0, 1.0) * 32767.0).astype("<i2")


def _rounded(ratio: Fraction) -> Fraction:
    """Return a ratio of small numbers that differs by less than `_DRIFT`."""
    most = 1000
    while True:
        near = ratio.limit_denominator(most) if ratio <= 1 else 1 / (1 / ratio).limit_denominator(most)
        if abs(near / ratio - 1) <= _DRIFT:
            return near
        most *= 2


def read_wave(path: str | Path) -> Sound:
    """Read a WAV file and average its channels.

    Raises:
        InputError: missing, damaged or foreign; a coding other than integers and floats; NaN; over two hours.
    """
    return sound_of_wave(read_bytes(path, subject="sound", most=MAX_BYTES), path)


def sound_of_wave(data: bytes, path: str | Path) -> Sound:
    """Return the sound in the bytes of a WAV file as `read_wave` does; `path` names it in errors."""
    (lowest_rate, highest_rate), max_channels = (4000, 384_000), 64
    subject = f"sound {path}"
    if data[:4] != b"RIFF" or data[8:12] != b"WAVE":
        raise InputError(subject, expected=_EXPECTED, received="another kind of file", remedy=REMEDY)
    chunks = _chunks(data)
    if len(chunks.get(b"fmt ", memoryview(b""))) < 16 or b"data" not in chunks:
        raise InputError(subject, expected=_EXPECTED, received="no description or no samples", remedy=REMEDY)
    # Format header: sample format, channels, rate, bytes per second, bytes per block, bits per sample.
    kind, channels, rate, _, block, bits = struct.unpack("<HHIIHH", chunks[b"fmt "][:16])
    # WAVE_FORMAT_EXTENSIBLE keeps the true code in the first two bytes of its GUID, at byte 24.
    if kind == _EXTENSIBLE and len(chunks[b"fmt "]) >= 26:
        (kind,) = struct.unpack("<H", chunks[b"fmt "][24:26])
    known = (kind == _PCM and bits in (8, 16, 24, 32)) or (kind == _FLOAT and bits in (32, 64))
    if not known:
        raise InputError(subject, expected=_EXPECTED, received=f"coding {kind} of {bits} bits", remedy=REMEDY)
    if not (1 <= channels <= max_channels and lowest_rate <= rate <= highest_rate and block == channels * bits // 8):
        raise InputError(
            subject,
            expected=f"1 to {max_channels} channels at {lowest_rate} to {highest_rate} Hz",
            received=f"{channels} at {rate} Hz in blocks of {block} bytes",
        )
    # Drop an incomplete last block, which recorders leave when they are interrupted.
    raw = np.frombuffer(chunks[b"data"], np.uint8)
    count = len(raw) // block
    if count > _LONGEST * rate:
        raise _too_long(subject, count / rate)
    samples = np.empty(count, np.float32)
    step = max(1, _BLOCK // channels)
    for begin in range(0, count, step):
        values = _numbers(raw[begin * block : min(begin + step, count) * block], kind, bits).reshape(-1, channels)
        if not np.isfinite(values).all():
            raise InputError(subject, expected="finite samples", received="NaN or infinity")
        # Floats may exceed 1; the bound of 8 (18 dB) keeps damaged samples from overflowing later sums.
        samples[begin : begin + step] = np.clip(values.mean(axis=1), -8.0, 8.0)
    return Sound(samples, rate)


def _too_long(subject: str, seconds: float) -> InputError:
    return InputError(
        subject,
        expected="at most two hours",
        received=f"{seconds / 3600.0:.2f} hours",
        remedy="cut it into parts",
    )


def wave_bytes(sound: Sound) -> bytes:
    """Return the bytes of a mono WAV file of 16-bit integers."""
    data = sound.integers().tobytes()
    form = struct.pack("<HHIIHH", _PCM, 1, sound.rate, 2 * sound.rate, 2, 16)
    body = b"WAVEfmt " + struct.pack("<I", len(form)) + form + b"data" + struct.pack("<I", len(data)) + data
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _chunks(data: bytes) -> dict[bytes, memoryview]:
    """Return the first chunk of each name, without copies; an interrupted recording may state sizes past its end."""
    out: dict[bytes, memoryview] = {}
    view, at = memoryview(data), 12
    while at + 8 <= len(data):
        size = int.from_bytes(data[at + 4 : at + 8], "little")
        out.setdefault(data[at : at + 4], view[at + 8 : at + 8 + size])
        at += 8 + size + size % 2
    return out


def _numbers(raw: UInt8[np.ndarray, " B"], kind: int, bits: int) -> np.ndarray:
    """Convert raw samples to float64 from -1 to 1."""
    if kind == _FLOAT:
        return raw.view(f"<f{bits // 8}").astype(np.float64)
    # Eight-bit samples are unsigned around 128, all wider ones are signed.
    if bits == 8:
        return (raw.astype(np.float64) - 128.0) / 128.0
    # 24 bits become the upper three bytes of a 32-bit integer, which keeps the sign.
    if bits == 24:
        wide = np.zeros((len(raw) // 3, 4), np.uint8)
        wide[:, 1:] = raw.reshape(-1, 3)
        return wide.reshape(-1).view("<i4").astype(np.float64) / 2.0**31
    return raw.view(f"<i{bits // 8}").astype(np.float64) / 2.0 ** (bits - 1)


def read_sound(path: str | Path) -> Sound:
    """Read a sound file and average its channels.

    WAV needs nothing else. FLAC, AIFF, MP3, Ogg (Vorbis, Opus), M4A, MP4, WebM and CAF are decoded by ffmpeg: that of
    the package imageio-ffmpeg, or the program on the path.

    Args:
        path: the file; its name does not matter.

    Returns:
        Samples at the file's own rate, at most two hours of them.

    Raises:
        InputError: missing, damaged or foreign, without sound, or longer.
        MissingExtraError: ffmpeg is needed and not there.

    Example:
        >>> atomic_write_bytes(tmp / "tone.wav", wave_bytes(Sound(np.zeros(1600, np.float32), 16_000)))
        >>> read_sound(tmp / "tone.wav").seconds
        0.1
    """
    data = read_bytes(path, subject="sound", most=MAX_BYTES)
    kind = _kind(data[:12])
    if kind is None:
        return sound_of_wave(data, path)
    name, demuxer = kind
    command = [_ffmpeg(name), "-nostdin", "-v", "error", "-protocol_whitelist", "file,pipe", "-f", demuxer]
    command += ["-i", f"file:{Path(path).absolute()}", "-map", "0:a:0", "-t", str(_LONGEST + 1)]
    command += ["-bitexact", "-c:a", "pcm_s16le", "-f", "wav", "pipe:1"]
    subject = f"sound {path}"
    # Seconds that ffmpeg may take.
    timeout = 900
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=timeout)
    except subprocess.TimeoutExpired:
        raise InputError(subject, expected=f"{name} that decodes in 15 minutes", received="more") from None
    words = done.stderr.decode(errors="replace").strip().splitlines()
    if done.returncode or len(done.stdout) < 48:
        reason = words[-1] if words else "no sound in it"
        raise InputError(subject, expected=f"{name} with sound", received=f"ffmpeg: {reason}", remedy=REMEDY)
    return sound_of_wave(done.stdout, path)


def _kind(head: bytes) -> tuple[str, str] | None:
    """Return the name of a file's kind and of ffmpeg's demuxer by its first 12 bytes; None for WAV and the unknown."""
    if head[:4] == b"FORM" and head[8:12] in (b"AIFF", b"AIFC"):
        return "AIFF", "aiff"
    if head[4:8] == b"ftyp":
        return "MPEG-4", "mov"
    # An MP3 begins with a tag or with a frame: eleven bits set, then layer III; AAC alone has layer bits of zero.
    if head[:3] == b"ID3" or (head[:1] == b"\xff" and len(head) > 1 and head[1] & 0xE6 == 0xE2):
        return "MP3", "mp3"
    if head[:1] == b"\xff" and len(head) > 1 and head[1] & 0xF6 == 0xF0:
        return "AAC", "aac"
    beginnings = {
        b"fLaC": ("FLAC", "flac"),
        b"OggS": ("Ogg", "ogg"),
        b"caff": ("CAF", "caf"),
        b"\x1aE\xdf\xa3": ("WebM", "matroska"),
    }
    return beginnings.get(head[:4])


def _ffmpeg(name: str) -> str:
    """Return the program that decodes; `name` is the kind of the file."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:  # RuntimeError: the package has no program for this machine
        program, reason = shutil.which("ffmpeg"), error
    if program is None:
        absent = isinstance(reason, ModuleNotFoundError) and reason.name == "imageio_ffmpeg"
        raise MissingExtraError(
            "imageio-ffmpeg",
            extra="video",
            purpose=f"reading {name} (WAV needs nothing)",
            reason="" if absent else str(reason),
        )
    return program
