"""Landmarks that somebody placed on a scan by hand: a JSON object of points by name."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_numbers, as_object, read_json

MOST_LANDMARKS = 500
"""Names in a file."""
_LONGEST_NAME = 64
# A scan stands within a room or a stage, in metres.
_FARTHEST = 1e3


def read_landmarks(path: str | Path) -> dict[str, Float64[np.ndarray, " 3"]]:
    """Points by name, metres, +Y up: `{"nose": [0.01, 1.62, 0.11], ...}`.

    Names are those of `smplxpp.core.keypoints`: a joint's is its centre, within the limb; `nose`, `left_ear`,
    `left_heel`, `left_big_toe`, `left_index_tip`, `face_30` and the like lie on the skin.

    Raises:
        InputError: no such file, another layout, more than 500 names, or points that are not near anybody.
    """
    subject = f"landmarks {path}"
    content = as_object(read_json(path, subject="landmarks"), subject=subject)
    if len(content) > MOST_LANDMARKS or any(len(name) > _LONGEST_NAME for name in content):
        raise InputError(
            subject,
            expected=f"at most {MOST_LANDMARKS} names of at most {_LONGEST_NAME} letters",
            received=f"{len(content)} names, the longest of {max(map(len, content))} letters",
        )
    points = {name: as_numbers(point, (3,), subject=f"{subject}: {name}") for name, point in content.items()}
    far = [name for name, point in points.items() if np.abs(point).max() > _FARTHEST]
    if far:
        raise InputError(
            f"{subject}: {far[0]}",
            expected="a point in metres, as the scan has them once it is read",
            received=f"{np.array2string(points[far[0]], precision=1)}",
            remedy="place it in `smplxpp label RUN`, or divide by the scan's units",
        )
    return points


def write_landmarks(path: str | Path, points: Mapping[str, Float[np.ndarray, " 3"]]) -> None:
    """Write what `read_landmarks` reads, to a tenth of a millimetre, whole or not at all."""
    rows = [f"{json.dumps(name)}: {json.dumps(np.round(point, 4).tolist())}" for name, point in points.items()]
    atomic_write_text(path, "{\n " + ",\n ".join(rows) + "\n}\n" if rows else "{}\n")
