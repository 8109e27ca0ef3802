"""Read images, masks, label and normal maps of a view: decode, check, undistort, crop, resample and cache."""

from __future__ import annotations

import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, UInt8

from smplxpp.capture.distortion import Distortion, undistort
from smplxpp.capture.window import Window
from smplxpp.core import Camera, GeometryWarning, InputError
from smplxpp.core.files.array_file import read_array
from smplxpp.core.files.image_file import open_image

if TYPE_CHECKING:
    from PIL.Image import Image

Arrays = tuple[np.ndarray, ...]
_REMEDY = "copy the file from its source again, or remove it to leave the frame out"


class ArrayCache:
    """A least-recently-used cache of arrays, safe to use from several threads.

    Pickling (for a worker of a data loader) keeps the bound, not the content, and a forked process starts empty. So
    every process holds at most `max_bytes`.

    Args:
        max_bytes: bound of the size of all cached arrays.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._start()

    def _start(self) -> None:
        self._process = os.getpid()
        self._lock = threading.Lock()
        self._items: OrderedDict[Hashable, Arrays] = OrderedDict()
        self._bytes = 0

    @property
    def held_bytes(self) -> int:
        """Total size of the cached arrays in bytes."""
        return self._bytes if self._process == os.getpid() else 0

    def get(self, key: Hashable, make: Callable[[], Arrays]) -> Arrays:
        """Return the arrays of `key`, making them if they are not cached; read-only, because they are shared."""
        if self._process != os.getpid():  # a lock that another thread held at the fork would never be released
            self._start()
        with self._lock:
            # The dictionary is kept in the order of use: the most recent item is the last.
            if key in self._items:
                self._items.move_to_end(key)
                return self._items[key]
        arrays = make()  # outside the lock: threads decode at the same time
        # Callers share the arrays; a write into one of them would change what the others see.
        for array in arrays:
            array.setflags(write=False)
        size = sum(array.nbytes for array in arrays)
        with self._lock:
            # Another thread may have stored the same key in the meantime. An array above the bound is returned, but
            # never kept.
            if size <= self.max_bytes and key not in self._items:
                # Drop the least recently used items before the new one is added, so that the bound holds at any time.
                while self._bytes + size > self.max_bytes:
                    _, dropped = self._items.popitem(last=False)
                    self._bytes -= sum(array.nbytes for array in dropped)
                self._items[key] = arrays
                self._bytes += size
        return arrays

    def __getstate__(self) -> dict[str, int]:
        return {"max_bytes": self.max_bytes}

    def __setstate__(self, state: dict[str, int]) -> None:
        vars(self).update(vars(ArrayCache(state["max_bytes"])))


def read_color(path: Path) -> Image:
    """Read an 8-bit RGB image; an alpha channel is dropped, not applied."""
    image = open_image(path, remedy=_REMEDY)
    return image if image.mode == "RGB" else image.convert("RGB")


def read_alpha(path: Path) -> Image:
    """Read an 8-bit mask ("L") by the meaning of its values.

    The first that holds:

    * an alpha channel, or a palette with a transparent colour (mattes, cut-outs), is the opacity, unless it is opaque
      everywhere above a picture of pure black and white, which is the mask then;
    * colours, of a palette or of pixels, are parts of a person on black: what is not black is the person;
    * values of at most 63 of 255 are ids (0 and 1, or numbers of parts), which no matte of a person has for its
      largest value: what is not 0 is the person, as the readers of such data sets take it;
    * else the brightness is the opacity, of 16 bits or of floats from 0 to 1, too.

    Warns:
        GeometryWarning: ids or colours that are taken for the person, once for a folder.
    """
    image = open_image(path, remedy=_REMEDY)
    if image.mode == "P" and "transparency" in image.info:
        image = image.convert("RGBA")
    if image.mode in ("RGBA", "LA", "PA", "La", "RGBa"):
        alpha, below = image.getchannel("A" if "A" in image.getbands() else "a"), image.convert("L")
        # A black and white picture with a channel that is opaque everywhere: a program added the channel on saving.
        black_and_white = alpha.getextrema() == (255, 255) and sum(below.histogram()[1:255]) == 0
        return below if black_and_white and below.getextrema() == (0, 255) else alpha
    if image.mode == "P" or image.mode in ("RGB", "CMYK", "YCbCr", "LAB", "HSV"):
        color = np.asarray(image.convert("RGB"))
        # Compression tints grey by a few values; colours of parts differ by far more.
        if (np.ptp(color, axis=2) > 48).mean() > 1e-3:
            _warn_of_ids(path, "colours")
            return _from_array(np.where(color.max(axis=2) > 16, 255, 0).astype(np.uint8))
        image = image.convert("L")
    values = np.asarray(image)
    if values.dtype == bool:
        return image.convert("L")
    # Data sets of human parsing know 18 (ATR) to 28 (Sapiens) parts; the mattes of a person reach 255.
    largest, largest_id = float(values.max(initial=0)), 63
    if values.dtype.kind == "f":
        values = values * (255.0 if largest <= 1.0 else 1.0)
    elif 0 < largest <= largest_id:
        _warn_of_ids(path, f"values of at most {largest:.0f}")
        values = np.where(values > 0, 255, 0)
    elif image.mode.startswith("I") and largest > 255:
        # 16-bit grey; Pillow's own conversion would clip.
        values = values / 257.0
    return image if image.mode == "L" and values.max(initial=0) == largest else _from_array(_as_bytes(values))


def _as_bytes(values: np.ndarray) -> UInt8[np.ndarray, "H W"]:
    return np.clip(values.astype(np.float64) + 0.5, 0, 255).astype(np.uint8)


def _warn_of_ids(path: Path, what: str) -> None:
    # Not the camera's own folder, so that sixty cameras say it once.
    warnings.warn(
        f"masks below {path.parent.parent}: {what} are no opacities; all that is not black is taken for the person",
        GeometryWarning,
        stacklevel=3,
    )


def read_labels(path: Path) -> Image:
    """Read an index map ("L"): the values of a grey or palette image, or of an integer `.npy`."""
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
    """Read encoded normals as 8-bit RGB, and whether the file has 16 bits (of which Pillow returns the upper 8)."""
    image = open_image(path, remedy=_REMEDY)
    return image.convert("RGB"), "16" in image.info["raw_mode"]


def check_size(image: Image, path: Path, size: tuple[int, int], *, of: str) -> Image:
    """Return the image if it has the expected width and height, its pixels as stored.

    Where only the picture that its EXIF orientation describes has that size, a quarter turn away, it is turned: then
    the calibration was made on pictures that a reader such as OpenCV's had turned.

    Raises:
        InputError: another size than expected.
    """
    if image.size != size:
        if image.size == size[::-1] and image.info.get("orientation", 1) >= 5:
            from PIL import ImageOps

            return ImageOps.exif_transpose(image)
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


@dataclass(frozen=True)
class ViewReader:
    """Reads the image files of one camera into its window.

    Attributes:
        camera: pinhole camera of the whole image on disk.
        window: shown part of the image.
        distortion: distortion of the image on disk; None for a pinhole image.
        background: (3,) colour in [0, 1] that images are composited on; None: photographs.
    """

    camera: Camera
    window: Window
    distortion: Distortion | None = None
    background: tuple[float, float, float] | None = None

    def color(self, path: Path) -> UInt8[np.ndarray, "H W 3"]:
        """Read the colours of an image into the window."""
        return self._shown(self._sized(read_color(path), path))

    def alpha(self, path: Path) -> UInt8[np.ndarray, "H W"]:
        """Read the opacity of a mask into the window."""
        return self._shown(self._sized(read_alpha(path), path))

    def labels(self, path: Path) -> UInt8[np.ndarray, "H W"]:
        """Read a label map into the window, nearest neighbour."""
        return self._shown(self._sized(read_labels(path), path), labels=True)

    def normals(self, path: Path) -> Float32[np.ndarray, "H W 3"]:
        """Read a normal map, nearest neighbour, because an average over an edge is not a normal."""
        image, deep = read_normals(path)
        value = self._shown(self._sized(image, path), labels=True).astype(np.float32)
        # Of 16-bit files Pillow returns the upper byte; the middle of its range is off by at most 0.2 degrees.
        normal = (value + 0.5) / 128.0 - 1.0 if deep else value / 127.5 - 1.0
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        seen = value.any(axis=-1, keepdims=True)
        return np.where(seen, normal / np.maximum(length, 1e-6), 0.0).astype(np.float32)

    def foreground(
        self, image_path: Path, mask_path: Path
    ) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]:
        """Read colour times opacity, (H, W, 3) uint8, and opacity, (H, W) uint8.

        The product is formed on the full image, because separate resampling would mix the background into the edges.
        """
        import PIL.Image

        image = self._sized(read_color(image_path), image_path)
        opacity = self._sized(read_alpha(mask_path), mask_path)
        # Photographs: multiply by opacity. Images on a colour c already are F + (1 - a) c: subtract the second term.
        if self.background is None:
            product = PIL.Image.new("RGB", image.size)
            box = opacity.getbbox()
            if box is not None:
                product.paste(image.crop(box), box, mask=opacity.crop(box))
            image = product
        else:
            self._check_background(image, opacity, image_path)
            if any(self.background):
                # Compositing is C = a F + (1 - a) c. The product a F is what remains without the background; 0.5 rounds
                # on truncation.
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
        # For a smaller window the distorted image is downsampled first, so that the bilinear look-up skips no pixel.
        # The distortion acts on the plane z = 1, which does not depend on the resolution.
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
        """Refuse an image that is not on the declared colour, because compositing would be silently wrong.

        The median colour outside of the mask may differ by 16 of 255; JPEG differs by about 1.
        """
        # The nearest pixels of a grid of 128 x 128 suffice for a median.
        from PIL.Image import Resampling

        grid = (min(image.width, 128), min(image.height, 128))
        coarse, share = (np.asarray(i.resize(grid, Resampling.NEAREST)) for i in (image, opacity))
        outside = coarse[share == 0]
        if not len(outside):
            return
        found = np.median(outside, axis=0)
        declared = np.asarray(self.background) * 255.0
        if np.abs(found - declared).max() > 16:
            raise InputError(
                f"image file {path}",
                expected=f"an image composited on RGB {declared.round().astype(int).tolist()}, as the capture declares",
                received=f"RGB {found.astype(int).tolist()} outside the mask",
                remedy='photographs are declared with `"background": null` in capture.json',
            )
