"""The motion that a template is tried in."""

from __future__ import annotations

from pathlib import Path

from pipelines.runs.artefacts import load_stacked_params
from pipelines.runs.layout import REGISTERED_PARAMS
from pipelines.stages.build_config import BuildInputs
from smplxpp.body import load_body, load_params
from smplxpp.core.params import BodyParams


def motion_of_build(run: Path, inputs: BuildInputs) -> BodyParams | None:
    """Read the capture's motion: the file that the build names, or the frames that its run has registered."""
    if inputs.motion is not None:
        return load_params(inputs.motion, body=load_body(inputs.body))
    return load_stacked_params(run / REGISTERED_PARAMS)[1] if inputs.registers else None
