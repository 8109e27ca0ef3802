"""Masks of a capture: folders of mattes matched to images by name, and mattes from an ONNX model of the user."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from smplxpp.capture.capture import Capture
from smplxpp.capture.files import IMAGE_SUFFIXES, FileSeries, subfolders
from smplxpp.capture.recording import Recording
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.files.onnx_file import OnnxModel


def with_masks(recording: Recording, folder: Path) -> Recording:
    """Return the recording with masks from `folder` only.

    A matte belongs to the image of the same name, with or without a suffix (`IMAGE.png`, `IMAGE_alpha.png`), else to
    the frame whose number ends its name (`CAM_mask000012.png`, `000012.png`). Mattes are in a folder for each camera,
    or all in one folder with names that start with the camera's name. The alpha channel of a file is taken if it has
    one (cut-outs), else its brightness.

    Raises:
        InputError: no such folder, or no matte of any image.
    """
    if not folder.is_dir():
        raise InputError("folder of masks", expected="an existing folder", received=str(folder))
    images = recording.files.get("image", {})
    # Mattes in a folder for each camera, or all in one folder with the camera's name in front.
    inside = set(subfolders(folder))
    masks = {}
    for camera, series in images.items():
        place = folder / camera if camera in inside else folder
        found = _match(place, camera, series, shared=camera not in inside)
        if found:
            masks[camera] = FileSeries.from_names(place, found)
    if not masks:
        first = next(iter(images.values()), None)
        example = "none" if first is None else first.required(int(first.numbers[0])).stem
        raise InputError(
            f"folder of masks {folder}",
            expected=f"mattes named as the images, such as {next(iter(images), 'CAM')}/{example}.png",
            received=", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "nothing",
        )
    return replace(recording, files={**recording.files, "mask": masks})


def _match(folder: Path, camera: str, images: FileSeries, *, shared: bool) -> dict[int, str]:
    """Return the file name of the matte of each frame; in a shared folder names start with the camera's name."""
    # The stem of each image, with which mattes of most tools share their name.
    by_stem = {images.required(int(number)).stem: int(number) for number in images.numbers}
    known = set(by_stem.values())
    found: dict[int, str] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.name.startswith("."):
            continue
        own = path.stem
        if shared:
            # "cam1" must not match files of "cam10".
            named = re.match(rf"{re.escape(camera)}(?!\d)", own)
            if not named:
                continue
            own = own[named.end() :]
        # First by the image's name, else by the last number after the camera's name, if a frame has it.
        frame = _by_image(path.stem, by_stem)
        if frame is None:
            numbers = re.findall(r"\d+", own)
            frame = int(numbers[-1]) if numbers and int(numbers[-1]) in known else None
        if frame is not None:
            # Sorted names: with several mattes of a frame the first in alphabetical order counts.
            found.setdefault(frame, path.name)
    return found


def _by_image(stem: str, by_stem: Mapping[str, int]) -> int | None:
    """Return the frame of the image with this name, or with this name up to a `.`, `_` or `-`."""
    while stem not in by_stem:
        shorter = re.sub(r"[._-][^._-]*$", "", stem)
        if shorter == stem:
            return None
        stem = shorter
    return by_stem[stem]


# Pixels of the sides of a model's input: of a free one, and the largest accepted.
_FREE_SIDE, _MAX_SIDE = 1024, 8192
_FLOATS: dict[str, type[np.floating]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


@dataclass(frozen=True)
class MattingConfig:
    """Preprocessing of images for a matting model.

    Attributes:
        mean: (3,) of the normalisation `(rgb - mean) / std` with rgb in [0, 1]. The default is that of ImageNet, with
            which BiRefNet, ISNet's descendants and most others were trained.
        std: (3,) of the same normalisation.
        threads: number of threads of the computation.
    """

    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    threads: int = 2


class MattingModel:
    """An ONNX model of the user that takes a (1, 3, H, W) float image; its first output of H x W values is the matte.

    Values of the matte are opacities if they lie in [0, 1], otherwise logits. The image is stretched to the model's
    input (1024 x 1024 if that is free), and the matte is stretched back.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such file, not a model, or one with another input.
    """

    def __init__(self, path: str | Path, config: MattingConfig | None = None) -> None:
        self.config = config or MattingConfig()
        self._model = OnnxModel(path, kind="matting model", extra="matting", threads=self.config.threads)
        self._subject = self._model.subject
        entries = self._model.inputs
        # A fixed input size is the model's own; free sides become 1024 pixels.
        sizes = [self._size_of(entry) for entry in entries]
        if len(sizes) != 1 or sizes[0] is None:
            raise InputError(
                self._subject,
                expected=f"one input of floats of shape (1, 3, H, W), sides of at most {_MAX_SIDE}",
                received=f"{[(one.name, one.type, one.shape) for one in entries]}"[:400],
            )
        self._name, self._dtype, self._size = entries[0].name, _FLOATS[entries[0].type], sizes[0]

    @staticmethod
    def _size_of(entry: Any) -> tuple[int, int] | None:
        """Return width and height of an input; None if it is no image of floats. Symbolic sides are free."""
        if entry.type not in _FLOATS or len(entry.shape) != 4:
            return None
        batch, channels, *sides = entry.shape
        height, width = (side if isinstance(side, int) else _FREE_SIDE for side in sides)
        wanted = (not isinstance(batch, int) or batch == 1) and (not isinstance(channels, int) or channels == 3)
        return (width, height) if wanted and min(height, width) > 0 and max(height, width) <= _MAX_SIDE else None

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        """Return the opacity of the person in an sRGB image."""
        from PIL import Image
        from PIL.Image import Resampling

        # Resize, normalise by mean and standard deviation of ImageNet (or those given), and reorder to (1, 3, H, W).
        small = np.asarray(Image.fromarray(image).resize(self._size, Resampling.BILINEAR), dtype=np.float32) / 255.0
        tensor = ((small - np.array(self.config.mean, np.float32)) / np.array(self.config.std, np.float32)).transpose(
            2, 0, 1
        )[None]
        outputs = self._model.run({self._name: tensor.astype(self._dtype)})
        # The matte has the model's size; bring it back to the photograph's.
        matte = self._opacity(outputs)
        back = Image.fromarray(matte).resize((image.shape[1], image.shape[0]), Resampling.BILINEAR)
        # Add one half before the conversion, which truncates.
        return np.clip(np.asarray(back) * 255.0 + 0.5, 0, 255).astype(np.uint8)

    def _opacity(self, outputs: list[Any]) -> np.ndarray:
        """Return the first matte among the outputs as opacities, (H, W) float32 in [0, 1]."""
        # Models return several scales and auxiliary outputs; the first of the input's size is the matte.
        arrays = [o for o in outputs if isinstance(o, np.ndarray) and o.dtype.kind in "fiub"]
        mattes = [o.astype(np.float32) for o in arrays if o.ndim >= 2 and o.size == self._pixels]
        if not mattes or not np.isfinite(mattes[0]).all():
            raise InputError(
                self._subject,
                expected=f"an output of {self._size[1]} x {self._size[0]} finite values",
                received=f"NaN or infinity in {mattes[0].size}" if mattes else f"shapes {[o.shape for o in arrays]}",
            )
        matte = mattes[0].reshape(self._size[1], self._size[0])
        # Within [0, 1], up to rounding in half precision, values are opacities.
        inside = matte.min() >= -1e-3 and matte.max() <= 1.0 + 1e-3
        # Other values are logits, whose sigmoid is the opacity; at +-30 it is 0 or 1 in single precision.
        return np.clip(matte, 0.0, 1.0) if inside else 1.0 / (1.0 + np.exp(-np.clip(matte, -30, 30)))

    @property
    def _pixels(self) -> int:
        return self._size[0] * self._size[1]


def matte_path(folder: str | Path, camera: str, frame: int) -> Path:
    """Return the path of the matte of a view in a folder of masks."""
    return Path(folder) / camera / f"{camera}_mask{frame:06d}.png"


def write_mattes(
    capture: Capture,
    model: Callable[[UInt8[np.ndarray, "H W 3"]], UInt8[np.ndarray, "H W"]],
    folder: str | Path,
    *,
    views: Iterable[tuple[str, int]] | None = None,
) -> Iterator[Path]:
    """Write the mattes of a capture's views, `folder/CAM/CAM_maskFFFFFF.png`, and keep those that exist.

    The files are in the pixels of the images on disk; open the capture with `masks=folder` to use them.

    Args:
        capture: capture at full size; distorted images are matted without undistortion.
        model: function from an sRGB image to the opacity of the person, such as a `MattingModel`.
        folder: folder of the mattes.
        views: pairs (camera, frame); None: every image.

    Yields:
        The path of each matte after it is written, so that the caller can show progress.
    """
    from PIL import Image

    from smplxpp.capture.views import read_color

    for camera, frame in capture.views() if views is None else views:
        target = matte_path(folder, camera, frame)
        if not target.is_file():
            image = np.asarray(read_color(capture.required_file(camera, frame)))
            # Write through a temporary file: an interrupted run must not leave half a matte that the next run would
            # keep.
            with atomic_path(target) as temporary:
                Image.fromarray(model(image)).save(temporary, format="PNG")
        yield target
