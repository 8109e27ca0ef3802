"""Collect the frames of a person who turns: a folder of photographs, a video, or a capture by one camera."""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import ExifTags, Image, ImageOps
from scipy.ndimage import laplace

from smplxpp.capture import Capture, open_capture
from smplxpp.capture.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from smplxpp.capture.video_files import ffmpeg_program, probe_video
from smplxpp.core import InputError, Keypoints2D, spread
from smplxpp.core.files.image_file import open_image

_UNKNOWN_LENS, _STATED_LENS = 0.25, 0.03  # standard deviations of log f


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
    """Give the frames of a source, evenly spread, and the capture that it is; a video's last for the block.

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
    """Decode the sharpest frames of equal times of a video into PNG files, upright as its rotation flag says.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
        InputError: a file that is no video.
    """
    # Of a frame that is judged: finer detail is noise of the sensor, and minutes have 2000 frames.
    sharpness_pixels = 256
    program, times = ffmpeg_program(), probe_video(video).times
    # All frames, small and grey, show which of them are sharp; those that are chosen are decoded whole.
    side = sharpness_pixels
    small = _ffmpeg(program, video, f"scale={side}:{side},format=gray", "-f", "rawvideo", "-")
    grey = np.frombuffer(small, np.uint8)
    if not len(frames := grey[: len(grey) // side**2 * side**2].reshape(-1, side, side)):
        raise InputError(f"video {video}", expected="frames that can be decoded", received="none")
    # A damaged file has fewer frames than stamps.
    times = times[: len(frames)] if len(times) >= len(frames) else np.arange(len(frames), dtype=np.float64)
    chosen = sharpest_of_intervals(frames, times, most)
    picked = "+".join(f"eq(n\\,{number})" for number in chosen)
    _ffmpeg(program, video, f"select={picked},format=rgb24", str(folder / "%06d.png"))
    return [TurnFrame(path, last_number(path)) for path in sorted(folder.glob("*.png"))]


def sharpest_of_intervals(frames: UInt8[np.ndarray, "T H W"], times: Float64[np.ndarray, " T"], most: int) -> list[int]:
    """Return the sharpest frame of each of `most` intervals of equal time, by the variance of the Laplacian.

    Candidates are the middle halves of the intervals, so that neighbours of the choice are 0.5 to 1.5 intervals apart;
    where a video has none there, the frame nearest to the middle.

    Args:
        frames: all of a video, grey.
        times: of the frames, ascending; a phone's rate varies, a turn goes by the clock.
        most: number of frames to choose; all are taken where there are no more.
    """
    if len(frames) <= most:
        return list(range(len(frames)))
    sharp = np.array([laplace(frame.astype(np.float32)).var() for frame in frames])
    ends, chosen = np.linspace(times[0], times[-1] + np.median(np.diff(times)), most + 1), set()
    for first, last in pairwise(ends):
        near = np.flatnonzero(np.abs(times - 0.5 * (first + last)) <= (last - first) / 4)
        middle = np.abs(times - 0.5 * (first + last)).argmin()
        chosen.add(int(near[sharp[near].argmax()] if len(near) else middle))
    return sorted(chosen)


def _ffmpeg(program: str, video: Path, filters: str, *output: str) -> bytes:
    """Return what FFmpeg writes to its output for a video, every frame once.

    Raises:
        InputError: a file that is no video.
    """
    command = [program, "-nostdin", "-v", "error", "-i", str(video), "-vf", filters, "-fps_mode", "passthrough"]
    done = subprocess.run([*command, *output], capture_output=True, timeout=900, check=False)
    if done.returncode:
        message = done.stderr.decode(errors="replace").strip()[:200].partition("\n")[0] or "nothing"
        raise InputError(f"video {video}", expected="a video that can be decoded", received=message)
    return done.stdout


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


def is_turned(path: Path) -> bool:
    """Return whether a photograph has to be rotated to be upright."""
    return int(open_image(path, subject="photograph").getexif().get(ExifTags.Base.Orientation, 1)) != 1


def lens_of(path: Path, size: tuple[int, int], focal_mm: float | None) -> Lens:
    """Return what is known of a lens: the user's word, the photograph's Exif record, or that it is a phone's.

    Args:
        path: of a photograph.
        size: width and height in pixels.
        focal_mm: focal length as the user states it, millimetres of 35 mm film.
    """
    diagonal_mm = 43.27  # of a frame of 35 mm film, to which equivalent focal lengths refer
    pixels_a_mm = float(np.hypot(*size)) / diagonal_mm
    if focal_mm is not None:
        return Lens(focal_mm * pixels_a_mm, _STATED_LENS, f"stated, {focal_mm:g} mm")
    exif = open_image(path, subject="photograph").getexif().get_ifd(ExifTags.IFD.Exif)
    recorded = exif.get(ExifTags.Base.FocalLengthIn35mmFilm)
    if isinstance(recorded, int) and 5 <= recorded <= 500:
        return Lens(recorded * pixels_a_mm, 2 * _STATED_LENS, f"recorded in the photograph, {recorded} mm")
    # Main cameras of phones, filming: 24 to 30 mm.
    phone_mm = 27.0
    return Lens(phone_mm * pixels_a_mm, _UNKNOWN_LENS, f"not known, {phone_mm:g} mm expected of a phone")


def keypoints_of_frames(keypoints: Keypoints2D, frames: list[TurnFrame], source: str) -> Keypoints2D:
    """Return keypoints with the frames numbered from 0, matched by the files' numbers, else by their order.

    Raises:
        InputError: keypoints of other frames.
    """
    have, wanted = keypoints.frames.tolist(), [frame.number for frame in frames]
    if not set(wanted) <= set(have):
        if len(have) != len(frames):
            raise InputError(
                f"keypoints {source}",
                expected=f"those of {len(frames)} frames, with the numbers of their files",
                received=f"{len(have)} frames, {have[0]} to {have[-1]}" if have else "none",
            )
        wanted = list(have)
    rows = keypoints.select(keypoints.names, [int(number or 0) for number in wanted])
    return Keypoints2D(rows.names, np.arange(len(frames)), rows.points, rows.confidence)


def files_of_frames(folder: Path, frames: list[TurnFrame], what: str) -> dict[int, Path]:
    """Match the files of a folder to the frames by their numbers, else by their order.

    Raises:
        InputError: no such folder, or files of other frames.
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES) if folder.is_dir() else []
    by_number = {last_number(path): path for path in files}
    if len(by_number) == len(files) and {frame.number for frame in frames} <= set(by_number):
        return {row: by_number[frame.number] for row, frame in enumerate(frames)}
    if len(files) != len(frames):
        raise InputError(
            f"{what} {folder}",
            expected=f"images of the {len(frames)} frames, with the numbers of their files",
            received=f"{len(files)} images",
        )
    return dict(enumerate(files))
