"""A run's trained student as a bundle: the options of the command, handed to `avatar`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipelines.commands.options import require_avatar

SUFFIX = ".avatar"


def export_bundle(
    run: Path, out: Path, *, name: str | None, licence: str, params: Path | None, exact: bool
) -> dict[str, Any]:
    """Write the student of a run as a bundle, whole or not at all.

    Args:
        run: folder of a training.
        out: file of the bundle.
        name, licence: of the avatar; no name: the run folder's.
        params: the motion that it has to play; None: the poses that training saw.
        exact: keep float32.

    Returns:
        The file, bytes of its pieces, and how many frames it plays.

    Raises:
        InputError: a run without template or student, or parameters of another body.
    """
    require_avatar("exporting a student")
    import avatar
    from pipelines.commands.templates import load_params_for

    student = avatar.load(run)
    motion = None if params is None else load_params_for(student.rig.template, params)
    return avatar.export_student(student, out, params=motion, name=name, licence=licence, exact=exact)
