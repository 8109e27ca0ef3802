"""What commands on a finished template share: the file in its run, and frames of parameters that it can play."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.commands.driving import Driving, unshaped
from pipelines.runs.layout import PARAMS, TEMPLATE
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template

if TYPE_CHECKING:
    from avatar.speech import Face, StandingBody


def load_run_template(run: Path) -> Template:
    """The template of a run.

    Raises:
        InputError: a run without one.
    """
    path = run / TEMPLATE
    if not path.is_file():
        raise InputError(
            f"run {run}",
            expected=f"a finished template in {TEMPLATE}",
            received="no such folder" if not run.is_dir() else "a run without it",
            remedy="make it with `smplxpp build`; `smplxpp inspect RUN` tells which stages stand",
        )
    return Template.load(path)


def load_params_for(template: Template, path: Path) -> BodyParams:
    """A motion in any layout, or a .bvh, for a template to make.

    Raises:
        InputError: no file of parameters, or of another body.
    """
    return Driving().load(path, unshaped(template.body))


def person_of_run(run: Path) -> tuple[Face, StandingBody]:
    """Return the face of a run's template and how its body stands in the reference frame."""
    from avatar.driving import person_of_template
    from pipelines.runs.artefacts import load_params_of_run

    seen = load_params_of_run(run) if (run / PARAMS).is_file() else None
    return person_of_template(load_run_template(run), seen)
