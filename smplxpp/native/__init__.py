"""Load the native library of the package (CMakeLists.txt), which is built for several instruction sets.

Every function returns a status (`common/status.hpp`) that is converted to an exception here. Arrays are passed by
`address`, and numbers of threads by `thread_count`.
"""

from __future__ import annotations

import ctypes
import numbers
import os
import platform
import sys
import sysconfig
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

LEVELS = ("avx512", "avx2", "generic")
"""Instruction sets that the library is built for, the fastest first."""

INTERFACE = 10
"""Version of the C interface; `smplxpp_interface` of the library must return the same."""
MOST_THREADS = min(256, max(16, 4 * (os.cpu_count() or 1)))
"""Upper bound of the number of threads of a kernel."""
MOST_SIDE = 1 << 16
"""Largest width and height of an image, in pixels, that kernels accept."""

# Status codes of common/status.hpp.
_OUT_OF_MEMORY, _OUT_OF_RANGE, _OVER_LIMIT = 1, 2, 3
# CPU flags that each build needs.
_FEATURES = {
    "avx512": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "avx2": {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"},
    "generic": set(),
}


def let_workers_sleep() -> None:
    """Let idle OpenMP workers, which torch and the native library share, sleep instead of spinning.

    By default they spin for milliseconds after every parallel loop, on cores that another training could use, so that
    two trainings on one machine take many times as long as one. Packages call this before they load torch, because the
    OpenMP runtime reads the environment once. Existing settings (`OMP_WAIT_POLICY`, `GOMP_SPINCOUNT`) are kept. Results
    do not depend on it.
    """
    if "GOMP_SPINCOUNT" not in os.environ:
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def usable_levels() -> tuple[str, ...]:
    """Return those of `LEVELS` that this CPU supports, the fastest first."""
    return tuple(level for level in LEVELS if _FEATURES[level] <= _cpu_features())


class OverLimitError(MemoryError):
    """A kernel would need more memory than its caller allows."""


class _Library(ctypes.CDLL):
    """The native library, whose functions raise an exception according to their status."""

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

        raise InputError("indices", expected="rows of the arrays that they refer to", received="a larger one")
    raise RuntimeError(f"{name} of the native library failed")


def thread_count(asked: int | None = None) -> int:
    """Return the number of threads for a kernel: `asked`, at most `MOST_THREADS`; None: a thread a CPU, at most 8.

    `OMP_NUM_THREADS` bounds the second, as it bounds the threads of torch and OpenMP: several processes of one thread
    each would else wait for each other's at every kernel.

    In a process that was forked after the library was loaded it is 1, because OpenMP's workers do not exist there and a
    parallel loop would wait for them for ever.

    Raises:
        InputError: not an integer of 1 or more.
    """
    if asked is None:
        asked = min(8, os.cpu_count() or 1)
        first, _, _ = os.environ.get("OMP_NUM_THREADS", "").partition(",")  # a list: one number a level of loops
        if first.strip().isdecimal() and int(first):
            asked = min(asked, int(first))
    if not isinstance(asked, numbers.Integral) or isinstance(asked, bool) or asked < 1:
        from smplxpp.core.errors import InputError

        raise InputError("threads", expected="an integer of 1 or more, or None", received=repr(asked))
    return 1 if _forked else min(int(asked), MOST_THREADS)


def map_in_threads(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Call `work` on every item, in as many threads as `thread_count` gives, and return its results in their order.

    Kernels of this library and codecs of images let go of Python's lock, so that independent items take both cores
    where one of them is too small to be shared among threads.

    Args:
        work: of one item; it changes nothing that another item's reads.
        items: any objects.

    Example:
        >>> map_in_threads(abs, [-1, 2])
        [1, 2]
    """
    items = list(items)
    threads = min(thread_count(), len(items))
    if threads < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))


def address(array: Any, dtype: str = "float32") -> ctypes.c_void_p:
    """Return the data pointer of a numpy array or CPU tensor, which it keeps alive; null for None.

    Raises:
        TypeError: another dtype, a non-contiguous array, or another device, where a kernel would read wrong memory.
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
    """Require an image size that kernels accept.

    Raises:
        InputError: a side under 1 or over `MOST_SIDE` pixels.
    """
    if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE):
        from smplxpp.core.errors import InputError

        raise InputError(subject, expected=f"1 to {MOST_SIDE} pixels a side", received=f"{width} x {height}")


_forked = False


def _after_fork() -> None:
    """Limit a forked child to one thread, also in torch, because OpenMP's workers do not exist in it."""
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
    """Return the compiled library for the fastest instruction set that this CPU and the build support.

    Args:
        level: one of `LEVELS`; None: the environment variable `SMPLXPP_ISA`, else the fastest.

    Raises:
        ImportError: the library was not built, not for this level, or from other sources than these.
    """
    level = level or os.environ.get("SMPLXPP_ISA") or None
    if level is not None and level not in LEVELS:
        raise ImportError(f"instruction set {level!r}: expected one of {', '.join(LEVELS)}")
    have = _cpu_features()
    if level is not None and have and not _FEATURES[level] <= have:
        # The kernels would end the process with an illegal instruction.
        needed = ", ".join(sorted(_FEATURES[level]))
        missing = ", ".join(sorted(_FEATURES[level] - have))
        raise ImportError(
            f"instruction set {level!r}: expected a CPU with {needed}, got one without {missing}; unset SMPLXPP_ISA"
        )
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
    """Return the version of a library's interface; 0 if it has none."""
    try:
        function = ctypes.CDLL.__getitem__(library, "smplxpp_interface")
    except AttributeError:
        return 0
    return int(function())


def _folders() -> list[Path]:
    """Return the folders of the library: that of this file, and site-packages for an editable install."""
    return [Path(__file__).parent] + [
        Path(sysconfig.get_path(key)) / "smplxpp" / "native" for key in ("platlib", "purelib")
    ]


@cache
def _cpu_features() -> set[str]:
    """Return the CPU flags in Linux's spelling; none on other systems, which use the generic build."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return set()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("flags"):
                return set(line.split(":", 1)[1].split())
    except OSError:
        pass
    return set()
