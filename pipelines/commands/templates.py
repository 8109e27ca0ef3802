"""What commands on a finished template share: the file in its run, and frames of parameters that it can play."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.runs.layout import TEMPLATE
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template


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
    """Frames of body parameters in any layout, for a template to pose.

    Layouts that turn the body about the origin need its root joint. The identity is in the template already: without
    shape directions the betas of the file do not move that joint a second time.

    Raises:
        InputError: no file of parameters, or of another body.
    """
    from smplxpp.body import load_params

    body = template.body
    return load_params(path, body=replace(body, shapedirs=np.zeros_like(body.shapedirs)))
