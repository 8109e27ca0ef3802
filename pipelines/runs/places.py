"""Checks of folders: whether two paths are the same file, what a run may not be written into, and runs of old names.

Captures may link to files that lie elsewhere.
"""

from __future__ import annotations

import os
from pathlib import Path

from pipelines.runs.layout import ABLATION, ALL_STAGES, OLD_STAGE_NAMES
from smplxpp.core.errors import InputError

RUNS_OF_A_CAPTURE = "runs"
"""The one folder of a capture in which runs may lie: no reader looks for anything there."""


def same_place(one: Path, other: Path) -> bool:
    """Tell whether two paths are the same as they are written, or lead to the same file or folder."""
    return absolute(one) == absolute(other) or one.resolve() == other.resolve()


def lies_in(path: Path, folder: Path) -> bool:
    """Tell whether a path lies in a folder as it is written, or where its links lead."""
    return absolute(path).is_relative_to(absolute(folder)) or path.resolve().is_relative_to(folder.resolve())


def absolute(path: Path) -> Path:
    """The absolute path without `..`; links stay as they are."""
    return Path(os.path.abspath(path))


def keep_out_of_capture(out: Path, capture: Path | None, *, subject: str = "--out") -> None:
    """Refuse a folder to write into that would mix what is written with the files of a capture.

    Refused are the capture's own folder, every folder in it but those in its folder `runs`, and a folder of which the
    capture is a stage, or lies in one.

    Args:
        out: folder that is going to be written, which need not exist.
        capture: folder that is read; None: there is none.
        subject: the option that names `out`.

    Raises:
        InputError: it is refused.
    """
    if capture is None:
        return
    for folder, root in ((absolute(out), absolute(capture)), (out.resolve(), capture.resolve())):
        if folder.is_relative_to(root):
            inside = folder.relative_to(root).parts
            mixed = len(inside) < 2 or inside[0] != RUNS_OF_A_CAPTURE
            received = "the capture's own folder" if not inside else f"{out}, a folder in it"
        else:
            stage = root.relative_to(folder).parts[0] if root.is_relative_to(folder) else ""
            mixed = stage in (*ALL_STAGES, ABLATION)
            received = f"{out}, in which the capture takes the place of {stage}"
        if mixed:
            raise InputError(
                subject,
                expected=f"a folder apart from the capture {capture}",
                received=received,
                remedy=f"choose another with {subject}, as {capture / RUNS_OF_A_CAPTURE / 'NAME'} or runs/{root.name}",
            )


def refuse_old_run(folder: Path) -> None:
    """Refuse a run folder whose stages have the names that earlier versions gave them.

    Its stages would be made again under their new names beside the old ones, and half of the run would be read from
    either. `pipelines.cli` calls this for every folder that a command is given, and `own_run_folder` for every run
    that Python code writes.

    Raises:
        InputError: the folder holds a stage under an old name.
    """
    for old, new in OLD_STAGE_NAMES.items():
        if (folder / old / "manifest.json").is_file():
            raise InputError(
                f"run folder {folder}",
                expected=f"stages named as this version names them ({new})",
                received=f"{old}, which an earlier version wrote",
                remedy="build the run again in a new folder",
            )
