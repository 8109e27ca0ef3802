"""What a registration takes, and its record in the run."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipelines.runs.artefacts import values_of
from pipelines.runs.layout import REGISTER_FILE
from pipelines.runs.manifest import require_plain_fields
from smplxpp.capture.readers.simple import stacked_params
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_integer, as_list, as_object, as_text, read_json
from smplxpp.core.files.paths import absolute

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RegisterInputs:
    """Where a registration takes its observations from: a capture, or one scan.

    Attributes:
        capture: folder of any known layout.
        keypoints, masks: folders of the cameras' keypoints and masks, in the place of the capture's own. scans: folder
            of a scan a frame, likewise.
        params: the fit to start from, in the place of the capture's own.
        start: False: no fit is looked at, keypoints are where it begins.
        protocol: name of the capture's files that are read, None without one.
        frames: numbers, None for all that are trained on or held out.
        hold_out: cameras that are not looked at, in the place of those that the capture holds out.
        body: SMPL-X-layout body file, None for the open body.
        scan: the reference frame's scan, in the place of the capture's. frame: its number.
        labels: of that scan's vertices or faces; None: votes of the frame's label maps.
        label_set: of the scan's labels. units, up: how scans are written.
        seed: of the points that are sampled.
    """

    capture: Path | None = None
    params: Path | None = None
    start: bool = True
    protocol: str | None = None
    frames: tuple[int, ...] | None = None
    hold_out: tuple[str, ...] = ()
    body: Path | None = None
    scan: Path | None = None
    frame: int = 0
    labels: Path | None = None
    label_set: str = "capture"
    units: str = "m"
    up: str = "y"
    seed: int = 0
    keypoints: Path | None = None
    masks: Path | None = None
    scans: Path | None = None


def named_params(capture: Path | None, params: Path | None) -> Path | None:
    """The file or folder that a user means by parameters: by path, or by its name in the capture's `params/`."""
    return stacked_params(capture, params) if params is not None and capture is not None else params


_PATHS = ("capture", "params", "body", "scan", "labels", "keypoints", "masks", "scans")


def save_register(run: Path, inputs: RegisterInputs) -> None:
    """Write `register.json` into a run."""
    values = {key: str(absolute(value)) if isinstance(value, Path) else value for key, value in asdict(inputs).items()}
    atomic_write_text(run / REGISTER_FILE, json.dumps(values, indent=1) + "\n")


def load_register(run: Path) -> RegisterInputs | None:
    """What `save_register` wrote; None where there is none, or none that this version can read, which is logged."""
    path = run / REGISTER_FILE
    if not path.exists():
        return None
    try:
        values = as_object(read_json(path), subject=f"file {path}")
        with values_of(path):
            return _inputs(values)
    except InputError as error:
        log.warning("%s counts as a run without a registration by `smplxpp register`: %s", run, error)
        return None


def _inputs(values: dict[str, Any]) -> RegisterInputs:
    require_plain_fields(RegisterInputs, values, subject=REGISTER_FILE)
    frames, hold_out = values["frames"], as_list(values["hold_out"], subject="hold_out")
    if frames is not None:
        frames = tuple(as_integer(frame, subject="frames") for frame in as_list(frames, subject="frames"))
    found = values | {key: Path(values[key]) for key in _PATHS if values.get(key) is not None}
    found |= {"frames": frames, "hold_out": tuple(as_text(name, subject="hold_out") for name in hold_out)}
    return RegisterInputs(**found)
