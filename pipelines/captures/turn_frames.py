"""Collect the frames of a person who turns: a folder of photographs, a video, or a capture by one camera."""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from smplxpp.capture import Capture, open_capture
from smplxpp.capture.files import IMAGE_SUFFIXES
from smplxpp.core import InputError, MissingExtraError, spread
from smplxpp.core.files.image_file import open_image

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
_DIAGONAL_MM = 43.27  # of a frame of 35 mm film, to which equivalent focal lengths refer
_PHONE_MM = 27.0  # main cameras of phones, filming: 24 to 30 mm
_UNKNOWN_LENS, _STATED_LENS = 0.25, 0.03  # standard deviations of log f
_FFMPEG_SECONDS = 900


@dataclass(frozen=True)
class TurnFrame:
    """A photograph of a turning person.

    Attributes:
        path: of the image.
        number: last number of its file's name; None where there is none. Files of masks and keypoints bear it too.
    """

    path: Path
    number: int | None


@dataclass(frozen=True)
class Lens:
    """What is known of the focal length.

    Attributes:
        pixels: expected focal length.
        spread: standard deviation of its logarithm.
        told_by: where it comes from, in words.
    """

    pixels: float
    spread: float
    told_by: str


@contextmanager
def turn_frames(source: Path, most: int) -> Iterator[tuple[list[TurnFrame], Capture | None]]:
    """Give the frames of a source, evenly spread, and the capture that it is; frames of a video last for the block.

    Args:
        source: folder of photographs, video, or folder of a capture by one camera.
        most: number of frames that are taken.

    Raises:
        InputError: no such source, no photographs, or a capture by several cameras.
    """
    if source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES:
        with tempfile.TemporaryDirectory(prefix="smplxpp_turn_") as folder:
            yield decoded_frames(source, Path(folder), most), None
        return
    if not source.is_dir():
        raise InputError(
            "source of a turn",
            expected=f"a folder of photographs or a video ({', '.join(VIDEO_SUFFIXES)})",
            received=str(source),
        )
    if any((source / name).is_file() for name in ("capture.json", "manifest.json", "cameras.json")):
        capture = open_capture(source, cache_bytes=0)
        yield _of_capture(capture, most), capture
        return
    paths = sorted(path for path in source.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise InputError(f"folder {source}", expected="photographs in it", received="none")
    yield [TurnFrame(path, last_number(path)) for path in spread(paths, most)], None


def last_number(path: Path) -> int | None:
    """Return the last number of a file's name, None without one."""
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else None


def decoded_frames(video: Path, folder: Path, most: int) -> list[TurnFrame]:
    """Decode evenly spread frames of a video into PNG files, upright as its rotation flag says.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
        InputError: a file that is no video.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingExtraError("imageio-ffmpeg", extra="video", purpose="reading videos") from None
    program = imageio_ffmpeg.get_ffmpeg_exe()
    try:
        count, seconds = imageio_ffmpeg.count_frames_and_secs(str(video))
    except (OSError, RuntimeError) as error:
        raise InputError(f"video {video}", expected="a video", received=str(error).splitlines()[0][:200]) from None
    # The rate at which the wanted number of frames comes out; never more than there are.
    rate = min(most, count) / max(seconds, 1e-3)
    command = [program, "-nostdin", "-v", "error", "-i", str(video), "-vf", f"fps={rate:.6f}", "-frames:v", str(most)]
    done = subprocess.run(
        [*command, str(folder / "%06d.png")], capture_output=True, text=True, timeout=_FFMPEG_SECONDS, check=False
    )
    paths = sorted(folder.glob("*.png"))
    if done.returncode or not paths:
        raise InputError(f"video {video}", expected="frames that can be decoded", received=done.stderr[:300])
    return [TurnFrame(path, last_number(path)) for path in paths]


def _of_capture(capture: Capture, most: int) -> list[TurnFrame]:
    """Return the photographs of a capture by one camera."""
    if len(capture.cameras) != 1 or capture.recording.distortions:
        raise InputError(
            f"capture {capture.name}",
            expected="one camera, without distortion",
            received=f"{len(capture.cameras)} cameras"
            + (", whose images are distorted" if capture.recording.distortions else ""),
            remedy="`smplxpp capture convert` undistorts; --cameras there keeps one",
        )
    (camera,) = capture.cameras
    frames = spread([frame for _, frame in capture.views()], most)
    return [TurnFrame(capture.required_file(camera, frame), frame) for frame in frames]


def upright_image(path: Path) -> Image.Image:
    """Read a photograph as it is to be seen, turned as its Exif record says."""
    return ImageOps.exif_transpose(open_image(path, subject="photograph")).convert("RGB")


def lens_of(path: Path, size: tuple[int, int], focal_mm: float | None) -> Lens:
    """Return what is known of a lens: the user's word, the photograph's Exif record, or that it is a phone's.

    Args:
        path: of a photograph.
        size: width and height in pixels.
        focal_mm: focal length as the user states it, millimetres of 35 mm film.
    """
    pixels_a_mm = float(np.hypot(*size)) / _DIAGONAL_MM
    if focal_mm is not None:
        return Lens(focal_mm * pixels_a_mm, _STATED_LENS, f"stated, {focal_mm:g} mm")
    exif = open_image(path, subject="photograph").getexif().get_ifd(ExifTags.IFD.Exif)
    recorded = exif.get(ExifTags.Base.FocalLengthIn35mmFilm)
    if isinstance(recorded, int) and 5 <= recorded <= 500:
        return Lens(recorded * pixels_a_mm, 2 * _STATED_LENS, f"recorded in the photograph, {recorded} mm")
    return Lens(_PHONE_MM * pixels_a_mm, _UNKNOWN_LENS, f"not known, {_PHONE_MM:g} mm expected of a phone")
