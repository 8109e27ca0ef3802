"""A writer of OpenEXR pictures, by the format's own library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


def write_openexr(
    path: Path, picture: np.ndarray, *, kind: str = "zip", channels: str = "RGB", header: dict[str, Any] | None = None
) -> None:
    """Write float32 ("piz") or float16 ("zip") channels of a picture (H, W, C)."""
    import OpenEXR

    packing = {"zip": OpenEXR.ZIP_COMPRESSION, "piz": OpenEXR.PIZ_COMPRESSION}[kind]
    numbers = np.ascontiguousarray(picture, np.float16 if kind == "zip" else np.float32)
    held = {name: np.ascontiguousarray(numbers[..., k]) for k, name in enumerate(channels)}
    whole = {"compression": packing, "type": OpenEXR.scanlineimage, **(header or {})}
    with OpenEXR.File(whole, held) as file:
        file.write(str(path))
