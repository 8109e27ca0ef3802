"""Loads the package's native library (see CMakeLists.txt), built once for every instruction set it may meet.

Every function of it returns a status (`common/status.hpp`), which becomes an exception here: callers have nothing to
look at. What a caller hands over goes through `address`, and a number of threads through `thread_count`.
"""

from __future__ import annotations

import ctypes
import numbers
import os
import platform
import sys
import sysconfig
from functools import cache
from pathlib import Path
from typing import Any

LEVELS = ("avx512", "avx2", "generic")
"""Builds of the library, the best first."""

INTERFACE = 8
"""What `smplxpp_interface` of a library that fits these sources answers."""
MOST_THREADS = min(256, max(16, 4 * (os.cpu_count() or 1)))
"""More threads than this are not started, whatever was asked for."""
MOST_SIDE = 1 << 16
"""Pixels on a side of an image that kernels take."""

_OUT_OF_MEMORY, _OUT_OF_RANGE, _OVER_LIMIT = 1, 2, 3
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


class OverLimitError(MemoryError):
    """A kernel would need more memory than its caller allows."""


class _Library(ctypes.CDLL):
    """The library, whose functions raise what their status says."""

    def __getitem__(self, name: str) -> Any:
        function = super().__getitem__(name)
        function.errcheck = _check_status  # type: ignore[assignment]
        return function


def _check_status(status: int, function: Any, _: tuple) -> None:
    if not status:
        return
    name = function.__name__
    if status == _OUT_OF_MEMORY:
        raise MemoryError(f"no memory for {name} of the native library")
    if status == _OVER_LIMIT:
        raise OverLimitError(f"{name} of the native library would need more memory than it may have")
    if status == _OUT_OF_RANGE:
        from smplxpp.core.errors import InputError

        raise InputError("indices", expected="numbers of rows of the arrays they point into", received="one beyond")
    raise RuntimeError(f"{name} of the native library failed")


def thread_count(asked: int | None = None) -> int:
    """How many threads a kernel is to take: `asked`, at most `MOST_THREADS`; None is up to 8, a CPU each.

    In a process forked from one that had loaded the library it is 1: OpenMP's workers were left behind, and a loop that
    waits for them would wait for ever.

    Raises:
        InputError: not an integer of 1 or more.
    """
    if asked is None:
        asked = min(8, os.cpu_count() or 1)
    if not isinstance(asked, numbers.Integral) or isinstance(asked, bool) or asked < 1:
        from smplxpp.core.errors import InputError

        raise InputError("threads", expected="an integer of 1 or more, or None", received=repr(asked))
    return 1 if _forked else min(int(asked), MOST_THREADS)


def address(array: Any, dtype: str = "float32") -> ctypes.c_void_p:
    """Where the numbers of a numpy array or a torch tensor on the CPU begin, which it keeps alive; null for None.

    Raises:
        TypeError: another dtype, numbers that do not lie in order, or another device: a kernel would read elsewhere.
    """
    if array is None:
        return ctypes.c_void_p(None)
    if hasattr(array, "data_ptr"):
        found = str(array.dtype).removeprefix("torch.")
        in_order, where = array.is_contiguous() and array.device.type == "cpu", array.data_ptr
    else:
        found, in_order, where = array.dtype.name, array.flags.c_contiguous, lambda: array.ctypes.data
    if found != dtype or not in_order:
        raise TypeError(f"a kernel takes contiguous {dtype} on the CPU, not {found}{'' if in_order else ', scattered'}")
    pointer = ctypes.c_void_p(where())
    pointer.array = array  # type: ignore[attr-defined]
    return pointer


def check_size(width: int, height: int, subject: str) -> None:
    """Require an image size that kernels can count in.

    Raises:
        InputError: a side under 1 or over `MOST_SIDE` pixels.
    """
    if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE):
        from smplxpp.core.errors import InputError

        raise InputError(subject, expected=f"1 to {MOST_SIDE} pixels a side", received=f"{width} x {height}")


_forked = False


def _after_fork() -> None:
    """Run by a forked child, which has none of the threads that OpenMP believes to have; torch's are the same."""
    global _forked
    _forked = True
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)


@cache
def _watch_forks() -> None:
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_after_fork)


@cache
def native_library(level: str | None = None) -> ctypes.CDLL:
    """The compiled library, for the best instruction set that this CPU and this build have.

    `level` (or the environment's `SMPLXPP_ISA`) asks for one of `LEVELS` by name.

    Raises:
        ImportError: the library was not built, or not at the level asked for, or from other sources than these.
    """
    level = level or os.environ.get("SMPLXPP_ISA") or None
    if level is not None and level not in LEVELS:
        raise ImportError(f"instruction set {level!r}: expected one of {', '.join(LEVELS)}")
    have = _cpu_features()
    stale = ""
    for name in LEVELS if level is None else (level,):
        if level is None and not _FEATURES[name] <= have:
            continue
        for folder in _folders():
            path = folder / f"smplxpp_native_{name}.so"
            if path.exists():
                library = _Library(str(path))
                if _interface(library) == INTERFACE:
                    _watch_forks()
                    return library
                stale = f"{path} was built from other sources than these. "
    raise ImportError(
        f"{stale}The native library smplxpp_native_{level or 'generic'}.so was not found in "
        f"{[str(f) for f in _folders()]}. Install the package with a C++17 compiler at hand: "
        "pip install . (Debian: apt install g++)"
    )


def _interface(library: ctypes.CDLL) -> int:
    """The interface of a library; 0 of one that does not say."""
    try:
        function = ctypes.CDLL.__getitem__(library, "smplxpp_interface")
    except AttributeError:
        return 0
    return int(function())


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
