"""Masks from the user's own matting model in ONNX; none is shipped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from smplxpp.capture.capture import Capture
from smplxpp.core.atomic import atomic_path
from smplxpp.core.errors import InputError, MissingExtraError

# Side of the square that models of free input size are fed with.
_DEFAULT_SIDE = 1024


@dataclass(frozen=True)
class MattingConfig:
    """How images are put to the model.

    Attributes:
        mean, std: (3,) of the normalisation `(rgb - mean) / std` with rgb in [0, 1]; ImageNet's, as BiRefNet, ISNet's
            descendants and most others were trained with.
        threads: of the model's computation.
    """

    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    threads: int = 2


class MattingModel:
    """An ONNX model that takes a (1, 3, H, W) float image; of what it gives, the first matte of H x W values counts.

    The matte's values are read as opacities if they lie in [0, 1], otherwise as logits. The image is stretched to the
    model's input (or to 1024 x 1024 where that is free) and the matte back.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such file, not a model, or one with another input.
    """

    def __init__(self, path: str | Path, config: MattingConfig | None = None) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise MissingExtraError("onnxruntime", extra="matting", purpose="matting with an ONNX model") from None
        path = Path(path)
        if not path.is_file():
            raise InputError("matting model", expected="an existing ONNX file", received=str(path))
        self.config = config or MattingConfig()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self.config.threads
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  onnxruntime raises classes of its own for every kind of damage
            raise InputError(f"matting model {path}", expected="an ONNX model", received=f"{error}") from None
        entry = self._session.get_inputs()[0]
        if len(self._session.get_inputs()) != 1 or len(entry.shape) != 4 or entry.shape[1] not in (3, "C", None):
            raise InputError(
                f"matting model {path}",
                expected="one input of shape (1, 3, H, W)",
                received=f"{[(i.name, i.shape) for i in self._session.get_inputs()]}",
            )
        self._name = entry.name
        self._dtype = np.float16 if "float16" in entry.type else np.float32
        height, width = (side if isinstance(side, int) else _DEFAULT_SIDE for side in entry.shape[2:])
        self._size = (width, height)

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        """Return the opacity of the person in an sRGB image."""
        from PIL import Image
        from PIL.Image import Resampling

        small = np.asarray(Image.fromarray(image).resize(self._size, Resampling.BILINEAR), dtype=np.float32) / 255.0
        tensor = ((small - np.array(self.config.mean, np.float32)) / np.array(self.config.std, np.float32)).transpose(
            2, 0, 1
        )[None]
        outputs = self._session.run(None, {self._name: tensor.astype(self._dtype)})
        matte = self._opacity(outputs)
        back = Image.fromarray(matte).resize((image.shape[1], image.shape[0]), Resampling.BILINEAR)
        return np.clip(np.asarray(back) * 255.0 + 0.5, 0, 255).astype(np.uint8)

    def _opacity(self, outputs: list[Any]) -> np.ndarray:
        mattes = [np.asarray(o, dtype=np.float32) for o in outputs if np.ndim(o) >= 2 and np.size(o) == self._pixels]
        if not mattes:
            raise InputError(
                "matting model",
                expected=f"an output of {self._size[1]} x {self._size[0]} values",
                received=f"shapes {[np.shape(o) for o in outputs]}",
            )
        matte = mattes[0].reshape(self._size[1], self._size[0])
        inside = matte.min() >= -1e-3 and matte.max() <= 1.0 + 1e-3
        return np.clip(matte, 0.0, 1.0) if inside else 1.0 / (1.0 + np.exp(-np.clip(matte, -30, 30)))

    @property
    def _pixels(self) -> int:
        return self._size[0] * self._size[1]


def write_mattes(
    capture: Capture, model: MattingModel, folder: str | Path, *, views: Iterable[tuple[str, int]] | None = None
) -> Iterator[Path]:
    """Make the mattes of a capture's views, `folder/CAM/CAM_maskFFFFFF.png`; those that exist are left as they are.

    The files are in the pixels of the images on disk, as masks have to be: open the capture with `masks=folder`.

    Args:
        capture: at full size; distorted images are matted as the lens drew them.
        model: the user's.
        folder: where to.
        views: (camera, frame); None: every image there is.

    Yields:
        Each file when it stands, so that the caller can show progress.
    """
    from PIL import Image

    from smplxpp.capture.images import read_color

    for camera, frame in capture.views() if views is None else views:
        target = Path(folder) / camera / f"{camera}_mask{frame:06d}.png"
        if not target.is_file():
            image = np.asarray(read_color(capture.required_file(camera, frame)))
            with atomic_path(target) as temporary:
                Image.fromarray(model(image)).save(temporary, format="PNG")
        yield target
