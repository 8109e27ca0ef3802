"""Loads the package's native library (see CMakeLists.txt)."""

from __future__ import annotations

import ctypes
import sysconfig
from functools import cache
from pathlib import Path

_NAME = "smplxpp_native.so"


@cache
def native_library() -> ctypes.CDLL:
    """The compiled library; it lies beside this file, or in site-packages for an editable install."""
    candidates = [Path(__file__).parent / _NAME]
    candidates += [Path(sysconfig.get_path(key)) / "smplxpp" / "raster" / _NAME for key in ("platlib", "purelib")]
    for path in candidates:
        if path.exists():
            return ctypes.CDLL(str(path))
    raise ImportError(
        f"the native library {_NAME} was not found in {[str(c.parent) for c in candidates]}. "
        "Install the package with a C++17 compiler at hand: pip install . (Debian: apt install g++)"
    )
