"""The command line and what it runs: stages of a run, captures, reports."""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Run the `smplxpp` command; an interrupt while its modules are still being loaded ends without a traceback.

    Returns:
        The exit status of `pipelines.cli.main`; 130 after an interrupt.
    """
    # Matrices here have a few hundred columns, over which threads of OpenBLAS wait for each other longer than they
    # compute, most of all beside other processes. OpenBLAS reads this when numpy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Nothing of the package is imported before the guard: its modules take half a second. What Python does before them
    # (`site`, 20 ms) is not guarded.
    try:
        from pipelines.cli import main as run
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    return run()


def __getattr__(name: str) -> object:
    if name != "__version__":
        raise AttributeError(f"module 'pipelines' has no attribute {name!r}")
    from smplxpp import __version__

    return __version__
