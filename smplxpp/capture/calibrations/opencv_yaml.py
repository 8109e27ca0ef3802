"""Read the YAML of `cv2.FileStorage`, which YAML libraries refuse."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_text

_KEY = re.compile(r"^(?P<key>[^\s:#%-][^:]*):\s*(?P<value>.*)$")


def read_opencv_yaml(path: Path) -> dict[str, np.ndarray | list[str] | float | str]:
    """Read a YAML file of `cv2.FileStorage`: matrices as float64 arrays, lists of texts, and numbers by name.

    Only the subset of calibration files is read: entries at the top level.

    Raises:
        InputError: a missing file, not a text, or a matrix whose numbers do not match its size.
    """
    lines = read_text(path).splitlines()
    # `cv2.FileStorage` writes "%YAML:1.0" and "!!opencv-matrix", which YAML libraries refuse; hence our own parser.
    blocks: dict[str, list[str]] = {}
    current: list[str] | None = None
    for line in lines:
        if match := _KEY.match(line):
            current = blocks.setdefault(match["key"].strip().strip('"'), [])
            current.append(match["value"].strip())
        elif current is not None and line.strip() and not line.startswith(("%", "---")):
            current.append(line.strip())
    return {key: _value(key, block, path) for key, block in blocks.items()}


def _value(key: str, block: list[str], path: Path) -> np.ndarray | list[str] | float | str:
    # The four forms that occur: an OpenCV matrix, a scalar, a list in brackets, and a list of dashed lines.
    if block[0].startswith("!!opencv-matrix"):
        return _matrix(key, " ".join(block[1:]), path)
    if len(block) == 1 and block[0] and not block[0].startswith("["):
        try:
            return float(block[0])
        except ValueError:
            return block[0].strip('"')
    if block[0].startswith("["):
        items = " ".join(block).strip("[] ").split(",")
    else:
        items = [line.removeprefix("-") for line in block if line.startswith("-")]
    return [item.strip().strip('"') for item in items if item.strip()]


def _matrix(key: str, text: str, path: Path) -> np.ndarray:
    size = {name: re.search(rf"{name}:\s*(\d+)", text) for name in ("rows", "cols")}
    data = re.search(r"data:\s*\[([^\]]*)\]", text)
    rows, cols = size["rows"], size["cols"]
    try:
        if data is None or rows is None or cols is None:
            raise ValueError("one of them is missing")
        # OpenCV writes `.Nan` and `.Inf`, which float() reads without the dot.
        values = [float(re.sub(r"\.(?=[NI])", "", item)) for item in data[1].split(",")]
        return np.array(values).reshape(int(rows[1]), int(cols[1]))
    except ValueError as error:
        raise InputError(
            f"file {path}: {key}", expected="rows, cols and as many numbers in data", received=str(error)
        ) from None
