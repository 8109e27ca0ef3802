"""Pictures in, a film out: MP4 (H.264), GIF or a folder of PNG files, whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from pipelines.figures import encode_png
from smplxpp.core.atomic import atomic_folder, atomic_path
from smplxpp.core.errors import MissingExtraError

FRAME_FOLDER = ""  # the suffix of a folder of pictures
SUFFIXES = (".mp4", ".gif", FRAME_FOLDER)


def write_film(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], *, fps: float, size: tuple[int, int]) -> None:
    """Write frames as the kind of film that the suffix of `path` names.

    Args:
        size: width and height in pixels, even for MP4.

    Raises:
        MissingExtraError: MP4 without imageio-ffmpeg.
    """
    writer = {".mp4": _write_mp4, ".gif": _write_gif, FRAME_FOLDER: _write_folder}[path.suffix.lower()]
    writer(path, frames, fps, size)


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float, size: tuple[int, int]) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingExtraError("imageio-ffmpeg", extra="video", purpose="writing MP4") from None
    with atomic_path(path) as temporary:
        encoder = imageio_ffmpeg.write_frames(
            str(temporary),
            size,
            fps=fps,
            codec="libx264",
            quality=None,
            macro_block_size=2,
            pix_fmt_out="yuv420p",
            output_params=["-crf", "18", "-preset", "medium", "-movflags", "+faststart"],
        )
        encoder.send(None)
        try:
            for frame in frames:
                encoder.send(np.ascontiguousarray(frame))
        finally:
            encoder.close()


def _write_gif(path: Path, frames: Iterable[np.ndarray], fps: float, size: tuple[int, int]) -> None:
    images = [Image.fromarray(frame).quantize(128, dither=Image.Dither.NONE) for frame in frames]
    with atomic_path(path) as temporary:
        # GIF counts in hundredths of a second, and viewers slow down below two of them.
        duration = max(20, 10 * round(100 / fps))
        images[0].save(temporary, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)


def _write_folder(path: Path, frames: Iterable[np.ndarray], fps: float, size: tuple[int, int]) -> None:
    with atomic_folder(path) as temporary:
        for k, frame in enumerate(frames):
            (temporary / f"frame_{k:06d}.png").write_bytes(encode_png(frame))
