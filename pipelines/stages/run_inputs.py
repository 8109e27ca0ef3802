"""Choose the parameters, motion and protocol of a run, and determine whether they are exact or tracked."""

from __future__ import annotations

import logging
from pathlib import Path

from avatar.evaluation.input_protocol import MIXED
from pipelines.runs.artefacts import load_stacked_params
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import REFINE_STAGE, REFINED_PARAMS, REGISTERED_PARAMS, TEMPLATE
from pipelines.runs.stage import is_finished, read_manifest
from pipelines.stages.build_config import BuildInputs, load_build, load_reconstruct, load_register
from smplxpp.body import load_body
from smplxpp.build.inputs import given_motion
from smplxpp.build.segment import label_source
from smplxpp.capture import Capture
from smplxpp.capture.declared import LABEL_WORDS, NOT_KNOWN, DeclaredInputs
from smplxpp.capture.protocols import EXACT, TRACKED
from smplxpp.core import BodyParams, InputError
from smplxpp.core.files.paths import lies_in, same_place

log = logging.getLogger(__name__)
MADE_BY = {REGISTERED_PARAMS: "registered", REFINED_PARAMS: "refined"}
"""Parameter files that a run makes, with the participle that the tables print for them."""


def params_in_use(run: Path, given: Path | None) -> Path | None:
    """Return the run's refined parameters if they started from the given ones; else `params_to_begin_with`."""
    # Refined parameters hold for one template and one start. With another template or other given parameters they are
    # stale.
    manifest = read_manifest(run / REFINE_STAGE)
    if manifest is not None and is_finished(manifest) and (run / REFINED_PARAMS).is_file():
        of_template = (run / TEMPLATE).is_file() and manifest["inputs"].get(TEMPLATE) == sha256_file(run / TEMPLATE)
        if of_template and (given is None or manifest["numbers"].get("given") == record_of_given(given)):
            return run / REFINED_PARAMS
    return params_to_begin_with(run, given)


def params_to_begin_with(run: Path, given: Path | None) -> Path | None:
    """Return the given file, else the run's registered parameters; None: the capture's own."""
    registered = Path(REGISTERED_PARAMS)
    if given is None and (run / registered).is_file() and is_finished(read_manifest(run / registered.parent) or {}):
        return run / registered
    return given


def record_of_given(given: Path | None) -> str | None:
    """Return the identifier of given parameters in a record: name and digest of a file, or a folder's name."""
    if given is None:
        return None
    return f"{given.name} {sha256_file(given)}" if given.is_file() else given.name


def motion_of_build(run: Path, inputs: BuildInputs) -> BodyParams | None:
    """Read the capture's motion: the one given to the build, or the frames that the run has registered."""
    given = None if inputs.motion is None else given_motion(inputs, load_body(inputs.body))
    if given is not None:
        return given
    return load_stacked_params(run / REGISTERED_PARAMS)[1] if inputs.registers else None


def capture_of_build(run: Path, inputs: BuildInputs) -> Path | None:
    """Return the folder of the capture that a run was built from; None for a scan, or where it is gone."""
    of_stages = load_register(run), load_reconstruct(run)
    found = next((one.root for one in of_stages if one is not None and one.root is not None), None)
    folder = found or (None if inputs.cameras is None else inputs.cameras.parent)
    return folder if folder is not None and folder.is_dir() else None


def run_protocol(run: Path) -> str | None:
    """Return the protocol of the build of a run's template; None without one, or without a record."""
    build = load_build(run)
    return None if build is None else build[0].protocol


def chosen_protocol(run: Path, asked: str | None, *, own_params: bool, measures: bool = False) -> str | None:
    """Choose the protocol for reading a capture: the user's choice, else the run's.

    The template and the models must use the same protocol, or the run follows none.

    Args:
        run: folder of the run.
        asked: the user's choice, None without one.
        own_params: whether the user gives parameters too, and so knows that they differ from the template's.
        measures: whether the command only measures; then another protocol is logged instead of refused.

    Raises:
        InputError: another protocol than the run's, for a training.
    """
    if load_build(run) is None:
        return asked
    # Template and models of two protocols would mix exact and tracked inputs in one figure.
    own = run_protocol(run)
    if asked is None or asked == own:
        return own
    built = f"built by protocol {own}" if own else "built without a protocol"
    if measures or own_params:
        log.warning("the template of %s was %s; the capture is read by protocol %s", run, built, asked)
        return asked
    raise InputError(
        "option protocol",
        expected=f"that of run {run}" if own else f"none, as run {run} has none",
        received=f"{asked}, for a template that was {built}",
        remedy=f"build another run by it (smplxpp build OTHER --protocol {asked}), or name the parameters alone "
        "with --params",
    )


def parameters_in_run(declared: DeclaredInputs, run: Path, path: Path | None) -> tuple[str, str]:
    """Return the kind of parameters in a file or folder ("exact", "tracked", ...), and the run's stage behind them."""
    for file, stage in MADE_BY.items():
        if path is not None and same_place(path, run / file):
            return _made_from(declared, run), stage
    return declared.given_parameters(path), ""


def labels_of_build(declared: DeclaredInputs, build: BuildInputs) -> str:
    """Return the kind of the labels that a template was built with; labels by the body are an estimate."""
    # Labels projected by the body are estimated whatever lies in the capture. The capture can only declare what its own
    # files are.
    views = list(build.label_maps.values())
    files = views or [one for one in (build.labels or build.scan,) if isinstance(one, Path)]
    if (build.reconstructs or all(path.exists() for path in files)) and _by_body(build):
        return LABEL_WORDS[TRACKED]
    if not files or not all(path.exists() and lies_in(path, declared.root) for path in files):
        return NOT_KNOWN
    return declared.of_views("labels", views[0].parent.parent.name) if views else declared.scan_labels()


def _made_from(declared: DeclaredInputs, run: Path) -> str:
    """Return the kind of parameters that a run made, which depends on their start: keypoints alone, or a fit."""
    began = declared.own_parameters()
    # Registered parameters began with a fit or with keypoints alone; refined ones with the parameters that their record
    # names.
    registration = load_register(run)
    if registration is not None:
        named = registration.params if isinstance(registration.params, Path) else None
        began = (named or began) if registration.start else None
    else:
        given = (read_manifest(run / REFINE_STAGE) or {}).get("numbers", {}).get("given")
        began = began if given is None else declared.root / "params" / str(given).partition(" ")[0]
    # Keypoints alone are tracked. A start from exact parameters makes the result mixed.
    if began is None:
        return TRACKED
    word = declared.given_parameters(began)
    return MIXED if word == EXACT else word


def _by_body(build: BuildInputs) -> bool:
    """Return whether the labels come from the body in the scan; False for a scan that cannot be read any more."""
    try:
        return label_source(build) == "body"
    except InputError:
        return False


def folder_of_maps(capture: Capture, kind: str) -> str | None:
    """Return the name of the folder with the maps of a kind."""
    series = next(iter(capture.recording.files.get(kind, {}).values()), None)
    return None if series is None else series.folder.parent.name
