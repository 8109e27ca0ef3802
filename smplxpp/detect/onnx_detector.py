"""Any keypoint model in ONNX that looks at one person's box: RTMPose, ViTPose, HRNet, Sapiens; the user's own file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from smplxpp.body.keypoint_names import BY_COUNT, Order
from smplxpp.core.errors import InputError
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.files.paths import read_bytes
from smplxpp.detect.detector import Box, DetectedPerson, inside
from smplxpp.detect.model_card import ModelCard, card_identity, card_path, load_card
from smplxpp.detect.onnx_outputs import points_of

_LARGEST_SIDE = 8192
_FLOATS: dict[str, type[np.floating]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
# Points of somebody: fewer that are sure are a model's guesses at nobody.
_LEAST_POINTS = 3


class OnnxDetector:
    """A top-down model: it takes (1, 3, H, W) floats and gives simcc rows or heatmaps of one person.

    The box (or the whole image) is enlarged, brought to the input's proportions and drawn into it as mmpose does.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such file, not a model, one with another input, a damaged card.
    """

    def __init__(self, path: str | Path, card: ModelCard | None = None, *, threads: int = 2) -> None:
        path = Path(path)
        self._model = OnnxModel(path, kind="keypoint model", extra="matting", threads=threads)
        self.card = load_card(path) if card is None else card
        entries = self._model.inputs
        sizes = [_size_of(entry, self.card.size) for entry in entries]
        if len(sizes) != 1 or sizes[0] is None:
            raise InputError(
                self._model.subject,
                expected=f"one input of floats of shape (1, 3, H, W), sides of at most {_LARGEST_SIDE}",
                received=f"{[(one.name, one.type, one.shape) for one in entries]}"[:400],
                remedy="export one person's pose model, without a person detector and without its decoding",
            )
        self._input, self._dtype, self._size = entries[0].name, _FLOATS[entries[0].type], sizes[0]
        # One look at nothing tells how many points there are, and whether the outputs can be read.
        count = len(self._points(np.zeros((self._size[1], self._size[0], 3), dtype=np.float32)))
        order = _order(count, self.card, self._model.subject, path)
        self._kept = [k for k, name in enumerate(order) if name is not None]
        self.names = tuple(name for name in order if name is not None)
        weights = hashlib.sha256(read_bytes(path)).hexdigest()
        self.identity = f"onnx {weights} {card_identity(self.card)}"

    def __call__(self, image: UInt8[np.ndarray, "H W 3"], box: Box | None = None) -> list[DetectedPerson]:
        """The person of the box, or of the image, in a list; none where too few points are sure."""
        size = image.shape[1], image.shape[0]
        cut, per_pixel, centre = self._cut(image, (0.0, 0.0, float(size[0]), float(size[1])) if box is None else box)
        found = self._points(cut)[self._kept]
        # Centres of the model's pixels are at whole numbers, and its input's middle is half its size.
        points = (found[:, :2] - 0.5 * np.array(self._size)) * per_pixel + centre
        confidence = np.where(inside(points, size), found[:, 2], 0.0)
        if (confidence >= self.card.least_confidence).sum() < min(_LEAST_POINTS, len(confidence)):
            return []
        return [DetectedPerson(np.where(confidence[:, None] > 0, points, 0.0), confidence)]

    def _cut(
        self, image: UInt8[np.ndarray, "H W 3"], box: Box
    ) -> tuple[Float32[np.ndarray, "h w 3"], float, Float64[np.ndarray, " 2"]]:
        """The box in the model's input, pixels of the image a pixel of it, and the box's centre."""
        from PIL import Image
        from PIL.Image import Resampling, Transform

        x0, y0, x1, y1 = box
        width, height = self._size
        per_pixel = max(self.card.padding * max((x1 - x0) / width, (y1 - y0) / height), 1e-3)
        centre = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        # Pillow samples at centres at +0.5; see `__call__` for the model's.
        x, y = centre - 0.5 * per_pixel * np.array([width + 1, height + 1])
        drawn = Image.fromarray(image).transform(
            (width, height),
            Transform.AFFINE,
            (per_pixel, 0.0, x, 0.0, per_pixel, y),
            resample=Resampling.BILINEAR,
        )
        return np.asarray(drawn, dtype=np.float32), per_pixel, centre

    def _points(self, cut: Float32[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "K 3"]:
        """Points in pixels of the input."""
        card = self.card
        if card.channels == "bgr":
            cut = cut[..., ::-1]
        tensor = ((cut - np.array(card.mean, np.float32)) / np.array(card.std, np.float32)).transpose(2, 0, 1)[None]
        outputs = self._model.run({self._input: np.ascontiguousarray(tensor.astype(self._dtype))})
        return points_of(
            outputs,
            self._size,
            simcc_split=card.simcc_split,
            alignment=card.alignment,
            subject=self._model.subject,
        )


def _size_of(entry: Any, free: tuple[int, int]) -> tuple[int, int] | None:
    """Width and height that an input asks for; None where it is no image of floats. Sides that are no numbers are
    free."""
    if entry.type not in _FLOATS or len(entry.shape) != 4:
        return None
    batch, channels, *sides = entry.shape
    height, width = (side if isinstance(side, int) else free[k] for k, side in ((1, sides[0]), (0, sides[1])))
    wanted = (not isinstance(batch, int) or batch == 1) and (not isinstance(channels, int) or channels == 3)
    return (width, height) if wanted and min(height, width) > 0 and max(height, width) <= _LARGEST_SIDE else None


def _order(count: int, card: ModelCard, subject: str, path: Path) -> Order:
    """The names of a model's points."""
    order = BY_COUNT.get(count) if card.names is None else card.names
    if order is None or len(order) != count:
        expected = "one of " + ", ".join(map(str, BY_COUNT)) if card.names is None else str(len(card.names))
        raise InputError(
            subject,
            expected=f"{expected} points",
            received=str(count),
            remedy=f"name its points in {card_path(path)} (docs/detectors.md)",
        )
    return order
