"""Decide what a build takes: what is given, what a capture has, and what has to be made."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from smplxpp.body import BodyModel, family_of_params, load_body, load_params
from smplxpp.body.smpl_joints import is_open_body
from smplxpp.build.config import BuildConfig, BuildInputs, ReconstructInputs, RegisterInputs, resolved
from smplxpp.build.reconstruct import open_photographs, usable_cameras, usable_frames
from smplxpp.build.request import BuildRequest
from smplxpp.capture import Capture, ReferenceFrame, find_reference
from smplxpp.capture.declared import DeclaredInputs
from smplxpp.capture.protocols import TRACKED, choose_protocol, read_description
from smplxpp.capture.recording import TURNTABLE
from smplxpp.clean.scan_frame import AUTO
from smplxpp.core import BodyParams, InputError, require_choice, spread
from smplxpp.core.files.paths import same_place
from smplxpp.core.labels import PartRule
from smplxpp.segment import find_label_set, map_labels, read_label_map
from smplxpp.segment.label_files import check_label_ids

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class BuildPlan:
    """Inputs of a build, with every choice decided.

    Attributes:
        inputs: what is read and which steps make the rest.
        config: choices, with "auto" resolved as far as it can be before the scan is read.
        registration: what the body is registered to; None where parameters are given or found.
        reconstruction: photographs that the scan is made of; None where there is a scan.
    """

    inputs: BuildInputs
    config: BuildConfig
    registration: RegisterInputs | None
    reconstruction: ReconstructInputs | None


def plan_build(request: BuildRequest) -> BuildPlan:
    """Decide what a build takes, before any work is done.

    Raises:
        InputError: neither or both ways of naming the input, files that a capture lacks, or photographs that cannot be
            used.
    """
    # Exactly one of the two ways to name the input.
    if (request.capture is None) == (request.scan is None):
        raise InputError(
            "input",
            expected="either --capture or --scan",
            received="both" if request.scan is not None else "neither",
        )
    inputs = _of_scan(request) if request.capture is None else _of_capture(request)
    # Units and axis depend on the inputs: a capture's cameras fix the world, a lone scan's have to be found.
    config = resolved(request.config, inputs)
    return BuildPlan(inputs, config, _registration(request, inputs), _reconstruction(request, inputs))


def _of_capture(request: BuildRequest) -> BuildInputs:
    """Decide the inputs of a capture: a missing scan is reconstructed, missing parameters are registered."""
    root, config = request.root, request.config
    assert root is not None
    _refuse_height(config, "a capture, whose cameras state the size")
    if config.whose != AUTO:
        raise InputError("option whose", expected="with --scan", received="with --capture")
    # Decide first who makes the parameters, because the search for the reference frame only asks for a fit if one is
    # used.
    registers = _registers(request)
    # Parameters in memory take the place of the capture's files; their rows are numbered by the capture's frames.
    in_memory = request.params if isinstance(request.params, BodyParams) else None
    found = find_reference(
        root,
        frame=config.frame,
        params=request.named_params,
        protocol=request.protocol,
        fitted=not registers and in_memory is None,
        scanned=False,
    )
    # Labels of the user come first; those of the capture are used only if the source of labels allows it.
    labels = _scan_labels(request, found) if request.labels is None else request.labels
    by_body = config.label_source == "body"
    # A few photographs from all around tell left from right; more cost time and decide nothing.
    most_photographs = 8
    return BuildInputs(
        subject=found.subject,
        scan=found.scan or request.surface,
        params=None if registers else (in_memory or found.params),
        reconstructs=found.scan is None,
        locates=registers and not _starts(request, found),
        registers=registers,
        frame=found.frame,
        # A file of parameters has rows of its own, which need not be numbered like the frames.
        params_row=found.params_frame if in_memory is None else found.frame,
        labels=labels,
        label_maps={} if labels is not None or by_body else found.label_maps,
        photographs=dict(spread(list(found.photographs.items()), most_photographs)),
        # Cameras are read to project label maps or photographs; labels given by the user need neither.
        cameras=found.cameras_file if found.photographs or labels is None else None,
        label_set="capture" if config.label_set == AUTO else config.label_set,
        label_source="body" if by_body else "auto",
        motion=None if registers else (in_memory or found.motion),
        body=request.body_file,
        protocol=request.protocol,
    )


def _of_scan(request: BuildRequest) -> BuildInputs:
    """Decide the inputs of a build from a scan.

    Raises:
        InputError: options that need a capture.
    """
    config = request.config
    # These options choose among files of a capture, and a lone scan has none.
    for name in ("protocol", "keypoints", "masks"):
        if getattr(config, name) is not None:
            raise InputError(f"option {name}", expected="with --capture", received="with --scan")
    if request.params is not None:
        _refuse_height(config, "parameters, which state the size")
    # Parameters of a licensed model do not fit the open body; the search for the body starts from them.
    of_licensed_model = request.params is not None and config.register != "on" and _of_licensed_model(request)
    if of_licensed_model and config.register == "off":
        raise InputError(
            "option register",
            expected="auto, since parameters of another body than the open one are a start and no fit",
            received="off",
            remedy="name the model's file with --body, or state with --whose body that they are the open body's",
        )
    # Parameters beside a lone scan are used unchanged, unless the user asks for a registration that starts from them.
    registers = request.params is not None and config.register == "on"
    return BuildInputs(
        subject=request.scan.stem if isinstance(request.scan, Path) else "scan",
        scan=request.scan,
        params=None if registers or of_licensed_model else request.params,
        registers=registers,
        locates=request.params is None or of_licensed_model,
        frame=config.frame,
        params_row=config.frame,
        start=request.params if of_licensed_model else None,
        whose=config.whose,
        labels=request.labels,
        label_set="4ddress" if config.label_set == AUTO else config.label_set,
        label_source="body" if config.label_source == "body" else "auto",
        body=request.body_file,
    )


def _of_licensed_model(request: BuildRequest) -> bool:
    """Whether parameters of SMPL, SMPL-H or SMPL-X are given for the open body."""
    whose, params = request.config.whose, request.params
    if whose == "body" or (whose == AUTO and not isinstance(params, Path)):
        return False
    body = request.body if isinstance(request.body, BodyModel) else load_body(request.body)
    if not is_open_body(body):
        return False
    return whose != AUTO or (isinstance(params, Path) and family_of_params(params) is not None)


def _refuse_height(config: BuildConfig, received: str) -> None:
    if config.height is not None:
        raise InputError(
            "option height",
            expected="a scan alone, in which the body is searched",
            received=received,
            remedy="state the units instead: --units",
        )


def _registers(request: BuildRequest) -> bool:
    """Whether the parameters come from a registration of the capture."""
    root = request.root
    assert root is not None
    # The user's choice decides; without it an earlier registration is kept, so that repeated builds are equal.
    if request.config.register != AUTO:
        return request.config.register == "on"
    if _standing_registration(request) is not None:
        return True
    # The poses of a person who turns are found when the capture is made; its surface needs them before a registration.
    if _turns(request):
        _require_poses(request)
        return False
    # Parameters in memory are a fit already, and a capture without a folder has no declaration of its sources.
    if isinstance(request.params, BodyParams) or not root.is_dir():
        return False
    declared = DeclaredInputs.of_folder(root, request.protocol)
    # Estimated parameters only start a registration; exact ones are used unchanged.
    params = declared.own_parameters() if request.params is None else request.named_params
    if params is None or declared.given_parameters(params) == TRACKED:
        return True
    # Parameters of a licensed model start a registration of the open body, too.
    return _of_licensed_model(replace(request, params=params))


def _turns(request: BuildRequest) -> bool:
    """Whether the capture shows a person who turns before one camera."""
    if isinstance(request.capture, Capture):
        return request.capture.kind == TURNTABLE
    assert request.root is not None
    return request.root.is_dir() and read_description(request.root).get("kind") == TURNTABLE


def _require_poses(request: BuildRequest) -> None:
    """Refuse a capture of a person who turns without a pose a frame."""
    root = request.root
    assert root is not None
    if isinstance(request.capture, Capture):
        found = request.capture.recording.params is not None
    else:
        found = DeclaredInputs.of_folder(root, request.protocol).own_parameters() is not None
    if not found and request.params is None:
        raise InputError(
            f"capture {root.name}",
            expected="poses of the person who turns",
            received="none",
            remedy="make the capture with `smplxpp capture turntable`, which finds them",
        )


def _starts(request: BuildRequest, found: ReferenceFrame) -> bool:
    """Whether a registration has something to start from: a fit, keypoints, or an earlier registration."""
    root = request.root
    assert root is not None
    # Try the sources of a start from the best to the weakest: a fit, keypoints that are named, keypoints of the
    # capture.
    if found.params is not None or isinstance(request.params, BodyParams):
        return True
    if request.config.keypoints is not None or _standing_registration(request) is not None:
        return True
    files = choose_protocol(root, read_description(root), request.protocol)
    return files.keypoints is not None and (root / files.keypoints).is_dir()


def _standing_registration(request: BuildRequest) -> RegisterInputs | None:
    """The earlier registration, if it was of this capture and of these parameters, as far as any are named."""
    found, root = request.registration, request.root
    # Compare folders only: a capture that was opened in memory has no identity that lasts between builds.
    if found is None or root is None or not isinstance(found.capture, Path):
        return None
    if not same_place(found.capture, root) or found.protocol != request.protocol:
        return None
    # An earlier registration with other parameters was another fit, which must not be reused.
    params = request.named_params
    if params is None:
        return found
    return found if isinstance(found.params, Path) and same_place(params, found.params) else None


def _registration(request: BuildRequest, inputs: BuildInputs) -> RegisterInputs | None:
    """What the body is registered to, None where the parameters are given."""
    if not inputs.registers:
        return None
    config = resolved(request.config, inputs)
    # The scan to register to: the reconstructed one where the scan is made, else the file or mesh that the user
    # named.
    return _standing_registration(request) or RegisterInputs(
        capture=request.capture,
        params=request.params if isinstance(request.params, BodyParams) else request.named_params,
        protocol=request.protocol,
        body=request.body_file,
        scan=inputs.scan if inputs.reconstructs else request.scan,
        frame=config.frame,
        labels=inputs.labels,
        label_set=inputs.label_set,
        keypoints=config.keypoints,
        masks=config.masks,
        units=config.units,
        up=config.up,
    )


def _reconstruction(request: BuildRequest, inputs: BuildInputs) -> ReconstructInputs | None:
    """The photographs that the scan is made of, None where there is one; an earlier reconstruction stands.

    Raises:
        InputError: no cameras or no photographs of the frame, known before work starts.
    """
    if not inputs.reconstructs:
        return None
    found, root = request.reconstruction, request.root
    assert request.capture is not None and root is not None
    # An earlier surface is reused only if its file exists and its capture is in the same folder.
    made = isinstance(inputs.scan, Path) and inputs.scan.is_file()
    if found is not None and made and isinstance(found.capture, Path) and same_place(found.capture, root):
        return found
    asked = ReconstructInputs(
        request.capture,
        frames=(request.config.frame,),
        masks=request.config.masks,
        protocol=request.protocol,
        body=request.body_file,
    )
    # Open the capture and check cameras and frames now, because the reconstruction itself runs for minutes.
    capture = open_photographs(asked)
    usable_cameras(capture, ())
    usable_frames(capture, asked.frames)
    return asked


def _scan_labels(request: BuildRequest, found: ReferenceFrame) -> Path | None:
    """The labels that come with the scan, if they are used; None where label maps or the body decide.

    Raises:
        InputError: the labels that are asked for do not exist.
    """
    source, views, scan = request.config.label_source, bool(found.label_maps), found.scan_labels is not None
    # Labels that were asked for by name must exist; a protocol may forbid those that the capture has.
    if source in ("views", "scan") and not {"views": views, "scan": scan}[source]:
        barred = f", by protocol {request.protocol}" if request.protocol else ""
        raise InputError(
            f"capture {found.subject}",
            expected={"scan": "labels of the scan", "views": "label maps of its views"}[source],
            received=f"none for frame {found.frame}{barred}",
            remedy="name a file with --labels",
        )
    # Label maps are preferred to labels of the scan: the latter are ground truth in most data sets, and a person who
    # is recorded with cameras alone has none.
    if source == "body" or (views and source != "scan") or not scan:
        return None
    if source == AUTO:
        log.warning(
            "no label maps of frame %d: the labels that come with the scan are used, which are no estimate",
            found.frame,
        )
    return found.scan_labels


def check_inputs(inputs: BuildInputs, body: BodyModel | None = None, *, config: BuildConfig | None = None) -> BodyModel:
    """Refuse what can be known before the first step: missing files, and files that only the last steps read.

    Args:
        inputs: of the build.
        body: the model, where it is in memory.
        config: choices of the build, whose parts and joints are looked up; None: they are not.

    Returns:
        The body model.

    Raises:
        InputError: it names the option.
    """
    # A reconstructed scan does not exist yet, so that its file is not looked for.
    for name in ("scan", "params", "start", "labels", "cameras", "motion", "body"):
        value = None if name == "scan" and inputs.reconstructs else getattr(inputs, name)
        if isinstance(value, Path) and not value.exists():
            raise InputError(f"option {name}", expected="an existing file", received=str(value))
    # Label maps are images; without a projection they say nothing about the scan's faces.
    if inputs.label_maps and inputs.cameras is None:
        raise InputError(
            "label maps",
            expected="a camera file with them",
            received="none",
            remedy="put cameras.json or calibration.csv into the capture",
        )
    # Look up labels and the motion for their errors: both are read by the last steps only.
    _check_label_ids(inputs)
    model = load_body(inputs.body) if body is None else body
    given_motion(inputs, model)
    if config is not None:
        labels = inputs.labels_used
        config.check_parts(labels)
        rules = {f"rule of label {label.name!r}": label.rule for label in labels}
        rules |= {f"option rules: {name}": rule for name, rule in config.rules.items()}
        for subject, rule in rules.items():
            for joint in PartRule.parse(rule, subject=subject).joints:
                require_choice(f"{subject}: joint", joint, model.joint_names)
    return model


def _check_label_ids(inputs: BuildInputs) -> None:
    """Refuse a label set that is none, and ids in label maps and arrays of labels that it does not have."""
    label_set, labels = find_label_set(inputs.label_set), inputs.labels
    if isinstance(labels, Path) and labels.suffix.lower() in (".yaml", ".yml"):
        raise InputError(
            "option labels",
            expected="labels of the scan's vertices or faces",
            received=labels.name,
            remedy="a labels.yaml describes a label set: name it with --label-set",
        )
    if isinstance(labels, np.ndarray):
        map_labels(np.unique(labels), label_set)
    elif labels is not None:
        check_label_ids(labels, label_set)
    for path in inputs.label_maps.values():
        read_label_map(path, label_set=label_set)


def given_motion(inputs: BuildInputs, body: BodyModel) -> BodyParams | None:
    """Return the motion of the capture that the inputs name, None where they name none."""
    if isinstance(inputs.motion, Path):
        return load_params(inputs.motion, body=body, whose=inputs.whose)
    return inputs.motion
