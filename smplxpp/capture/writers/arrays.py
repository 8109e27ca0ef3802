"""Arrays of a capture, packed as small as np.load can read."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import write_arrays
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.core.params import ARRAY_NAMES, BodyParams

# Coordinates of truth meshes are rounded to this many metres (0.06 mm): they compress better.
QUANTUM = 2.0**-14
# Rows of a file of parameters: 14 hours at 20 frames a second, two gigabytes.
_MOST_ROWS = 1_000_000


def rounded(vertices: Float[np.ndarray, "*V 3"]) -> Float[np.ndarray, "*V 3"]:
    """Return coordinates as they are stored: multiples of `QUANTUM`."""
    return np.round(vertices / QUANTUM) * QUANTUM


def save_compact(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write an npz file packed with LZMA, columns one after the other: two thirds of deflate; np.load reads it."""
    write_arrays(path, {name: np.asfortranarray(value) for name, value in arrays.items()}, packing=zipfile.ZIP_LZMA)


def save_params_by_row(path: Path, params: Mapping[int, BodyParams]) -> None:
    """Write parameters so that row n is frame n; NaN where a frame has none, which spoils that frame alone."""
    joined = BodyParams.concatenate(list(params.values()))
    rows = np.array(list(params))
    if rows.max() >= _MOST_ROWS:
        raise InputError(
            "parameters of the capture",
            expected=f"frames numbered below {_MOST_ROWS}: their row is the frame's number",
            received=f"frame {rows.max()}",
            remedy="number the frames from 0",
        )
    arrays: dict[str, np.ndarray] = {"flat_hand_mean": np.array(joined.flat_hand_mean, dtype=bool)}
    for name in ARRAY_NAMES:
        values = getattr(joined, name)
        arrays[name] = np.full((rows.max() + 1, values.shape[1]), np.nan)
        arrays[name][rows] = values
    arrays |= joined.offsets_by_row(rows)
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]  # numpy: the names might be `allow_pickle`


# Pixels and confidences are rounded to these: far below what a detector knows, and files are half as large.
_PIXEL, _CONFIDENCE = 2.0**-4, 2.0**-7


def write_keypoints(path: Path, keypoints: Keypoints2D, extra: Mapping[str, np.ndarray] | None = None) -> None:
    """Write one camera's keypoints, rounded to 1/16 pixel; a confidence above 0 stays above 0.

    Args:
        extra: arrays of other names that are written beside them; readers of keypoints pass over these.
    """
    points = np.round(keypoints.points / _PIXEL) * _PIXEL
    confidence = np.round(keypoints.confidence / _CONFIDENCE) * _CONFIDENCE
    confidence = np.where(keypoints.confidence > 0, np.maximum(confidence, _CONFIDENCE), 0.0)
    table = np.concatenate([points, confidence[..., None]], axis=2).astype(np.float32)
    names = np.array(keypoints.names, dtype=str)
    save_compact(path, {"keypoints": table, "joint_names": names, "frames": keypoints.frames, **(extra or {})})
