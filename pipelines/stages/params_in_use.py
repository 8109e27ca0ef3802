"""Which body parameters a training takes: given ones, or the best that the run has made."""

from __future__ import annotations

from pathlib import Path

from pipelines.runs.code import sha256_file
from pipelines.runs.layout import REFINE_STAGE, REFINED_PARAMS, REGISTERED_PARAMS, TEMPLATE
from pipelines.runs.stage import is_finished, read_manifest


def params_in_use(run: Path, given: Path | None) -> Path | None:
    """Return the run's refined parameters if they began with these; else `params_to_begin_with`."""
    manifest = read_manifest(run / REFINE_STAGE)
    if manifest is not None and is_finished(manifest) and (run / REFINED_PARAMS).is_file():
        of_template = (run / TEMPLATE).is_file() and manifest["inputs"].get(TEMPLATE) == sha256_file(run / TEMPLATE)
        if of_template and (given is None or manifest["numbers"].get("given") == told_of_given(given)):
            return run / REFINED_PARAMS
    return params_to_begin_with(run, given)


def params_to_begin_with(run: Path, given: Path | None) -> Path | None:
    """Return the given file, else the run's registered parameters; None: the capture's own."""
    registered = Path(REGISTERED_PARAMS)
    if given is None and (run / registered).is_file() and is_finished(read_manifest(run / registered.parent) or {}):
        return run / registered
    return given


def told_of_given(given: Path | None) -> str | None:
    """What a record says of parameters that a user gave: content and name of a file, or its name in the capture."""
    if given is None:
        return None
    return f"{given.name} {sha256_file(given)}" if given.is_file() else given.name
