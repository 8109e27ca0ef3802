"""What is known of the inputs behind an evaluation: said by the capture, by the build and by the trainings."""

from __future__ import annotations

from pathlib import Path

from avatar.evaluation.input_protocol import MIXED, NOT_KNOWN, InputProtocol
from avatar.training.scene import normal_maps
from pipelines.runs.layout import REGISTERED_PARAMS, TRAIN_STAGES
from pipelines.runs.stage import MANIFEST, read_manifest
from pipelines.stages.build_config import load_build
from pipelines.stages.run_inputs import folder_of_maps, labels_of_build, parameters_in_run
from smplxpp.capture import Capture
from smplxpp.capture.declared import DeclaredInputs, path_of_params
from smplxpp.core.files.json_file import as_integer, as_text


def input_protocol(run: Path, capture: Capture) -> InputProtocol:
    """Collect what capture, build and trainings say of the inputs; "not known" for whatever none of them says.

    A capture speaks for its own files alone: for the parameters that lie in it, and for the labels of a template that
    was built from it. It says what a file is by the file's name under "inputs", or by naming it in a protocol that is
    called exact or tracked. Parameters that the run made are tracked, if what they began with was.

    Raises:
        InputError: a capture that says it in other words than docs/captures.md.
    """
    declared = DeclaredInputs.of(capture)
    build = load_build(run)
    parameters, stage = parameters_in_run(declared, run, path_of_params(capture.recording.params))
    of_template = parameters
    if build is not None:
        given = build[0].params if isinstance(build[0].params, Path) else run / REGISTERED_PARAMS
        of_template = parameters_in_run(declared, run, given)[0]
    if of_template != parameters:
        parameters = NOT_KNOWN if NOT_KNOWN in (parameters, of_template) else MIXED
    used, frames, cameras = _trained(run)
    there, all_views = normal_maps(capture)
    if used == "surface":
        normals = "estimated"
    else:
        folder = folder_of_maps(capture, "normal")
        normals = "none" if not there or used == "none" else declared.of_views("normals", folder)
    return InputProtocol(
        parameters=parameters,
        stage=stage,
        labels=NOT_KNOWN if build is None else labels_of_build(declared, build[0]),
        normals=normals,
        views_with_normals=there,
        training_views=all_views,
        training_frames=frames,
        training_cameras=cameras,
    )


def _trained(run: Path) -> tuple[str | None, int | None, int | None]:
    """Source of the normals, and frames and cameras, of the last training that is in the run."""
    for stage in reversed(TRAIN_STAGES):
        numbers = (read_manifest(run / stage) or {}).get("numbers", {})
        if "training_frames" in numbers and "training_cameras" in numbers:
            subject = f"file {run / stage / MANIFEST}"
            frames, cameras = (
                as_integer(numbers[name], subject=f"{subject}: {name}", least=0)
                for name in ("training_frames", "training_cameras")
            )
            normals = numbers.get("normals")
            return None if normals is None else as_text(normals, subject=f"{subject}: normals"), frames, cameras
    return None, None, None
