"""Training views of a capture: composited colour, opacity, normals, and the camera of the cropped part."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float16, Float32, UInt8
from torch import Tensor

from smplxpp.capture import Capture
from smplxpp.core import Camera, GeometryWarning, InputError
from smplxpp.core.errors import one_line


@dataclass(frozen=True, eq=False)
class View:
    """A camera's image of one frame, on the CPU or a GPU, in 8 bits until it is used.

    Attributes:
        camera: of these pixels.
        foreground: sRGB times opacity.
        alpha: opacity of the person.
        normals: world normals in half precision, 0 on the background; None where the capture has none.
    """

    camera: Camera
    foreground: UInt8[Tensor, "H W 3"]
    alpha: UInt8[Tensor, "H W"]
    normals: Float16[Tensor, "H W 3"] | None = None

    __repr__ = one_line

    @property
    def name(self) -> str:
        """Return the name of the view's camera."""
        return self.camera.name

    @cached_property
    def viewmat(self) -> Float32[Tensor, "4 4"]:
        """Transform from the world to the camera."""
        return torch.tensor(self.camera.cam_from_world, dtype=torch.float32, device=self.alpha.device)

    @cached_property
    def K(self) -> Float32[Tensor, "3 3"]:
        """Intrinsics of the camera in pixels, the matrix K."""
        return torch.tensor(self.camera.K, dtype=torch.float32, device=self.alpha.device)

    @cached_property
    def position(self) -> Float32[Tensor, " 3"]:
        """Centre of projection in the world, metres."""
        return torch.tensor(self.camera.position, dtype=torch.float32, device=self.alpha.device)

    def opacity(self) -> Float32[Tensor, "H W"]:
        """Return the opacity in [0, 1]."""
        return self.alpha / 255.0

    def composited(self, background: Float[Tensor, " 3"]) -> Float32[Tensor, "H W 3"]:
        """Return sRGB in [0, 1] on a background B: `F + (1 - a) B`."""
        # Foregrounds are premultiplied by opacity, so that only the background is weighted here.
        return self.foreground / 255.0 + (1.0 - self.opacity())[..., None] * background

    def photograph(self, background: Sequence[float]) -> UInt8[np.ndarray, "H W 3"]:
        """Return the image composited on a background, in 8 bits."""
        return (self.composited(torch.tensor(background, dtype=torch.float32)) * 255.0).round().to(torch.uint8).numpy()

    def cropped(self, margin: int) -> View:
        """Crop to the silhouette's bounding box and `margin` pixels around it; the principal point moves with it.

        Steps are cheap because only the person is rasterised and compared.
        """
        # Bounding box of the mask with a margin, inside the image.
        rows, columns = (torch.nonzero(self.alpha.any(dim)).flatten() for dim in (1, 0))
        if not len(rows):
            return self
        top, bottom = max(int(rows[0]) - margin, 0), min(int(rows[-1]) + margin + 1, self.camera.height)
        left, right = max(int(columns[0]) - margin, 0), min(int(columns[-1]) + margin + 1, self.camera.width)
        camera = self.camera.cropped((left, top, right, bottom))
        part = (slice(top, bottom), slice(left, right))
        normals = None if self.normals is None else self.normals[part].contiguous()
        return View(camera, self.foreground[part].contiguous(), self.alpha[part].contiguous(), normals)

    def halved(self) -> View:
        """Average every 2 x 2 pixels; a last odd row or column is left out, and normals are sampled."""
        height, width = self.camera.height // 2, self.camera.width // 2
        camera = self.camera.cropped((0, 0, 2 * width, 2 * height), size=(width, height))
        # Mean of 2 x 2 pixels of colour and opacity, rounded to 8 bits.
        stacked = torch.cat([self.foreground, self.alpha[..., None]], dim=-1)[: 2 * height, : 2 * width]
        small = stacked.view(height, 2, width, 2, 4).float().mean(dim=(1, 3)).round().to(torch.uint8)
        normals = None if self.normals is None else self.normals[: 2 * height : 2, : 2 * width : 2].contiguous()
        return View(camera, small[..., :3].contiguous(), small[..., 3].contiguous(), normals)

    def to(self, device: torch.device | str) -> View:
        """Return the same view on another device; a GPU is not waited for where its memory is pinned."""
        return self._with(lambda pixels: pixels.to(device, non_blocking=True))

    def pinned(self) -> View:
        """Return the same view in memory that a GPU reads by itself."""
        return self._with(torch.Tensor.pin_memory)

    def _with(self, change: Callable[[Tensor], Tensor]) -> View:
        normals = None if self.normals is None else change(self.normals)
        changed = View(self.camera, change(self.foreground), change(self.alpha), normals)
        # All numbers of the camera in one copy.
        numbers = change(self._numbers)
        viewmat, K, position = numbers.split([16, 9, 3])
        vars(changed).update(_numbers=numbers, viewmat=viewmat.view(4, 4), K=K.view(3, 3), position=position)
        return changed

    @cached_property
    def _numbers(self) -> Float32[Tensor, " 28"]:
        camera = self.camera
        parts = (camera.cam_from_world.ravel(), camera.K.ravel(), camera.position)
        return torch.tensor(np.concatenate(parts), dtype=torch.float32, device=self.alpha.device)


def read_view(capture: Capture, camera: str, frame: int, *, normals: bool = False) -> View:
    """Read the whole image of a camera, composited as the capture says, with its normal map if requested and present.

    Raises:
        InputError: an unknown camera, a damaged image or one of another size than its camera's, or no mask.
    """
    # `np.array` copies: the tensors must not share memory with the images that the capture caches.
    foreground, alpha = capture.foreground(camera, frame)
    normal_map = capture.normals(camera, frame) if normals else None
    return View(
        capture.cameras[camera],
        torch.tensor(np.array(foreground)),
        torch.tensor(np.array(alpha)),
        None if normal_map is None else torch.tensor(np.array(normal_map), dtype=torch.float16),
    )


def read_views(capture: Capture, frame: int, cameras: Iterable[str]) -> list[View]:
    """Read whole images of a frame, composited as the capture says; cameras without image or person are left out.

    Raises:
        InputError: an unknown camera, a damaged image or one of another size than its camera's, or no mask.
    """
    # Missing views end with a warning, but an unknown camera is an error: it is a misspelling.
    views = []
    for name in cameras:
        if name in capture.cameras and capture.file(name, frame) is None:
            warnings.warn(f"camera {name}: no image of frame {frame}; it is left out", GeometryWarning, stacklevel=2)
            continue
        if name not in capture.cameras:
            raise InputError(
                f"camera of capture {capture.name}", expected=f"one of {', '.join(capture.cameras)}", received=name
            )
        view = read_view(capture, name, frame)
        if not view.alpha.any():
            warnings.warn(
                f"camera {name}: no person in the mask of frame {frame}; it is left out", GeometryWarning, stacklevel=2
            )
            continue
        views.append(view)
    return views
