"""The command line and what it runs: stages of a run, captures, reports."""

from __future__ import annotations

from smplxpp.core.lazy import lazy_exports

__getattr__, __dir__ = lazy_exports("pipelines", {"__version__": "smplxpp"})
