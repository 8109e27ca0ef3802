"""Files of a trained student: whole, and compact as players read it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from avatar.data.sequence import AvatarSequence
from avatar.models.model_file import load_avatar, save_avatar
from avatar.models.student import Student
from avatar.training.engine.photometric_task import TaskContext
from avatar.training.student.compensate import CompensateConfig, CompensateTask
from avatar.training.student.prune import pruned_to


def write_student(
    whole: Path,
    compact: Path,
    student: Student,
    sequence: AvatarSequence,
    config: CompensateConfig,
    *,
    max_bytes: float | None,
    context: TaskContext,
) -> dict[str, Any]:
    """Write a student whole, and compact for players, and measure the compact one after reading it back.

    Args:
        whole: file of the student in single precision.
        compact: file of the student for players, in half precision.
        student: with blend shapes.
        sequence: the frames and views that it is measured on.
        config: of its training.
        max_bytes: bound of the compact file, which leaves out blend shapes to keep it; None: it has all.
        context: of its training.

    Returns:
        "bytes" of the files by name; "compact": the share of the blend shapes that it keeps, and its figures.
    """
    small, keep = (student, 1.0) if max_bytes is None else pruned_to(student, sequence, max_bytes)
    bytes_of = {whole.name: save_avatar(whole, student), compact.name: save_avatar(compact, small, compact=True)}
    # Read the file as a player does: half precision, pruned blend shapes.
    stored = load_avatar(compact, sequence.rig)
    assert isinstance(stored, Student)
    # Figures are those of the stored student on held-out views; the preview shows the training alone.
    quiet = replace(context, preview=lambda images: None)
    # Without the coherence term, whose search for neighbours only a training needs.
    task = CompensateTask(sequence, stored, replace(config, coherence=0.0), quiet)
    figures = task.evaluate(config.iterations)
    measured = {kind: figures[kind] for kind in ("novel_view", "novel_pose") if kind in figures}
    return {"bytes": bytes_of, "compact": {"kept_blend_shapes": keep, **measured}}
