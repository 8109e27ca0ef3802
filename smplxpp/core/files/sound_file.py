"""Read sound files of any usual kind: WAV directly, others (FLAC, AIFF, MP3, Ogg, M4A) decoded by ffmpeg.

The format is recognised by the first bytes and named to ffmpeg, so that a playlist cannot make it open other files.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.files.wave_file import MAX_BYTES, REMEDY, Sound, sound_of_wave

_LONGEST = 7200  # seconds that are decoded; 16 bits of two channels at 48 kHz stay below `MAX_BYTES`
_TIMEOUT = 900  # seconds that ffmpeg may take


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
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=_TIMEOUT)
    except subprocess.TimeoutExpired:
        raise InputError(subject, expected=f"{name} that decodes in 15 minutes", received="more") from None
    words = done.stderr.decode(errors="replace").strip().splitlines()
    if done.returncode or len(done.stdout) < 48:
        reason = words[-1] if words else "no sound in it"
        raise InputError(subject, expected=f"{name} with sound", received=f"ffmpeg: {reason}", remedy=REMEDY)
    sound = sound_of_wave(done.stdout, path)
    if sound.seconds > _LONGEST:
        raise InputError(subject, expected="at most two hours", received="more", remedy="cut it into parts")
    return sound


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
    except (ImportError, RuntimeError):  # RuntimeError: the package has no program for this machine
        program = shutil.which("ffmpeg")
    if program is None:
        raise MissingExtraError("imageio-ffmpeg", extra="video", purpose=f"reading {name} (WAV needs nothing)")
    return program
