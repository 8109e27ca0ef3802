"""Pictures in, a film out: MP4 (H.264), GIF or a folder of PNG files, whole or not at all."""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_folder, atomic_path, atomic_write_bytes
from smplxpp.core.files.sound_file import Sound, wave_bytes
from smplxpp.core.lazy import import_extra
from smplxpp.figures.sheets import encode_png

FRAME_FOLDER = ""  # the suffix of a folder of pictures
SUFFIXES = (".mp4", ".gif", FRAME_FOLDER)


def write_film(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "H W 3"]],
    *,
    fps: float,
    size: tuple[int, int],
    sound: Sound | None = None,
) -> None:
    """Write frames as the kind of film that the suffix of `path` names.

    Args:
        size: width and height in pixels, even for MP4. sound: from the first frame on; an MP4 alone takes it.

    Raises:
        InputError: sound for another kind of film.
        MissingExtraError: MP4 without imageio-ffmpeg.
        OSError: the film could not be written whole.
    """
    if sound is not None and path.suffix.lower() != ".mp4":
        raise InputError(f"output {path}", expected=".mp4 for a film with sound", received=path.suffix or "a folder")
    if sound is not None:
        _write_mp4(path, frames, fps, size, sound)
        return
    writer = {".mp4": _write_mp4, ".gif": _write_gif, FRAME_FOLDER: _write_folder}[path.suffix.lower()]
    writer(path, frames, fps, size)


def _write_mp4(
    path: Path, frames: Iterable[np.ndarray], fps: float, size: tuple[int, int], sound: Sound | None = None
) -> None:
    package = import_extra("imageio_ffmpeg", extra="video", purpose="writing MP4", named="imageio-ffmpeg")
    program = package.get_ffmpeg_exe()
    with (
        atomic_path(path) as temporary,
        tempfile.TemporaryFile() as output,
        tempfile.NamedTemporaryFile(suffix=".wav") as heard,
    ):
        if sound is not None:
            heard.write(wave_bytes(sound))
            heard.flush()
        audio = None if sound is None else Path(heard.name)
        encoder = subprocess.Popen(
            _encoding(program, temporary, fps, size, audio), stdin=subprocess.PIPE, stderr=output
        )
        count = 0
        assert encoder.stdin is not None  # a pipe was asked for
        try:
            for frame in frames:
                encoder.stdin.write(np.ascontiguousarray(frame).data)
                count += 1
            encoder.stdin.close()
        except BrokenPipeError:  # the encoder ended; its status and output give the reason
            with suppress(BrokenPipeError):
                encoder.stdin.close()  # of what it had not taken yet
        except BaseException:
            encoder.kill()
            raise
        finally:
            encoder.wait()
        output.seek(0)
        words = output.read().decode(errors="replace")
        # An encoder whose disk is full may end with 0: what counts is the film.
        if encoder.returncode or package.count_frames_and_secs(str(temporary))[0] != count:
            raise _encoder_error(encoder.returncode, words)


def _encoding(program: str, path: Path, fps: float, size: tuple[int, int], sound: Path | None = None) -> list[str]:
    """Return the command that reads RGB frames and writes H.264 with 4:2:0 colour, which every player takes."""
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}"]
    raw += ["-r", str(Fraction(fps).limit_denominator())]
    codec = ["-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-preset", "medium", "-movflags", "+faststart"]
    audio = (
        ["-an"] if sound is None else ["-i", str(sound), "-map", "0:v", "-map", "1:a", "-acodec", "aac", "-b:a", "128k"]
    )
    return [program, "-nostdin", "-y", "-v", "error", *raw, "-i", "pipe:0", *audio, *codec, str(path)]


def _encoder_error(status: int, words: str) -> OSError:
    """Make the error of an encoder that did not write its film, with the system's number where its words tell it."""
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
        if os.strerror(number) in words or (number == errno.EFBIG and status == -signal.SIGXFSZ):
            return OSError(number, os.strerror(number))
    last = (words.strip().splitlines() or ["it says nothing"])[-1]
    return OSError(f"ffmpeg did not write the whole film (status {status}): {last}")


def _write_gif(path: Path, frames: Iterable[np.ndarray], fps: float, size: tuple[int, int]) -> None:
    images = [Image.fromarray(frame).quantize(128, dither=Image.Dither.NONE) for frame in frames]
    # GIF counts in hundredths of a second, and viewers slow down below two of them.
    duration = max(20, 10 * round(100 / fps))
    film = io.BytesIO()  # Pillow does not see when a disk takes a part of what it writes
    images[0].save(film, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)
    atomic_write_bytes(path, film.getvalue())


def _write_folder(path: Path, frames: Iterable[np.ndarray], fps: float, size: tuple[int, int]) -> None:
    with atomic_folder(path) as temporary:
        for k, frame in enumerate(frames):
            (temporary / f"frame_{k:06d}.png").write_bytes(encode_png(frame))
