"""The protocol of a run: what its template was built by, and whether a later command may read other files."""

from __future__ import annotations

import logging
from pathlib import Path

from pipelines.stages.build_config import load_build
from smplxpp.core.errors import InputError

log = logging.getLogger(__name__)


def run_protocol(run: Path) -> str | None:
    """The protocol that the template of a run was built by; None: without one, or nobody knows."""
    build = load_build(run)
    return None if build is None else build[0].protocol


def chosen_protocol(run: Path, asked: str | None, *, own_params: bool, measures: bool = False) -> str | None:
    """The protocol that a command reads a capture by: the one that is asked for, else the run's.

    A template that was built by one protocol and models that are trained by another would be of no protocol at all.

    Args:
        asked: by the user, None: nothing.
        own_params: the user names parameters too, and so knows that they are not the template's.
        measures: the command trains nothing: another protocol drives the models otherwise, which is said.

    Raises:
        InputError: another protocol than the run's, for a training.
    """
    if load_build(run) is None:
        return asked
    own = run_protocol(run)
    if asked is None or asked == own:
        return own
    told = f"built by protocol {own}" if own else "built without a protocol"
    if measures or own_params:
        log.warning("the template of %s was %s; the capture is read by protocol %s", run, told, asked)
        return asked
    raise InputError(
        "option protocol",
        expected=f"that of run {run}" if own else f"none, as run {run} has none",
        received=f"{asked}, for a template that was {told}",
        remedy=f"build another run by it (smplxpp build --protocol {asked} --out OTHER), or name the parameters alone "
        "with --params",
    )
