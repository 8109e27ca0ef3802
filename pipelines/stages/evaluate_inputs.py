"""What is known of the inputs behind an evaluation: said by the capture, by the build and by the trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from avatar.evaluation.input_protocol import NOT_KNOWN, InputProtocol
from pipelines.runs.layout import TRAIN_STAGES
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import load_build
from pipelines.stages.params_in_use import params_in_use
from pipelines.stages.said_of_inputs import TRACKED, said_of_inputs, said_of_parameters
from pipelines.stages.scene import TrainInputs
from smplxpp.capture import Capture
from smplxpp.capture.readers import simple


def input_protocol(run: Path, inputs: TrainInputs, capture: Capture) -> InputProtocol:
    """Collect what capture, build and trainings say of the inputs; "not known" for whatever none of them says.

    A capture speaks for its own files alone: for the parameters that lie in it, and for the labels of a template that
    was built from it.

    Raises:
        InputError: a capture that says it in other words than docs/captures.md.
    """
    root = capture.recording.root
    said = said_of_inputs(root) if capture.recording.format == simple.NAME else {}
    has_normals = any(capture.recording.files.get("normal", {}).values())
    frames, cameras = _trained_on(run)
    return InputProtocol(
        parameters=_of_parameters(said.get("parameters"), run, inputs.params, root),
        labels=said.get("labels", NOT_KNOWN) if _labelled_by(run, root) else NOT_KNOWN,
        normals=said.get("normals", NOT_KNOWN) if has_normals else "none",
        training_frames=frames,
        training_cameras=cameras,
    )


def _of_parameters(said: Any, run: Path, chosen: Path | None, root: Path) -> str:
    """The word for the parameters in use: those that a run has fitted are tracked, whatever it started from."""
    if params_in_use(run, chosen) != chosen:
        return TRACKED
    return said_of_parameters(said, chosen, root) or NOT_KNOWN


def _labelled_by(run: Path, root: Path) -> bool:
    """Whether the labels of the run's template are files of this capture."""
    build = load_build(run)
    if build is None:
        return False
    found = build[0]
    sources = list(found.label_maps.values()) or [found.labels or found.scan]
    return all(path.exists() and path.resolve().is_relative_to(root.resolve()) for path in sources)


def _trained_on(run: Path) -> tuple[int | None, int | None]:
    """Frames and cameras of the last training that is in the run."""
    for stage in reversed(TRAIN_STAGES):
        numbers = (read_manifest(run / stage) or {}).get("numbers", {})
        if "training_frames" in numbers and "training_cameras" in numbers:
            return numbers["training_frames"], numbers["training_cameras"]
    return None, None
