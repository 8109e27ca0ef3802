"""Keypoints of a capture: `keypoints/CAM.npz`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from smplxpp.capture.writers.arrays import save_compact
from smplxpp.core.keypoints import Keypoints2D

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
