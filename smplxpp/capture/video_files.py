"""Read videos through ffmpeg: what they hold, some of their frames, their sound. Needs the extra `video`."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import regular_file
from smplxpp.core.lazy import import_extra

_STREAM = re.compile(r"Stream #\d+:\d+.*?: Video: .*?(?<![\dx])(\d{2,5})x(\d{2,5})")
_RATE = re.compile(r"Stream #\d+:\d+.*?: Video: .*?([\d.]+) fps")
_TURN = re.compile(r"rotation of (-?[\d.]+) degrees")
_DURATION = re.compile(r"Duration: (\d+):(\d+):([\d.]+)")


@dataclass(frozen=True)
class Video:
    """What a video file says of itself.

    Attributes:
        path: of the file.
        width: of a frame as it is shown, after the rotation that the file asks for.
        height: of such a frame.
        fps: frames a second, on average.
        seconds: duration.
        turned: whether the file asks for a quarter turn, so that stored frames have the other orientation.
        sound: whether it has sound.
    """

    path: Path
    width: int
    height: int
    fps: float
    seconds: float
    turned: bool
    sound: bool

    @property
    def count(self) -> int:
        """Number of frames, by duration and rate."""
        return max(1, round(self.seconds * self.fps))

    @cached_property
    def times(self) -> Float64[np.ndarray, " T"]:
        """Seconds of all frames after the first, as the file stamps them: phones film at a rate that varies.

        Files without stamps have frames at equal intervals.
        """
        # Packets are listed without being decoded, in the order in which they are stored.
        command = [ffmpeg_program(), "-v", "error", "-i", str(self.path), "-map", "0:v:0", "-c", "copy"]
        found = subprocess.run([*command, "-f", "framecrc", "-"], capture_output=True, check=False)
        text = found.stdout.decode(errors="replace")
        base, stamps = re.search(r"#tb 0: (\d+)/(\d+)", text), re.findall(r"^0,\s*-?\w+,\s*(\d+),", text, re.MULTILINE)
        seconds = np.sort(np.array(stamps, dtype=np.float64))
        if base is None or len(seconds) < 2 or (np.diff(seconds) <= 0).any():
            return np.arange(self.count) / self.fps
        return (seconds - seconds[0]) * int(base[1]) / int(base[2])


def probe_video(path: str | Path) -> Video:
    """Read size, rate, duration and rotation of a video.

    Raises:
        InputError: no file, or no video in it.
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    path = regular_file(path, subject="video")
    # ffmpeg describes the file on stderr, and ends with an error because no output is named.
    found = subprocess.run([ffmpeg_program(), "-hide_banner", "-i", str(path)], capture_output=True, check=False)
    text = found.stderr.decode(errors="replace")
    size, rate, duration = (pattern.search(text) for pattern in (_STREAM, _RATE, _DURATION))
    if size is None or rate is None or duration is None or float(rate[1]) <= 0:
        raise InputError(
            f"video {path}", expected="a video that ffmpeg reads", received=text.strip()[-200:] or "nothing"
        )
    hours, minutes, seconds = (float(duration[k]) for k in (1, 2, 3))
    turn = _TURN.search(text)
    turned = turn is not None and round(float(turn[1]) / 90.0) % 2 == 1
    width, height = (int(size[k]) for k in ((2, 1) if turned else (1, 2)))
    # Pixels of the longest side that is decoded.
    side = 1 << 14
    if max(width, height) > side:
        raise InputError(f"video {path}", expected=f"frames of at most {side} pixels", received=f"{width} x {height}")
    return Video(
        path, width, height, float(rate[1]), 3600 * hours + 60 * minutes + seconds, turned, ": Audio: " in text
    )


def video_frames(
    video: Video, numbers: Sequence[int], size: tuple[int, int], *, as_stored: bool = False
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Yield some frames of a video, resized, in ascending order of their numbers; those behind its end are left out.

    Args:
        video: of `probe_video`.
        numbers: of the frames, from 0, as the file stores them one after another.
        size: width and height to which they are resized.
        as_stored: whether the rotation that the file asks for is ignored.

    Raises:
        InputError: the video is damaged before the first of these frames.
    """
    wanted = sorted(set(numbers))
    if not wanted:
        return
    command = [ffmpeg_program(), "-hide_banner", "-loglevel", "error", *(["-noautorotate"] if as_stored else [])]
    command += ["-i", str(video.path), "-map", "0:v:0", "-vf", f"scale={size[0]}:{size[1]}:flags=area"]
    command += [
        "-fps_mode",
        "passthrough",
        "-frames:v",
        str(wanted[-1] + 1),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    bytes_each, given = 3 * size[0] * size[1], 0
    decoder = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert decoder.stdout is not None and decoder.stderr is not None  # pipes were asked for
    try:
        chosen = set(wanted)
        for number in range(wanted[-1] + 1):
            data = decoder.stdout.read(bytes_each)
            if len(data) < bytes_each:
                break
            if number in chosen:
                given += 1
                yield number, np.frombuffer(data, dtype=np.uint8).reshape(size[1], size[0], 3)
    finally:
        decoder.stdout.close()
        words = decoder.stderr.read().decode(errors="replace").strip()
        decoder.stderr.close()
        decoder.wait()
    if not given:
        raise InputError(f"video {video.path}", expected="frames", received=words[-200:] or "none")


def video_sound(video: Video, rate: int) -> Float64[np.ndarray, " S"]:
    """Return the sound of a video as one channel of numbers from -1 to 1; empty without any.

    Args:
        video: of `probe_video`.
        rate: samples a second.
    """
    if not video.sound:
        return np.zeros(0)
    command = [
        ffmpeg_program(),
        "-hide_banner",
        "-loglevel",
        "error",
        "-i",
        str(video.path),
        "-map",
        "0:a:0",
        "-ac",
        "1",
    ]
    found = subprocess.run([*command, "-ar", str(rate), "-f", "f32le", "-"], capture_output=True, check=False)
    return np.frombuffer(found.stdout[: len(found.stdout) // 4 * 4], dtype="<f4").astype(np.float64)


def ffmpeg_program() -> str:
    """Return the path of the ffmpeg that reads videos.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    package = import_extra("imageio_ffmpeg", extra="video", purpose="reading videos", named="imageio-ffmpeg")
    return str(package.get_ffmpeg_exe())
