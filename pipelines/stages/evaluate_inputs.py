"""Collect the inputs of an evaluation: models, whether inputs are exact, tracked or estimated, true surfaces, poses."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64

from avatar.evaluation.evaluate import EvaluationConfig
from avatar.evaluation.input_protocol import MIXED, NOT_KNOWN, InputProtocol
from avatar.evaluation.protocol import truth_frames, view_sets
from avatar.gaussians.tensor_file import load_bound
from avatar.models.model_file import load_avatar
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import AvatarModel, Rig
from avatar.training.scene import normal_maps
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import (
    BEST_FIRST,
    MEASURED,
    MODEL_FILES,
    REFINED_HELD_OUT_PARAMS,
    REGISTERED_PARAMS,
    TRAIN_STAGES,
)
from pipelines.runs.stage import MANIFEST, read_manifest
from pipelines.stages.build_config import load_build
from pipelines.stages.run_inputs import folder_of_maps, labels_of_build, parameters_in_run
from smplxpp.body import BodyModel
from smplxpp.capture import Capture, open_capture
from smplxpp.capture.declared import DeclaredInputs, path_of_params
from smplxpp.capture.protocols import EXACT
from smplxpp.capture.recording import ParamSource
from smplxpp.capture.sources import StackedParams
from smplxpp.core import BodyParams, InputError, require_known, spread
from smplxpp.core.files.json_file import as_integer, as_text
from smplxpp.metrics import PoseError, mean_pose_error, pose_error
from smplxpp.raster import outer_visible_points
from smplxpp.template.template import Template

REPORT_FILE = "metrics.json"
log = logging.getLogger(__name__)
COMPARED = 100
"""Largest number of frames of a kind (training, held-out) whose poses are compared; they are evenly spread."""
BEHIND = 5e-4
"""Depth in metres behind the outer surface from which a vertex counts as covered; parts keep 1 mm from the body."""


def model_files(run: Path, names: Iterable[str] = ()) -> dict[str, Path]:
    """Find the files of the models of a run, in the order of `MODEL_FILES`.

    Args:
        names: those to find; none: `MEASURED`, as far as there are files, with the newest student there is.

    Raises:
        InputError: an unknown name, a model that is asked for and not trained, no teacher and no student.
    """
    # Look for every known model file, then compare with the names that the user asked for.
    there = {name: run / file for name, file in MODEL_FILES.items() if (run / file).is_file()}
    asked = list(names)
    require_known("models", asked, MODEL_FILES)
    missing = [name for name in asked if name not in there]
    untrained = not asked and not there.keys() & set(BEST_FIRST)
    if missing or untrained:
        fit_alone = missing == ["fit"]
        raise InputError(
            f"run {run}",
            expected=", ".join(MODEL_FILES[name] for name in missing) if missing else "a trained teacher or student",
            received=f"only {', '.join(there)}" if there else "no model",
            remedy=f"`smplxpp {'fit' if fit_alone else 'train'}` makes it; a training in progress is measured "
            "when its stage is finished",
        )
    # Without a student, the baked one (before its blend shapes) is the newest.
    wanted = asked or (*MEASURED, *(() if "student" in there else ("baked",)))
    return {name: there[name] for name in MODEL_FILES if name in wanted and name in there}


def load_model(name: str, path: Path, rig: Rig) -> AvatarModel:
    """Load a model of a run; the fit is a student without field and blend shapes.

    Raises:
        InputError: a damaged file, one of another template or of a newer version.
    """
    if name != "fit":
        return load_avatar(path, rig)
    return Student(StudentConfig(field=None), rig, load_bound(path, faces=rig.template.faces), ())


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


def measuring_digests(capture: Capture, config: EvaluationConfig) -> dict[str, str]:
    """Return the SHA-256 of the true surfaces that are measured, and of the weights of LPIPS, as inputs of a stage."""
    digest, protocol = hashlib.sha256(), config.protocol
    for frame in chain(*truth_frames(capture, protocol, view_sets(capture, protocol)).values()):
        mesh = capture.truth_mesh(frame)
        assert mesh is not None  # `truth_frames` chose frames that have one
        digest.update(f"{frame}".encode() + mesh.vertices.tobytes() + mesh.faces.tobytes())
    weights = {f"weights of LPIPS, file {k}": sha256_file(path) for k, path in enumerate(config.lpips_weights)}
    return {"capture/surfaces": digest.hexdigest(), **weights}


def exact_params(capture: Capture, body: Path | None, model: BodyModel) -> ParamSource | None:
    """Return the exact parameters of a capture with a protocol of that name; they serve measuring, never training."""
    if EXACT not in capture.recording.protocols or capture.protocol == EXACT:
        return None
    try:
        return open_capture(capture.root, body=None if body is None else model, protocol=EXACT).recording.params
    except InputError as error:
        log.warning("poses are not compared with the exact ones: %s", error)
        return None


def pose_errors(captures: Mapping[str, Capture], exact: ParamSource, template: Template) -> dict[str, PoseError]:
    """Measure the errors of the poses in use, for training and for held-out frames.

    The poses in use move the template's body, which has one shape; the exact body has a shape of its own.

    Args:
        captures: captures by a suffix of the kind's name. "" has the poses in use; of others only held-out poses count.
        exact: the true parameters.
        template: template of the run.
    """
    covered, known = covered_vertices(template), set(exact.frames().tolist())
    found: dict[str, PoseError] = {}
    for title, capture in captures.items():
        splits = capture.splits
        # Refinement of held-out poses leaves the training poses alone, so that those are compared once, under "".
        kinds = {"training frames": () if title else splits.train_frames, "held-out frames": splits.novel_pose_frames}
        for kind, frames in kinds.items():
            # Compare only frames for which both sources have parameters.
            there = [frame for frame in frames if frame in known and capture.params(frame) is not None]
            errors = [
                pose_error(
                    _params(capture, frame).without_shape(),
                    _from_template(exact.read(frame), template),
                    template.body,
                    covered,
                )
                for frame in spread(there, COMPARED)
            ]
            if errors:
                found[f"{kind}{title}"] = mean_pose_error(errors)
    return found


def _from_template(params: BodyParams, template: Template) -> BodyParams:
    """Return parameters for the template's body, whose mean shape is the template's."""
    size = template.body.num_betas
    betas = np.zeros((len(params), size))
    # The template's mean shape already contains its own betas; subtract them from the exact ones.
    betas[:, : params.betas.shape[1]] += params.betas[:, :size]
    betas[:, : len(template.betas)] -= template.betas[:size]
    return replace(params, betas=betas, v_shape=None)


def covered_vertices(template: Template) -> Bool[np.ndarray, " V"]:
    """Return which vertices of the body are hidden by parts in the T-pose, and visible from outside without parts."""
    body = template.part_mesh(template.part_names[0])
    # A vertex is covered if it is visible with the body alone and hidden with all parts.
    seen = [outer_visible_points(mesh, body.vertices, tolerance=BEHIND) for mesh in (body, template.mesh)]
    return seen[0] & ~seen[1]


def refined_poses(run: Path, capture: Capture) -> Capture | None:
    """Return the capture with held-out poses that the run refined on the training cameras; None without any."""
    path = run / REFINED_HELD_OUT_PARAMS
    own = capture.recording.params
    if own is None or not path.is_file() or not capture.splits.novel_pose_frames:
        return None
    source = _HeldOutFrom(own, StackedParams(path), frozenset(capture.splits.novel_pose_frames))
    return replace(capture, recording=replace(capture.recording, params=source))


def refined_digest(run: Path, refined: Capture | None) -> dict[str, str]:
    """Return the digest of the file behind `refined_poses`, as an input of a stage."""
    return {} if refined is None else {REFINED_HELD_OUT_PARAMS: sha256_file(run / REFINED_HELD_OUT_PARAMS)}


def of_held_out_poses(config: EvaluationConfig, capture: Capture) -> EvaluationConfig | None:
    """Restrict an evaluation to the view sets of held-out poses, without speed and pictures; None without such sets."""
    sets = tuple(name for name in view_sets(capture, config.protocol) if name.startswith("novel_pose"))
    if not sets:
        return None
    return replace(config, protocol=replace(config.protocol, sets=sets), speed_pictures=0, shown=0)


@dataclass(frozen=True, eq=False)
class _HeldOutFrom:
    """Parameters whose held-out frames come from a second source, where that source has them."""

    own: ParamSource
    other: ParamSource
    held_out: frozenset[int]

    def frames(self) -> Int64[np.ndarray, " F"]:
        return self.own.frames()

    def read(self, frame: int) -> BodyParams:
        other = frame in self.held_out and frame in self.other.frames()
        return (self.other if other else self.own).read(frame)


def _params(capture: Capture, frame: int) -> BodyParams:
    params = capture.params(frame)
    assert params is not None  # frames without were left out
    return params
