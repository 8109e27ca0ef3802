"""Stages of nothing, for tests of what is done with stages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipelines.runs.stage import Stage, StageOutput, StageRecord, run_stage

CODE = ("smplxpp.core.errors",)


def stage_of(name: str, *, config: Any = None, inputs: dict[str, str] | None = None, **more: Any) -> Stage:
    """A stage whose code is one small module."""
    return Stage(name=name, config=config or {}, inputs=inputs or {}, code=CODE, **more)


def add_stage(run: Path, name: str, work: Callable[[Path], StageOutput] = lambda folder: StageOutput()) -> StageRecord:
    """A stage of a run, made at once."""
    return run_stage(run, stage_of(name), work)
