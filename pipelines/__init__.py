"""The command line and what it runs: stages of a run, captures, reports."""

from __future__ import annotations

from importlib import import_module


def __getattr__(name: str) -> str:
    if name == "__version__":
        return import_module("smplxpp").__version__
    raise AttributeError(f"module 'pipelines' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), "__version__"])
