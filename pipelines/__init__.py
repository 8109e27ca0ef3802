"""The command line and what it runs: stages of a run, captures, reports."""

from __future__ import annotations

import sys

from smplxpp.core.lazy import lazy_exports

__getattr__, __dir__ = lazy_exports("pipelines", {"__version__": "smplxpp"})


def main() -> int:
    """Run the `smplxpp` command; an interrupt while its modules are still being loaded ends without a traceback.

    Returns:
        The exit status of `pipelines.cli.main`; 130 after an interrupt.
    """
    try:
        from pipelines.cli import main as run
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    return run()
