"""From files to the arrays that a capture gives out: decoded, checked, undistorted, cut and resampled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, UInt8

from smplxpp.capture.distortion import Distortion, undistort
from smplxpp.capture.window import Window
from smplxpp.core.camera import Camera
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


# Median difference, of 255, between the declared background and the pixels without any opacity: JPEG's is about 1.
_BACKGROUND_TOLERANCE = 16
_BACKGROUND_GRID = 128


@dataclass(frozen=True)
class ViewReader:
    """Reads the images of one camera into its window.

    Attributes:
        camera: of the whole image on disk, as a pinhole.
        window: what is shown of it.
        distortion: the lens that drew the image; None where it is a pinhole's already.
        background: (3,) in [0, 1] that images are already composited on; None: photographs.
    """

    camera: Camera
    window: Window
    distortion: Distortion | None = None
    background: tuple[float, float, float] | None = None

    def color(self, path: Path) -> UInt8[np.ndarray, "H W 3"]:
        """Read an image's colours."""
        return self._shown(self._sized(read_color(path), path))

    def alpha(self, path: Path) -> UInt8[np.ndarray, "H W"]:
        """Read a mask's opacity."""
        return self._shown(self._sized(read_alpha(path), path))

    def labels(self, path: Path) -> UInt8[np.ndarray, "H W"]:
        """Read a label map."""
        return self._shown(self._sized(read_labels(path), path), labels=True)

    def normals(self, path: Path) -> Float32[np.ndarray, "H W 3"]:
        """Read a normal map, resampled to the nearest pixel, as labels: an average over an edge is no normal."""
        image, deep = read_normals(path)
        value = self._shown(self._sized(image, path), labels=True).astype(np.float32)
        # Of 16-bit files Pillow gives the upper byte: the middle of its range is 0.2 degrees off at most.
        normal = (value + 0.5) / 128.0 - 1.0 if deep else value / 127.5 - 1.0
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        seen = value.any(axis=-1, keepdims=True)
        return np.where(seen, normal / np.maximum(length, 1e-6), 0.0).astype(np.float32)

    def foreground(
        self, image_path: Path, mask_path: Path
    ) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]:
        """Colour times opacity (H, W, 3) uint8 and opacity (H, W) uint8.

        The product is formed on the full image: resampled apart, a photograph's background would bleed into the edges.
        """
        import PIL.Image

        image = self._sized(read_color(image_path), image_path)
        opacity = self._sized(read_alpha(mask_path), mask_path)
        if self.background is None:
            product = PIL.Image.new("RGB", image.size)
            box = opacity.getbbox()
            if box is not None:
                product.paste(image.crop(box), box, mask=opacity.crop(box))
            image = product
        else:
            self._check_background(image, opacity, image_path)
            if any(self.background):
                share = 1.0 - np.asarray(opacity, dtype=np.float32)[..., None] / 255.0
                colour = np.asarray(self.background, dtype=np.float32) * 255.0
                person = np.asarray(image) - share * colour + 0.5
                image = PIL.Image.fromarray(np.clip(person, 0, 255).astype(np.uint8))
        return self._shown(image), self._shown(opacity)

    def _sized(self, image: Image, path: Path) -> Image:
        return check_size(
            image, path, (self.camera.width, self.camera.height), of=f"the size of camera {self.camera.name}"
        )

    def _shown(self, image: Image, *, labels: bool = False) -> np.ndarray:
        if self.distortion is None:
            return np.asarray(self.window.apply(image, labels=labels))
        # Where the window shrinks, the distorted image is shrunk first, as a whole: the lens works on the plane z = 1
        # and does not mind, and the bilinear look-up then skips no pixel.
        whole = Window.full(self.camera)
        if not labels and min(self.window.scale) < 1:
            sx, sy = (min(scale, 1.0) for scale in self.window.scale)
            size = (max(1, round(whole.width * sx)), max(1, round(whole.height * sy)))
            whole = Window(whole.box, *size)
        return undistort(
            np.asarray(whole.apply(image)),
            self.distortion,
            source_K=whole.camera(self.camera).K,
            target_K=self.window.camera(self.camera).K,
            size=(self.window.width, self.window.height),
            nearest=labels,
        )

    def _check_background(self, image: Image, opacity: Image, path: Path) -> None:
        """An image that is not on the declared colour would be composited wrong without a sign of it."""
        # A median needs few pixels: the nearest of a coarse grid.
        from PIL.Image import Resampling

        grid = (min(image.width, _BACKGROUND_GRID), min(image.height, _BACKGROUND_GRID))
        coarse, share = (np.asarray(i.resize(grid, Resampling.NEAREST)) for i in (image, opacity))
        outside = coarse[share == 0]
        if not len(outside):
            return
        found = np.median(outside, axis=0)
        declared = np.asarray(self.background) * 255.0
        if np.abs(found - declared).max() > _BACKGROUND_TOLERANCE:
            raise InputError(
                f"image file {path}",
                expected=f"an image composited on RGB {declared.round().astype(int).tolist()}, as the capture declares",
                received=f"RGB {found.astype(int).tolist()} outside the mask",
                remedy='photographs are declared with `"background": null` in capture.json',
            )
