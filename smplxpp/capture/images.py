"""Image files: colours, masks, label maps, normal maps. Pillow is imported when the first one is read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import read_array
from smplxpp.core.files.image_file import open_image

if TYPE_CHECKING:
    from PIL.Image import Image

_REMEDY = "copy the file anew from its source, or remove it: the frame is then left out"


def read_color(path: Path) -> Image:
    """An RGB image of 8 bits a channel; an alpha channel is dropped, not applied."""
    image = open_image(path, remedy=_REMEDY)
    return image if image.mode == "RGB" else image.convert("RGB")


def read_alpha(path: Path) -> Image:
    """An 8-bit mask ("L"): the alpha channel where the file has one (mattes, cut-outs), else its brightness."""
    image = open_image(path, remedy=_REMEDY)
    if image.mode in ("RGBA", "LA", "PA"):
        return image.getchannel("A")
    if image.mode.startswith("I"):
        # 16-bit grey; Pillow's own conversion would clip.
        return _from_array((np.asarray(image, dtype=np.float64) / 257.0 + 0.5).astype(np.uint8))
    return image if image.mode == "L" else image.convert("L")


def read_labels(path: Path) -> Image:
    """An index map ("L"): the values of a grey or palette image, or of an integer `.npy`."""
    if path.suffix.lower() == ".npy":
        return _from_array(_read_npy_labels(path))
    image = open_image(path, remedy=_REMEDY)
    if image.mode not in ("L", "P", "1"):
        raise InputError(
            f"label map {path}",
            expected="a grey or palette image of indices",
            received=f"an image of mode {image.mode}",
        )
    return _from_array(np.array(image, dtype=np.uint8))


def read_normals(path: Path) -> tuple[Image, bool]:
    """An RGB image of encoded normals, and whether the file has 16 bits a channel (Pillow gives the upper 8)."""
    image = open_image(path, remedy=_REMEDY)
    return image.convert("RGB"), "16" in image.info["raw_mode"]


def check_size(image: Image, path: Path, size: tuple[int, int], *, of: str) -> Image:
    """The image, if it has the expected width and height.

    Raises:
        InputError: another size.
    """
    if image.size != size:
        raise InputError(
            f"file {path}",
            expected=f"{size[0]} x {size[1]} pixels, {of}",
            received=f"{image.width} x {image.height}",
            remedy="give images, masks and calibration of one resolution",
        )
    return image


def _read_npy_labels(path: Path) -> np.ndarray:
    values = read_array(path, subject="label map", remedy=_REMEDY)
    if values.ndim != 2 or values.dtype.kind not in "iub" or values.min(initial=0) < 0 or values.max(initial=0) > 255:
        raise InputError(
            f"label map {path}",
            expected="integers from 0 to 255 of shape (H, W)",
            received=f"{values.dtype} of shape {values.shape}",
        )
    return values.astype(np.uint8)


def _from_array(array: np.ndarray) -> Image:
    import PIL.Image

    return PIL.Image.fromarray(array)
