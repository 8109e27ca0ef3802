"""Hold the keypoints that a detector found in the images of one camera, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core.errors import InputError, one_line


@dataclass(frozen=True, eq=False)
class Keypoints2D:
    """Keypoints of one camera in F frames; pixels of the undistorted image, centres at +0.5.

    All detectors share one vocabulary. The name of a body joint (`smplxpp.body.layout`) means the centre of that joint.
    Other landmarks have names of their own: `coco_left_hip` and similar for body points as COCO's annotators place
    them, `nose`, `left_ear`, `left_heel`, `left_big_toe`, `left_small_toe`,
    `left_index_tip` (and the other fingers), `face_17` to `face_67` for dlib's points of brows, nose, eyes and mouth.

    Attributes:
        names: of the K points, all different.
        frames: numbers of the frames, ascending.
        points: pixels; meaningless where the confidence is 0.
        confidence: 0 (not seen) to 1.

    Raises:
        InputError: shapes that do not match, duplicate names or frames, confidences outside [0, 1], or points that are
            not finite although their confidence is above 0.
    """

    names: tuple[str, ...]
    frames: Int64[np.ndarray, " F"]
    points: Float64[np.ndarray, "F K 2"]
    confidence: Float64[np.ndarray, "F K"]

    __repr__ = one_line

    def __post_init__(self) -> None:
        frames = np.asarray(self.frames, dtype=np.int64).reshape(-1)
        # Copies, because the coordinates of missing points are overwritten below.
        points, confidence = np.array(self.points, dtype=np.float64), np.array(self.confidence, dtype=np.float64)
        shape = (len(frames), len(self.names))
        if points.shape != (*shape, 2) or confidence.shape != shape:
            raise InputError(
                "keypoints",
                expected=f"points of shape {(*shape, 2)} and confidences of shape {shape}",
                received=f"{points.shape} and {confidence.shape}",
            )
        if len(set(self.names)) < len(self.names) or (np.diff(frames) <= 0).any():
            raise InputError("keypoints", expected="every name once, frames ascending", received="some twice")
        if not ((confidence >= 0) & (confidence <= 1)).all():
            raise InputError(
                "keypoints",
                expected="confidences from 0 to 1",
                received=f"{np.nanmin(confidence):g} to {np.nanmax(confidence):g}",
            )
        if not np.isfinite(points[confidence > 0]).all():
            raise InputError("keypoints", expected="finite pixels where the confidence is above 0", received="others")
        # Coordinates of missing points may be NaN in files; zero keeps later arithmetic finite.
        points[confidence == 0] = 0.0
        object.__setattr__(self, "frames", frames)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "confidence", confidence)

    def select(self, names: Sequence[str], frames: Sequence[int]) -> Keypoints2D:
        """Return the keypoints with these names and frames, in this order; missing ones have confidence 0."""
        columns, rows = {n: k for k, n in enumerate(self.names)}, {int(f): k for k, f in enumerate(self.frames)}
        points, confidence = np.zeros((len(frames), len(names), 2)), np.zeros((len(frames), len(names)))
        # Rows and columns that exist on both sides; the others stay at zero confidence.
        to_row = [k for k, frame in enumerate(frames) if frame in rows]
        to_column = [k for k, name in enumerate(names) if name in columns]
        source = np.ix_([rows[frames[k]] for k in to_row], [columns[names[k]] for k in to_column])
        points[np.ix_(to_row, to_column)] = self.points[source]
        confidence[np.ix_(to_row, to_column)] = self.confidence[source]
        return replace(
            self, names=tuple(names), frames=np.asarray(frames, dtype=np.int64), points=points, confidence=confidence
        )
