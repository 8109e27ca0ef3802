"""Detect keypoints with a top-down model in ONNX that the user provides, such as RTMPose, ViTPose, HRNet or Sapiens."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from smplxpp.body.layout import BY_COUNT, Order
from smplxpp.core.errors import InputError
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.files.paths import read_bytes
from smplxpp.detect.detector import Box, DetectedPerson, inside
from smplxpp.detect.model_card import LARGEST_SIDE, ModelCard, card_identity, card_path, load_card

_FLOATS: dict[str, type[np.floating]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class OnnxDetector:
    """Detector by a top-down model, which takes (1, 3, H, W) floats and gives simcc rows or heatmaps of one person.

    The person's box (or the whole image) is enlarged to the proportions of the input and resampled as mmpose does.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such file, no model, a model with another kind of input, or a damaged card.
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
                expected=f"one input of floats of shape (1, 3, H, W), sides of at most {LARGEST_SIDE}",
                received=f"{[(one.name, one.type, one.shape) for one in entries]}"[:400],
                remedy="export one person's pose model, without a person detector and without its decoding",
            )
        self._input, self._dtype, self._size = entries[0].name, _FLOATS[entries[0].type], sizes[0]
        # A run on a black image gives the number of points, and fails if the outputs cannot be interpreted.
        count = len(self._points(np.zeros((self._size[1], self._size[0], 3), dtype=np.float32)))
        order = _order(count, self.card, self._model.subject, path)
        self._kept = [k for k, name in enumerate(order) if name is not None]
        self.names = tuple(name for name in order if name is not None)
        weights = hashlib.sha256(read_bytes(path)).hexdigest()
        self.identity = f"onnx {weights} {card_identity(self.card)}"

    def __call__(self, image: UInt8[np.ndarray, "H W 3"], box: Box | None = None) -> list[DetectedPerson]:
        """Return the person in the box, or in the image, as a list; empty if fewer than three points are reliable."""
        size = image.shape[1], image.shape[0]
        cut, per_pixel, centre = self._cut(image, (0.0, 0.0, float(size[0]), float(size[1])) if box is None else box)
        found = self._points(cut)[self._kept]
        # In the model's convention pixel centres are whole numbers, and half of its size is the centre of the box.
        points = (found[:, :2] - 0.5 * np.array(self._size)) * per_pixel + centre
        confidence = np.where(inside(points, size), found[:, 2], 0.0)
        if (confidence >= self.card.least_confidence).sum() < min(3, len(confidence)):
            return []
        return [DetectedPerson(np.where(confidence[:, None] > 0, points, 0.0), confidence)]

    def _cut(
        self, image: UInt8[np.ndarray, "H W 3"], box: Box
    ) -> tuple[Float32[np.ndarray, "h w 3"], float, Float64[np.ndarray, " 2"]]:
        """Resample a box to the model's input; return it, the scale in image pixels a pixel, and the box's centre."""
        from PIL import Image
        from PIL.Image import Resampling, Transform

        x0, y0, x1, y1 = box
        width, height = self._size
        per_pixel = max(self.card.padding * max((x1 - x0) / width, (y1 - y0) / height), 1e-3)
        centre = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        # Pillow puts pixel centres at +0.5, the model at whole numbers (see `__call__`).
        x, y = centre - 0.5 * per_pixel * np.array([width + 1, height + 1])
        drawn = Image.fromarray(image).transform(
            (width, height),
            Transform.AFFINE,
            (per_pixel, 0.0, x, 0.0, per_pixel, y),
            resample=Resampling.BILINEAR,
        )
        return np.asarray(drawn, dtype=np.float32), per_pixel, centre

    def _points(self, cut: Float32[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "K 3"]:
        """Run the model and return points with confidences, in pixels of the input."""
        card = self.card
        # The normalisation is stated in the order of the model's channels, so that channels are exchanged first.
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
    """Return the width and height of a model's input; None if it is no image of floats.

    Sides that the model leaves free are taken from `free`.
    """
    if entry.type not in _FLOATS or len(entry.shape) != 4:
        return None
    batch, channels, *sides = entry.shape
    height, width = (side if isinstance(side, int) else free[k] for k, side in ((1, sides[0]), (0, sides[1])))
    wanted = (not isinstance(batch, int) or batch == 1) and (not isinstance(channels, int) or channels == 3)
    return (width, height) if wanted and min(height, width) > 0 and max(height, width) <= LARGEST_SIDE else None


def _order(count: int, card: ModelCard, subject: str, path: Path) -> Order:
    """Return the names of a model's points, from its card or by their number."""
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


def points_of(
    outputs: Sequence[Any],
    size: tuple[int, int],
    *,
    simcc_split: float | None = None,
    alignment: str = "stride",
    subject: str = "keypoint model",
) -> Float64[np.ndarray, "K 3"]:
    """Decode a model's outputs: points in pixels of its input, centres at whole numbers, and confidences in [0, 1].

    Two outputs of shape (1, K, bins) are simcc's x and y (Li et al. 2022); one of shape (1, K, h, w) holds heatmaps.
    The confidence of a simcc point is the smaller of its two maxima, as in mmpose.

    Args:
        outputs: of the model.
        size: width and height of the model's input.
        simcc_split: bins a pixel; None for the number of bins over the size.
        alignment: see `ModelCard`.
        subject: of error messages.

    Raises:
        InputError: outputs of another kind, or values that are not finite.
    """
    # Simcc if there is a pair of matching outputs, else the first heatmaps.
    arrays = [np.asarray(one) for one in outputs if isinstance(one, np.ndarray) and one.dtype.kind == "f"]
    rows = [one for one in arrays if one.ndim == 3 and one.shape[0] == 1]
    maps = [one for one in arrays if one.ndim == 4 and one.shape[0] == 1]
    pair = _simcc_pair(rows, size, simcc_split)
    if pair is not None:
        finite(pair, subject)
        return _from_simcc(pair[0][0], pair[1][0], size, simcc_split)
    if maps:
        finite(maps[:1], subject)
        return _from_heatmaps(maps[0][0], size, alignment)
    raise InputError(
        subject,
        expected="two outputs (1, K, bins) of simcc with bins in proportion to the input, or heatmaps (1, K, h, w)",
        received=f"{[tuple(np.shape(one)) for one in outputs]}"[:300],
    )


def finite(arrays: Sequence[np.ndarray], subject: str) -> None:
    """Refuse outputs with NaN or infinity."""
    if not all(np.isfinite(one).all() for one in arrays):
        raise InputError(subject, expected="finite outputs", received="NaN or infinity")


def _simcc_pair(
    rows: Sequence[np.ndarray], size: tuple[int, int], split: float | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the outputs of x and y: equal numbers of points, bins in proportion to the input's sides (2 %)."""
    for first in rows:
        for second in rows:
            if first is second or first.shape[1] != second.shape[1]:
                continue
            bins_x, bins_y = first.shape[2], second.shape[2]
            splits = bins_x / size[0], bins_y / size[1]
            if abs(splits[0] - splits[1]) < 0.02 * splits[0] and (
                split is None or abs(splits[0] - split) < 0.02 * split
            ):
                return first, second
    return None


def _from_simcc(
    x: Float[np.ndarray, "K X"], y: Float[np.ndarray, "K Y"], size: tuple[int, int], split: float | None
) -> Float64[np.ndarray, "K 3"]:
    """Decode rows of bins, whose maxima are the coordinates."""
    split = split or x.shape[1] / size[0]
    u, v = (_peak(one.astype(np.float64)) / split for one in (x, y))
    score = np.minimum(x.max(axis=1), y.max(axis=1)).astype(np.float64)
    return np.column_stack([u, v, np.clip(score, 0.0, 1.0)])


def _from_heatmaps(
    maps: Float[np.ndarray, "K h w"], size: tuple[int, int], alignment: str
) -> Float64[np.ndarray, "K 3"]:
    """Decode heatmaps: the largest cell, refined along its row and its column."""
    count, height, width = maps.shape
    flat = maps.reshape(count, -1).astype(np.float64)
    row, column = np.divmod(flat.argmax(axis=1), width)
    values = maps.astype(np.float64)
    u = _peak(values[np.arange(count), row, :])
    v = _peak(values[np.arange(count), :, column])
    if alignment == "corners":
        scale = (size[0] - 1) / max(width - 1, 1), (size[1] - 1) / max(height - 1, 1)
    else:
        scale = size[0] / width, size[1] / height
    return np.column_stack([u * scale[0], v * scale[1], np.clip(flat.max(axis=1), 0.0, 1.0)])


def _peak(rows: Float64[np.ndarray, "K N"]) -> Float64[np.ndarray, " K"]:
    """Return the position of each row's maximum to a fraction of a cell.

    It is the vertex of the parabola through the logarithms of three cells, which is exact for a Gaussian.
    """
    floor = 1e-6  # smallest value of a cell and smallest curvature
    at = rows.argmax(axis=1)
    count, width = rows.shape
    inner = (at > 0) & (at < width - 1)
    middle = np.clip(at, 1, max(width - 2, 1))
    if width < 3:
        return at.astype(np.float64)
    three = np.log(np.maximum(np.stack([rows[np.arange(count), middle + k] for k in (-1, 0, 1)]), floor))
    bend = three[0] - 2.0 * three[1] + three[2]
    shift = np.where(bend < -floor, 0.5 * (three[0] - three[2]) / np.minimum(bend, -floor), 0.0)
    return at + np.where(inner, np.clip(shift, -0.5, 0.5), 0.0)
