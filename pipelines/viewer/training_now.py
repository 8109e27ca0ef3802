"""What a training that may be under way has left last: its stage, its step, its newest picture."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.runs.layout import MODEL_STAGES, REFINE_STAGE
from pipelines.runs.stage import STATE_RECORD

_WORK = "_work"
_STATE = "state.safetensors"
_OLD = 120.0
_SHOWN = {"psnr_crop": "PSNR {:.1f} dB", "loss": "loss {:.4g}"}


@dataclass(frozen=True)
class TrainingNow:
    """Where a training stands.

    Attributes:
        stage: its name. words: step and figures. age: seconds since its log grew.
        picture: the newest one, if there is any. state: its checkpoint, if there is one.
    """

    stage: str
    words: str
    age: float
    picture: Path | None
    state: Path | None

    def __str__(self) -> str:
        """One line for the window."""
        still = "" if self.age < _OLD else f", and nothing for {self.age / 60:.0f} minutes: it may have been stopped"
        return f"training `{self.stage}`: {self.words}{still}"


def training_now(run: Path, *, clock: float | None = None) -> TrainingNow | None:
    """Look at the last stage of a run that has state and was not finished; None: no training is under way.

    Args:
        clock: seconds, as files' times are; None: now.
    """
    for name in reversed((REFINE_STAGE, *MODEL_STAGES)):
        folder = run / f"{name}{_WORK}"
        logs = _by_age(folder, "*metrics.jsonl") or _by_age(folder, STATE_RECORD)
        if not logs:
            continue
        log = logs[-1]
        age = (time.time() if clock is None else clock) - _time(log)
        pictures = _by_age(folder / "previews", "*.png")
        state = folder / _STATE
        words = _words(log, folder) if log.name != STATE_RECORD else "begun"
        return TrainingNow(name, words, age, pictures[-1] if pictures else None, state if state.is_file() else None)
    return None


def _by_age(folder: Path, pattern: str) -> list[Path]:
    return sorted((path for path in folder.rglob(pattern) if path.is_file()), key=_time)


def _time(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # it went while we looked
        return 0.0


def _words(log: Path, folder: Path) -> str:
    from avatar.training.engine.metrics_log import read_metrics

    entries = read_metrics(log)
    kind = "" if log.parent == folder else log.parent.name  # a training before the stage's own
    if not entries:
        return "begun"
    last: dict[str, Any] = next((e for e in reversed(entries) if e["kind"] == "step"), entries[-1])
    figures = [form.format(last[name]) for name, form in _SHOWN.items() if isinstance(last.get(name), float)]
    measured: dict[str, Any] = next((e for e in reversed(entries) if e["kind"] == "evaluation"), {})
    mean = measured.get("mean")
    if isinstance(mean, dict) and isinstance(mean.get("psnr"), float):
        figures.append(f"measured at step {measured['iteration']}: {mean['psnr']:.1f} dB")
    return ", ".join([f"{kind} step {last['iteration']}".strip(), *figures])
