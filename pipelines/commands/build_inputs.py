"""Which files a build takes: those that were named, what a capture has, and what the run has to make itself."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.runs.layout import REGISTER_STAGE, reconstructed_scan
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import MOST_PHOTOGRAPHS, BuildInputs
from pipelines.stages.photographed import open_photographs, usable_cameras, usable_frames
from pipelines.stages.reconstruct_config import ReconstructInputs, load_reconstruct
from pipelines.stages.register_config import RegisterInputs, load_register, named_params
from pipelines.stages.said_of_inputs import TRACKED, SaidOfInputs
from smplxpp.capture import ReferenceFrame, find_reference
from smplxpp.capture.protocols import choose_protocol, read_description
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import same_place
from smplxpp.core.spread import spread

if TYPE_CHECKING:
    from pipelines.commands.build import Build

log = logging.getLogger(__name__)


def chosen_inputs(asked: Build) -> BuildInputs:
    """The files of this build.

    Raises:
        InputError: neither or both ways of naming the input, or files that a capture lacks.
    """
    if (asked.capture is None) == (asked.scan is None):
        raise InputError(
            "input",
            expected="either --capture or --scan",
            received="both" if asked.capture else "neither",
        )
    return _of_scan(asked) if asked.capture is None else _of_capture(asked)


def _of_capture(asked: Build) -> BuildInputs:
    """What a capture has; a scan that it has not is reconstructed, parameters that it has not are registered."""
    assert asked.capture is not None
    registered = _registers(asked)
    found = find_reference(
        asked.capture,
        frame=asked.frame,
        params=asked.params,
        protocol=asked.protocol,
        fitted=not registered,
        scanned=False,
    )
    labels = asked.labels or _scan_labels(asked, found)
    by_body = asked.label_source == "body"
    return BuildInputs(
        subject=found.subject,
        scan=found.scan or asked.out / reconstructed_scan(found.frame),
        params=None if registered else found.params,
        reconstructs=found.scan is None,
        locates=registered and not _starts(asked, found),
        registers=registered,
        frame=found.frame,
        params_row=found.params_frame,
        labels=labels,
        label_maps={} if labels or by_body else found.label_maps,
        photographs=dict(spread(list(found.photographs.items()), MOST_PHOTOGRAPHS)),
        cameras=found.cameras_file if found.photographs or not labels else None,
        label_set="capture" if asked.label_set == "auto" else asked.label_set,
        label_source="body" if by_body else "auto",
        motion=None if registered else found.motion,
        body=asked.body,
        protocol=asked.protocol,
    )


def _of_scan(asked: Build) -> BuildInputs:
    """A scan with what is known of it.

    Raises:
        InputError: options that are a capture's.
    """
    for name in ("protocol", "keypoints", "masks"):
        if getattr(asked, name) is not None:
            raise InputError(f"option {name}", expected="with --capture", received="with --scan")
    assert asked.scan is not None
    registers = asked.params is not None and asked.register == "on"
    return BuildInputs(
        subject=asked.scan.stem,
        scan=asked.scan,
        params=None if registers else asked.params,
        registers=registers,
        locates=asked.params is None,
        frame=asked.frame,
        params_row=asked.frame,
        labels=asked.labels,
        label_set="4ddress" if asked.label_set == "auto" else asked.label_set,
        label_source="body" if asked.label_source == "body" else "auto",
        body=asked.body,
    )


def _registers(asked: Build) -> bool:
    """Whether the parameters come from a registration of the capture."""
    assert asked.capture is not None
    if asked.register != "auto":
        return asked.register == "on"
    if _standing_registration(asked) is not None:
        return True
    if not asked.capture.is_dir():
        return False
    said = SaidOfInputs.of_folder(asked.capture, asked.protocol)
    params = said.own_parameters() if asked.params is None else named_params(asked.capture, asked.params)
    return params is None or said.given_parameters(params) == TRACKED


def _starts(asked: Build, found: ReferenceFrame) -> bool:
    """Whether a registration has something to start from: a fit, keypoints, or that it stands."""
    assert asked.capture is not None
    if found.params is not None or asked.keypoints is not None or _standing_registration(asked) is not None:
        return True
    files = choose_protocol(asked.capture, read_description(asked.capture), asked.protocol)
    return files.keypoints is not None and (asked.capture / files.keypoints).is_dir()


def _standing_registration(asked: Build) -> RegisterInputs | None:
    """What `smplxpp register` has made in this run of this capture, from these parameters if any are named."""
    found = load_register(asked.out)
    if (
        found is None
        or found.capture is None
        or asked.capture is None
        or read_manifest(asked.out / REGISTER_STAGE) is None
    ):
        return None
    params = named_params(asked.capture, asked.params)
    same = same_place(found.capture, asked.capture) and found.protocol == asked.protocol
    return (
        found if same and (params is None or (found.params is not None and same_place(params, found.params))) else None
    )


def chosen_registration(asked: Build, inputs: BuildInputs) -> RegisterInputs | None:
    """What the body is registered to, None where the parameters are given."""
    if not inputs.registers:
        return None
    return _standing_registration(asked) or RegisterInputs(
        capture=asked.capture,
        params=named_params(asked.capture, asked.params),
        protocol=asked.protocol,
        body=asked.body,
        scan=inputs.scan if inputs.reconstructs else asked.scan,
        frame=asked.frame,
        labels=inputs.labels,
        label_set=inputs.label_set,
        keypoints=asked.keypoints,
        masks=asked.masks,
        units="m" if asked.units == "auto" else asked.units,
        up="y" if asked.up == "auto" else asked.up,
    )


def chosen_reconstruction(asked: Build, inputs: BuildInputs) -> ReconstructInputs | None:
    """The photographs that the scan is made of, None where there is one; what `smplxpp reconstruct` has made of
    this frame stands.

    Raises:
        InputError: no cameras or no photographs of the frame, known before work starts.
    """
    if not inputs.reconstructs:
        return None
    assert asked.capture is not None
    found = load_reconstruct(asked.out)
    if found is not None and inputs.scan.is_file() and same_place(found.capture, asked.capture):
        return found
    photographed = ReconstructInputs(asked.capture, frames=(asked.frame,), masks=asked.masks, protocol=asked.protocol)
    capture = open_photographs(photographed)
    usable_cameras(capture, ())
    usable_frames(capture, photographed.frames)
    return photographed


def _scan_labels(asked: Build, found: ReferenceFrame) -> Path | None:
    """The labels that come with the scan, if they are used; None where the views' label maps are, or the body's.

    Raises:
        InputError: the labels that are asked for are not there.
    """
    views, scan = bool(found.label_maps), found.scan_labels is not None
    if asked.label_source in ("views", "scan") and not {"views": views, "scan": scan}[asked.label_source]:
        barred = f", by protocol {asked.protocol}" if asked.protocol else ""
        raise InputError(
            f"capture {found.subject}",
            expected={"scan": "labels of the scan", "views": "label maps of its views"}[asked.label_source],
            received=f"none for frame {found.frame}{barred}",
            remedy="name a file with --labels",
        )
    if asked.label_source == "body" or (views and asked.label_source != "scan") or not scan:
        return None
    if asked.label_source == "auto":
        log.warning(
            "no label maps of frame %d: the labels that come with the scan are used, which are no estimate",
            found.frame,
        )
    return found.scan_labels
