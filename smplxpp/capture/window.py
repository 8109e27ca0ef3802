"""Crop and resample images together with their cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from smplxpp.core import Camera, InputError

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True)
class Window:
    """A rectangle of the full image that is resampled to a size.

    Principal point and focal lengths follow as in `Camera.cropped`.

    Attributes:
        box: x0, y0, x1, y1 in pixels of the full image.
        width: width of the result in pixels.
        height: height of the result in pixels.
    """

    box: tuple[float, float, float, float]
    width: int
    height: int

    @staticmethod
    def full(camera: Camera) -> Window:
        """Return the window of the whole image at full resolution."""
        return Window((0.0, 0.0, float(camera.width), float(camera.height)), camera.width, camera.height)

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of the result per pixel of the full image, in x and y."""
        x0, y0, x1, y1 = self.box
        return self.width / (x1 - x0), self.height / (y1 - y0)

    def resized(self, scale: float) -> Window:
        """Return the window at `scale` times the resolution; its size is rounded, and the intrinsics follow that."""
        size = (round(self.width * scale), round(self.height * scale))
        if not scale > 0 or min(size) < 1:
            raise InputError("scale", expected="a factor that leaves at least 1 x 1 pixels", received=str(scale))
        return replace(self, width=size[0], height=size[1])

    def cropped(self, box: tuple[int, int, int, int]) -> Window:
        """Return the window of a rectangle x0, y0, x1, y1 in pixels of this window, which must contain it."""
        x0, y0, x1, y1 = map(int, box)
        if not (0 <= x0 < x1 <= self.width and 0 <= y0 < y1 <= self.height):
            raise InputError(
                "crop box",
                expected=f"x0 < x1 <= {self.width} and y0 < y1 <= {self.height}, from 0",
                received=f"{tuple(box)}",
            )
        sx, sy = self.scale
        left, top = self.box[:2]
        return Window((left + x0 / sx, top + y0 / sy, left + x1 / sx, top + y1 / sy), x1 - x0, y1 - y0)

    def camera(self, full: Camera) -> Camera:
        """Return the camera of the window's pixels."""
        return full.cropped(self.box, size=(self.width, self.height))

    def apply(self, image: Image, *, labels: bool = False) -> Image:
        """Crop and resample an image: area averages for whole reduction factors, else Lanczos; nearest for labels.

        An area average is what a coarser sensor would have measured.
        """
        from PIL.Image import Resampling

        if self == Window((0.0, 0.0, float(image.width), float(image.height)), image.width, image.height):
            return image
        # From exact to approximate: unchanged, a crop of whole pixels, means of whole blocks, and last a resampling
        # filter.
        whole_box = all(edge == int(edge) for edge in self.box)
        x0, y0, x1, y1 = self.box
        pixels = (int(x0), int(y0), int(x1), int(y1))
        if whole_box and self.scale == (1.0, 1.0):
            return image.crop(pixels)
        if whole_box and not labels and (x1 - x0) % self.width == 0 and (y1 - y0) % self.height == 0:
            factors = int(x1 - x0) // self.width, int(y1 - y0) // self.height
            return image.reduce(factors, box=pixels)
        resample = Resampling.NEAREST if labels else Resampling.LANCZOS
        return image.resize((self.width, self.height), resample, box=self.box)
