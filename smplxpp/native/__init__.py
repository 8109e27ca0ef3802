"""Loads the package's native library (see CMakeLists.txt), built once for every instruction set it may meet."""

from __future__ import annotations

import ctypes
import os
import platform
import sysconfig
from functools import cache
from pathlib import Path

LEVELS = ("avx512", "avx2", "generic")
"""Builds of the library, the best first."""

_FEATURES = {
    "avx512": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "avx2": {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"},
    "generic": set(),
}


def let_workers_sleep() -> None:
    """Ask OpenMP, which torch and the native library share, to put workers to sleep where they have nothing to do.

    By default they spin for milliseconds after every parallel loop, on cores that another training could use: two on
    one machine then take many times as long as one. Packages call this before they load torch, as the runtime looks
    once; what the environment says of it (`OMP_WAIT_POLICY`, `GOMP_SPINCOUNT`) stands. No number depends on it.
    """
    if "GOMP_SPINCOUNT" not in os.environ:
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def usable_levels() -> tuple[str, ...]:
    """Those of `LEVELS` that this CPU can run, the best first."""
    return tuple(level for level in LEVELS if _FEATURES[level] <= _cpu_features())


@cache
def native_library(level: str | None = None) -> ctypes.CDLL:
    """The compiled library, for the best instruction set that this CPU and this build have.

    `level` (or the environment's `SMPLXPP_ISA`) asks for one of `LEVELS` by name.

    Raises:
        ImportError: the library was not built, or not at the level asked for.
    """
    level = level or os.environ.get("SMPLXPP_ISA") or None
    if level is not None and level not in LEVELS:
        raise ImportError(f"instruction set {level!r}: expected one of {', '.join(LEVELS)}")
    have = _cpu_features()
    for name in LEVELS if level is None else (level,):
        if level is None and not _FEATURES[name] <= have:
            continue
        for folder in _folders():
            path = folder / f"smplxpp_native_{name}.so"
            if path.exists():
                return ctypes.CDLL(str(path))
    raise ImportError(
        f"the native library smplxpp_native_{level or 'generic'}.so was not found in {[str(f) for f in _folders()]}. "
        "Install the package with a C++17 compiler at hand: pip install . (Debian: apt install g++)"
    )


def _folders() -> list[Path]:
    """Beside this file, or in site-packages for an editable install."""
    return [Path(__file__).parent] + [
        Path(sysconfig.get_path(key)) / "smplxpp" / "native" for key in ("platlib", "purelib")
    ]


@cache
def _cpu_features() -> set[str]:
    """Flags of the CPU as Linux spells them; none elsewhere, where the generic build is taken."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return set()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("flags"):
                return set(line.split(":", 1)[1].split())
    except OSError:
        pass
    return set()
