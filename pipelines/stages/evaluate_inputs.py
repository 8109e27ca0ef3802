"""Collect the inputs of an evaluation: whether they are exact, tracked or estimated, and the true surfaces."""

from __future__ import annotations

import hashlib
from itertools import chain
from pathlib import Path

from avatar.evaluation.input_protocol import MIXED, NOT_KNOWN, InputProtocol
from avatar.evaluation.protocol import ProtocolConfig, truth_frames, view_sets
from avatar.training.scene import normal_maps
from pipelines.runs.layout import REGISTERED_PARAMS, TRAIN_STAGES
from pipelines.runs.stage import MANIFEST, read_manifest
from pipelines.stages.build_config import load_build
from pipelines.stages.run_inputs import folder_of_maps, labels_of_build, parameters_in_run
from smplxpp.capture import Capture
from smplxpp.capture.declared import DeclaredInputs, path_of_params
from smplxpp.core.files.json_file import as_integer, as_text

REPORT_FILE = "metrics.json"


def input_protocol(run: Path, capture: Capture) -> InputProtocol:
    """Collect what capture, build and trainings state about the inputs; "not known" where none of them does.

    A capture's statement holds for its own files only: for parameters that lie in it, and for labels of a template that
    was built from it. It lists a file under "inputs", or in a protocol with the name exact or tracked. Parameters that
    the run made are tracked if they started from tracked ones.

    Raises:
        InputError: a statement that docs/captures.md does not define.
    """
    declared = DeclaredInputs.of(capture)
    build = load_build(run, capture=capture.root)
    parameters, stage = parameters_in_run(declared, run, path_of_params(capture.recording.params))
    # The template may have been built with other parameters than those the views are read with. Figures then depend on
    # both, and the protocol is mixed.
    of_template = parameters
    if build is not None:
        given = build[0].params if isinstance(build[0].params, Path) else run / REGISTERED_PARAMS
        of_template = parameters_in_run(declared, run, given)[0]
    if of_template != parameters:
        parameters = NOT_KNOWN if NOT_KNOWN in (parameters, of_template) else MIXED
    # Normals estimated from the tracked surface are an estimate even where the capture has normal maps.
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
    """Return the source of the normals and the numbers of frames and cameras of the last training in the run."""
    for stage in reversed(TRAIN_STAGES):
        numbers = (read_manifest(run / stage) or {}).get("numbers", {})
        if "training_frames" in numbers and "training_cameras" in numbers:
            subject = f"file {run / stage / MANIFEST}"
            # Read strictly: the numbers are printed as facts in the tables.
            frames, cameras = (
                as_integer(numbers[name], subject=f"{subject}: {name}", least=0)
                for name in ("training_frames", "training_cameras")
            )
            normals = numbers.get("normals")
            return None if normals is None else as_text(normals, subject=f"{subject}: normals"), frames, cameras
    return None, None, None


def surface_digest(capture: Capture, protocol: ProtocolConfig) -> str:
    """Return the SHA-256 of the true surfaces that are measured."""
    digest = hashlib.sha256()
    for frame in chain(*truth_frames(capture, protocol, view_sets(capture, protocol)).values()):
        mesh = capture.truth_mesh(frame)
        assert mesh is not None  # `truth_frames` chose frames that have one
        digest.update(f"{frame}".encode() + mesh.vertices.tobytes() + mesh.faces.tobytes())
    return digest.hexdigest()
