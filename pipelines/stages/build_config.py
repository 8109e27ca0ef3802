"""Read and write the records of the inputs and choices of a run's build, registration and reconstruction."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from pipelines.runs.artefacts import values_of
from pipelines.runs.code import sha256_file
from pipelines.runs.folders import require_plain_fields
from pipelines.runs.layout import BUILD_FILE, BUILD_STAGES, RECONSTRUCT_FILE, REGISTER_FILE
from pipelines.runs.stage import read_manifest
from smplxpp.assemble import FillHolesConfig
from smplxpp.build.config import BuildConfig, BuildInputs, ReconstructInputs, RegisterInputs
from smplxpp.clean import BridgeConfig
from smplxpp.core.errors import InputError
from smplxpp.core.files import as_integer, as_list, as_object, as_text, atomic_write_text, read_json
from smplxpp.core.files.paths import absolute

log = logging.getLogger(__name__)
_T = TypeVar("_T")
# Fields that are paths, by the record that they stand in.
_BUILD_PATHS = ("scan", "params", "start", "labels", "cameras", "motion", "body")
_CHOICE_PATHS = ("keypoints", "masks", "landmarks", "corrections")
_REGISTER_PATHS = ("capture", "params", "body", "scan", "labels", "keypoints", "masks", "scans", "shape")
_RECONSTRUCT_PATHS = ("capture", "masks", "mesh", "body")


@dataclass(frozen=True)
class BuildContext:
    """Run folder, inputs and choices that the stages of a build share.

    Attributes:
        run: folder of the run, which holds the earlier stages.
        inputs: files to read.
        config: choices of the stages.
    """

    run: Path
    inputs: BuildInputs
    config: BuildConfig


def stages_of(inputs: BuildInputs) -> tuple[str, ...]:
    """Return the stages of a build in order, including those that make inputs the user has not given."""
    return tuple(stage for stage in BUILD_STAGES if stage.partition("_")[2] in inputs.steps)


def save_build(run: Path, inputs: BuildInputs, config: BuildConfig) -> None:
    """Write `build.json` into a run, unless the file has the same content."""
    content = {"run": _plain(run), "inputs": _plain(asdict(inputs)), "config": _plain(asdict(config))}
    text, path = json.dumps(content, indent=1) + "\n", run / BUILD_FILE
    if not path.is_file() or path.read_bytes() != text.encode():
        atomic_write_text(path, text)


def load_build(run: Path, *, capture: Path | None = None) -> tuple[BuildInputs, BuildConfig] | None:
    """Read what `save_build` wrote; None without a record, or (with a warning) for one that cannot be read.

    Inputs are found again where run and capture were moved together, or in `capture`, where it was moved alone.
    Optional inputs whose files are missing are left out.
    """

    def parsed(content: Mapping[str, Any]) -> tuple[BuildInputs, BuildConfig]:
        return _build_inputs(content["inputs"]), _build_config(content["config"])

    return _load(run / BUILD_FILE, parsed, "%s is treated as a run without a record of its inputs: %s", capture=capture)


def save_register(run: Path, inputs: RegisterInputs) -> None:
    """Write the inputs of a registration to a run's `register.json`."""
    _save_inputs(run, REGISTER_FILE, inputs)


def load_register(run: Path) -> RegisterInputs | None:
    """Read what `save_register` wrote; None where there is none, or none that can be read, which is logged."""

    def parsed(values: Mapping[str, Any]) -> RegisterInputs:
        require_plain_fields(RegisterInputs, values, subject=REGISTER_FILE)
        return RegisterInputs(
            **{**values, **_label_set(values), **_paths(values, _REGISTER_PATHS), **_frames_and_cameras(values)}
        )

    warning = "%s is treated as a run without a registration by `smplxpp register`: %s"
    return _load(run / REGISTER_FILE, parsed, warning)


def save_reconstruct(run: Path, inputs: ReconstructInputs) -> None:
    """Write the inputs of a reconstruction to a run's `reconstruct.json`."""
    atomic_write_text(
        run / RECONSTRUCT_FILE, json.dumps({"run": _plain(run), **_plain(asdict(inputs))}, indent=1) + "\n"
    )


def _save_inputs(run: Path, name: str, inputs: RegisterInputs | ReconstructInputs) -> None:
    content = {"run": _plain(run), **_plain(asdict(inputs))}
    atomic_write_text(run / name, json.dumps(content, indent=1) + "\n")


def load_reconstruct(run: Path) -> ReconstructInputs | None:
    """Read what `save_reconstruct` wrote; None where there is none, or none that can be read, which is logged."""

    def parsed(values: Mapping[str, Any]) -> ReconstructInputs:
        require_plain_fields(ReconstructInputs, values, subject=RECONSTRUCT_FILE)
        return ReconstructInputs(**{**values, **_paths(values, _RECONSTRUCT_PATHS), **_frames_and_cameras(values)})

    return _load(run / RECONSTRUCT_FILE, parsed, "%s is treated as a run without a reconstruction: %s")


def _load(
    path: Path, parsed: Callable[[dict[str, Any]], _T], warning: str, *, capture: Path | None = None
) -> _T | None:
    """Parse a record; None without one, or for one that cannot be read, with this warning in the log."""
    if not path.exists():
        return None
    try:
        values = as_object(read_json(path), subject=f"file {path}")
        with values_of(path):
            written = values.pop("run", None)
            if written is not None:
                before = Path(as_text(written, subject=f"{path.name}: run"))
                values = _found_again(values, before, absolute(path.parent), capture)
            return parsed(values)
    except InputError as error:
        # An unreadable record must not block the run, whose stages can be made again without it.
        log.warning(warning, path.parent, error)
        return None


def _found_again(value: Any, written: Path, run: Path, capture: Path | None) -> Any:
    """Return a value whose absolute paths are looked for where they lie now, if they are not there any more.

    Run and inputs that were moved together still lie beside each other. A capture that was moved alone is named by the
    user; a file in it is the same file if a stage of the build has recorded its SHA-256.

    Args:
        written: folder of the run when the record was written.
        run: folder of the run now.
        capture: folder of the capture now; None: not known.
    """
    if isinstance(value, dict):
        return {key: _found_again(one, written, run, capture) for key, one in value.items()}
    if not isinstance(value, str) or not os.path.isabs(value) or os.path.exists(value):
        return value
    beside = os.path.normpath(run / os.path.relpath(value, written))
    if os.path.exists(beside):
        return beside
    # The longest end of the path that is a file of the capture.
    ends = (
        () if capture is None else (capture.joinpath(*Path(value).parts[k:]) for k in range(1, len(Path(value).parts)))
    )
    file = next((end for end in ends if end.is_file()), None)
    if file is None:
        return value
    manifests = [read_manifest(run / stage) or {} for stage in BUILD_STAGES]
    known = {digest for manifest in manifests for digest in manifest.get("inputs", {}).values()}
    return str(file) if sha256_file(file) in known else value


def _plain(value: Any) -> Any:
    """Return a value whose paths are replaced by absolute paths as text."""
    if isinstance(value, Path):
        return str(absolute(value))
    return {k: _plain(v) for k, v in value.items()} if isinstance(value, dict) else value


def _paths(values: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Path]:
    """Return the fields among `names` that are given, as paths."""
    return {name: Path(values[name]) for name in names if values.get(name) is not None}


def _label_set(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the name or the file of the label set; records of earlier versions may have none."""
    return {"label_set": as_text(values["label_set"], subject="label_set")} if "label_set" in values else {}


def _frames_and_cameras(values: Mapping[str, Any]) -> dict[str, Any]:
    """Parse the numbers of frames (None for all) and the names of held-out cameras."""
    frames = values["frames"]
    if frames is not None:
        frames = tuple(as_integer(frame, subject="frames") for frame in as_list(frames, subject="frames"))
    names = as_list(values["hold_out"], subject="hold_out")
    return {"frames": frames, "hold_out": tuple(as_text(name, subject="hold_out") for name in names)}


def _build_config(values: Mapping[str, Any]) -> BuildConfig:
    # Builds of earlier versions have other names for two settings.
    earlier = {"webs": "bridges", "darning": "fill_holes"}
    values = {earlier.get(name, name): value for name, value in values.items()}
    require_plain_fields(BuildConfig, values, subject=BUILD_FILE)
    bridges, holes = values.get("bridges", {}), values.get("fill_holes", {})
    require_plain_fields(BridgeConfig, bridges, subject=BUILD_FILE)
    require_plain_fields(FillHolesConfig, holes, subject=BUILD_FILE)
    made = {"bridges": BridgeConfig(**bridges), "fill_holes": FillHolesConfig(**holes)}
    return BuildConfig(**{**values, **_label_set(values), **_paths(values, _CHOICE_PATHS), **made})


def _build_inputs(written: Mapping[str, Any]) -> BuildInputs:
    # Builds of earlier versions had no protocols and no photographs, and registered what was not given.
    added: dict[str, Any] = {
        "protocol": None,
        "photographs": {},
        "label_source": "auto",
        "reconstructs": False,
        "locates": False,
        "start": None,
        "whose": "auto",
    }
    values = {**added, **written}
    values = {"registers": values.get("params") is None, **values}
    require_plain_fields(BuildInputs, values, subject=BUILD_FILE)
    found: dict[str, Any] = {f.name: values[f.name] for f in fields(BuildInputs)}
    found |= {name: Path(values[name]) for name in _BUILD_PATHS if values[name] is not None}
    # Later stages can do without these files. A run that was moved without them stays readable.
    for name in ("labels", "cameras", "motion"):
        if found[name] is not None and not found[name].exists():
            found[name] = None
    for kind in ("label_maps", "photographs"):
        found[kind] = {name: Path(path) for name, path in values[kind].items()}
    return BuildInputs(**found | _label_set(values))
