"""Which body parameters a training takes: given ones, or the best that the run has made."""

from __future__ import annotations

from pathlib import Path

from pipelines.runs.layout import REFINE_STAGE, REFINED_PARAMS, REGISTER_STAGE, REGISTERED_PARAMS
from pipelines.runs.stage import is_finished, read_manifest


def params_in_use(run: Path, given: Path | None) -> Path | None:
    """Return the given file, else the run's refined parameters, else its registered ones; None: the capture's own."""
    if given is not None:
        return given
    for stage, file in ((REFINE_STAGE, REFINED_PARAMS), (REGISTER_STAGE, REGISTERED_PARAMS)):
        manifest = read_manifest(run / stage)
        if manifest is not None and is_finished(manifest) and (run / file).is_file():
            return run / file
    return None
