"""Write parameters, meshes and keypoints of a capture as compact npz files."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from smplxpp.core import ARRAY_NAMES, BodyParams, InputError, Keypoints2D
from smplxpp.core.files import atomic_path, write_arrays

QUANTUM = 2.0**-14
"""Metres (0.06 mm) to which coordinates of true meshes are rounded, because they then compress better."""


def rounded(vertices: Float[np.ndarray, "*V 3"]) -> Float[np.ndarray, "*V 3"]:
    """Round coordinates to multiples of `QUANTUM`, as they are stored."""
    return np.round(vertices / QUANTUM) * QUANTUM


def save_compact(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write an npz file with LZMA in column order, two thirds the size of deflate; `np.load` reads it."""
    write_arrays(path, {name: np.asfortranarray(value) for name, value in arrays.items()}, packing=zipfile.ZIP_LZMA)


def save_params_by_row(path: Path, params: Mapping[int, BodyParams]) -> None:
    """Write parameters with frame n in row n; rows of other frames are NaN, which only makes these frames empty."""
    # 14 hours at 20 frames per second, two gigabytes.
    max_rows = 1_000_000
    joined = BodyParams.concatenate(list(params.values()))
    rows = np.array(list(params))
    if rows.max() >= max_rows:
        raise InputError(
            "parameters of the capture",
            expected=f"frames numbered below {max_rows}: their row is the frame's number",
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


def write_keypoints(path: Path, keypoints: Keypoints2D, extra: Mapping[str, np.ndarray] | None = None) -> None:
    """Write the keypoints of one camera, rounded to 1/16 pixel; a confidence above 0 stays above 0.

    Args:
        path: path of the npz file.
        keypoints: keypoints of the camera.
        extra: further arrays for the file, which readers of keypoints ignore.
    """
    # Rounding is far below the accuracy of detectors, and halves the size of the file.
    pixel, confidence_step = 2.0**-4, 2.0**-7
    points = np.round(keypoints.points / pixel) * pixel
    confidence = np.round(keypoints.confidence / confidence_step) * confidence_step
    confidence = np.where(keypoints.confidence > 0, np.maximum(confidence, confidence_step), 0.0)
    table = np.concatenate([points, confidence[..., None]], axis=2).astype(np.float32)
    names = np.array(keypoints.names, dtype=str)
    save_compact(path, {"keypoints": table, "joint_names": names, "frames": keypoints.frames, **(extra or {})})
