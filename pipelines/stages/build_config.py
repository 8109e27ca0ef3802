"""What a build takes: its inputs and every choice that changes its result."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from pipelines.runs.artefacts import values_of
from pipelines.runs.layout import BUILD_FILE, LOCATE_STAGE, RECONSTRUCT_STAGE, REGISTER_STAGE, TEMPLATE_STAGES
from pipelines.runs.manifest import require_plain_fields
from smplxpp.assemble import DarnConfig
from smplxpp.clean import WebConfig
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.paths import absolute
from smplxpp.core.labels import LABELS

log = logging.getLogger(__name__)
MOST_PHOTOGRAPHS = 8
"""Photographs of the reference frame that a build looks at: a few from all around tell left from right."""


def _default_budgets() -> dict[str, int]:
    return {label.name: label.face_budget for label in LABELS if label.face_budget}


@dataclass(frozen=True)
class BuildInputs:
    """Files of one build.

    Attributes:
        subject: name used in the report.
        scan: clothed scan of the reference frame.
        params: body parameters; None: those that the run's registration gives, or what is found in the scan.
            params_row: the frame's row in a file that stacks several.
        reconstructs: whether the scan is one that the run makes of photographs. locates: whether the body has to be
            found in the scan. registers: whether the parameters come from a registration.
        frame: number of the frame in its capture: what trainings take its photographs by.
        labels: labels of the scan's vertices or faces (npz, npy, pickle), or None when the scan file holds them,
            views do, or the fitted body is to tell them. label_source: "auto" takes what there is, in this order;
            "body" looks at no labels.
        label_maps: label image by camera name, with `cameras` their camera file.
        photographs: image of the frame by camera name, of the same cameras: what a mirrored scan is told by.
        label_set: name of the label set that labels and label maps use, or a JSON mapping file.
        motion: parameters of the capture's own frames, for validation and the report; may be None.
        body: SMPL-X-layout body file, None for the open body.
        protocol: of the capture, by which these files were found; None: without one.
    """

    subject: str
    scan: Path
    params: Path | None
    frame: int = 0
    params_row: int = 0
    labels: Path | None = None
    label_maps: dict[str, Path] = field(default_factory=dict)
    photographs: dict[str, Path] = field(default_factory=dict)
    cameras: Path | None = None
    label_set: str = "4ddress"
    label_source: str = "auto"
    reconstructs: bool = False
    locates: bool = False
    registers: bool = False
    motion: Path | None = None
    body: Path | None = None
    protocol: str | None = None

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of the build, in order: those that make parameters where they are to be made."""
        makers = (
            (RECONSTRUCT_STAGE, self.reconstructs),
            (LOCATE_STAGE, self.locates),
            (REGISTER_STAGE, self.registers),
        )
        return (*(name for name, needed in makers if needed), *TEMPLATE_STAGES)


@dataclass(frozen=True)
class BuildConfig:
    """Choices of one build; part of every stage's key.

    Attributes:
        units, up: how the scan file is written; it is converted to metres, +Y up.
        detector: asked which way a person faces whose scan comes alone: "mediapipe" or an ONNX file; None: nobody.
        budgets: faces kept by part name. remesh: what they are made by, "quadric" or "isotropic".
        clearance_mm: how far outer layers are kept from inner ones.
        max_influences: joints a vertex.
        webs: what of a part is cut because it bridges two limbs; no `rounds`: nothing is.
        darning: which of the holes that this leaves are closed.
        method: "ours", or "paper" for robust transfer exactly as published.
        samples: surface samples of the validation.
        seed: of the samples.
    """

    units: str = "m"
    up: str = "y"
    detector: str | None = None
    budgets: dict[str, int] = field(default_factory=_default_budgets)
    remesh: str = "quadric"
    clearance_mm: float = 1.0
    max_influences: int = 8
    webs: WebConfig = field(default_factory=WebConfig)
    darning: DarnConfig = field(default_factory=DarnConfig)
    method: str = "ours"
    samples: int = 100_000
    seed: int = 0


@dataclass(frozen=True)
class BuildContext:
    """What the stages of a build work on.

    Attributes:
        run: folder of the run, in which the stages before stand.
    """

    run: Path
    inputs: BuildInputs
    config: BuildConfig


_PATHS = ("scan", "params", "labels", "cameras", "motion", "body")


def save_build(run: Path, inputs: BuildInputs, config: BuildConfig) -> None:
    """Write `build.json` into a run, unless it says the same already."""

    def plain(value: Any) -> Any:
        if isinstance(value, Path):
            return str(absolute(value))
        return {k: plain(v) for k, v in value.items()} if isinstance(value, dict) else value

    content = {"inputs": plain(asdict(inputs)), "config": asdict(config)}
    text, path = json.dumps(content, indent=1) + "\n", run / BUILD_FILE
    if not path.is_file() or path.read_bytes() != text.encode():
        atomic_write_text(path, text)


def load_build(run: Path) -> tuple[BuildInputs, BuildConfig] | None:
    """What `save_build` wrote; None where there is none, or none that this version can read, which is logged.

    Optional inputs that are gone are left out.
    """
    path = run / BUILD_FILE
    if not path.exists():
        return None
    try:
        content = read_json(path)
        with values_of(path):
            return _inputs(content["inputs"]), _config(content["config"])
    except InputError as error:
        log.warning("%s counts as a run that does not say what it was built from: %s", run, error)
        return None


def _config(values: Mapping[str, Any]) -> BuildConfig:
    require_plain_fields(BuildConfig, values, subject=BUILD_FILE)
    webs, darning = values.get("webs", {}), values.get("darning", {})
    require_plain_fields(WebConfig, webs, subject=BUILD_FILE)
    require_plain_fields(DarnConfig, darning, subject=BUILD_FILE)
    return BuildConfig(**{**values, "webs": WebConfig(**webs), "darning": DarnConfig(**darning)})


def _inputs(written: Mapping[str, Any]) -> BuildInputs:
    # Builds of earlier versions had no protocols, looked at no photographs, and registered what they were not given.
    added: dict[str, Any] = {
        "protocol": None,
        "photographs": {},
        "label_source": "auto",
        "reconstructs": False,
        "locates": False,
    }
    values = {**added, **written}
    values = {"registers": values.get("params") is None, **values}
    require_plain_fields(BuildInputs, values, subject=BUILD_FILE)
    found: dict[str, Any] = {f.name: values[f.name] for f in fields(BuildInputs)}
    found |= {name: Path(values[name]) for name in _PATHS if values[name] is not None}
    for name in ("labels", "cameras", "motion"):
        if found[name] is not None and not found[name].exists():
            found[name] = None
    for kind in ("label_maps", "photographs"):
        found[kind] = {name: Path(path) for name, path in values[kind].items()}
    return BuildInputs(**found)
