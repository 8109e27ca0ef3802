"""What is known of the inputs behind an evaluation: said by the capture, by the build and by the trainings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avatar.evaluation.input_protocol import EXACT, MIXED, NOT_KNOWN, TRACKED, InputProtocol
from pipelines.runs.layout import REFINED_PARAMS, REGISTERED_PARAMS, TRAIN_STAGES
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import BuildInputs, load_build
from pipelines.stages.scene import normal_maps
from smplxpp.capture import Capture
from smplxpp.capture.params import ParamFiles, StackedParams
from smplxpp.capture.protocols import ProtocolFiles, description_file, read_description, read_protocols
from smplxpp.capture.readers import simple
from smplxpp.capture.recording import ParamSource
from smplxpp.core.errors import InputError

OWN_PARAMETERS = "params.npz"
"""The capture's own parameters in what it says; files of single frames go by this name too."""
MADE_BY = {REGISTERED_PARAMS: "registered", REFINED_PARAMS: "refined"}
"""Parameters that a run makes, and by what."""
WORDS = {EXACT: "true", TRACKED: "estimated"}
"""What labels and normals are that a protocol of this name has."""


def input_protocol(run: Path, capture: Capture) -> InputProtocol:
    """Collect what capture, build and trainings say of the inputs; "not known" for whatever none of them says.

    A capture speaks for its own files alone: for the parameters that lie in it, and for the labels of a template that
    was built from it. It says what a file is by the file's name under "inputs", or by naming it in a protocol that is
    called exact or tracked. Parameters that the run made are tracked, if what they began with was.

    Raises:
        InputError: a capture that says it in other words than docs/captures.md.
    """
    said = _Said.of(capture)
    build = load_build(run)
    parameters, stage = said.parameters(run, _path(capture.recording.params))
    if build is not None and said.parameters(run, build[0].params)[0] != parameters:
        of_template = said.parameters(run, build[0].params)[0]
        parameters = NOT_KNOWN if NOT_KNOWN in (parameters, of_template) else MIXED
    used, frames, cameras = _trained(run)
    there, all_views = normal_maps(capture)
    if used == "surface":
        normals = "estimated"
    else:
        normals = "none" if not there or used == "none" else said.of_views("normals", _folder(capture, "normal"))
    return InputProtocol(
        parameters=parameters,
        stage=stage,
        labels=NOT_KNOWN if build is None else said.labels(build[0]),
        normals=normals,
        views_with_normals=there,
        training_views=all_views,
        training_frames=frames,
        training_cameras=cameras,
    )


@dataclass(frozen=True)
class _Said:
    """What a capture of our own layout says of its files.

    Attributes:
        root: its folder. inputs: what it says under "inputs". protocols: by name. protocol: the one that is read.
    """

    root: Path
    inputs: Mapping[str, Any]
    protocols: Mapping[str, ProtocolFiles]
    protocol: str | None

    @staticmethod
    def of(capture: Capture) -> _Said:
        root = capture.root
        description = read_description(root) if capture.format == simple.NAME else {}
        said = description.get("inputs", {})
        if not isinstance(said, Mapping):
            raise InputError(
                f"file {description_file(root)}",
                expected='an object under "inputs", see docs/captures.md',
                received=repr(said),
            )
        return _Said(root, said, read_protocols(description), capture.protocol)

    def parameters(self, run: Path, path: Path | None) -> tuple[str, str]:
        """The word for parameters in a file or folder, and what the run made them by."""
        if path is None:
            return NOT_KNOWN, ""
        for file, stage in MADE_BY.items():
            if path.resolve() == (run / file).resolve():
                return self._made_from(), stage
        folder = (self.root / "params").resolve()
        if path.resolve() == folder or path.stem.isdigit():
            name, inside = OWN_PARAMETERS, folder in (path.resolve(), path.resolve().parent)
        else:
            name, inside = path.name, path.resolve() == folder / path.name
        return (self._word("parameters", name, OWN_PARAMETERS) if inside else NOT_KNOWN), ""

    def _made_from(self) -> str:
        """The word for parameters that a run made, by what they began with: keypoints alone, or a fit."""
        files = self.protocols.get(self.protocol or "", ProtocolFiles())
        name = files.parameters if self.protocol else OWN_PARAMETERS
        if name is None or not (self.protocol or (self.root / "params").is_dir()):
            return TRACKED
        began = self._word("parameters", name, OWN_PARAMETERS)
        return MIXED if began == EXACT else began

    def labels(self, build: BuildInputs) -> str:
        """The word for the labels that a template was built with."""
        root = self.root.resolve()
        sources = list(build.label_maps.values()) or [build.labels or build.scan]
        if not all(path.exists() and path.resolve().is_relative_to(root) for path in sources):
            return NOT_KNOWN
        if build.label_maps:
            return self.of_views("labels", next(iter(build.label_maps.values())).parent.parent.name)
        word = self._word("labels", "labels", "labels")
        return "true" if word == NOT_KNOWN and any(one.scan_labels for one in self._named(EXACT)) else word

    def of_views(self, kind: str, folder: str | None) -> str:
        """The word for label or normal maps in a folder."""
        return NOT_KNOWN if folder is None else self._word(kind, folder, kind)

    def _word(self, kind: str, name: str, default: str) -> str:
        """What is said of a file or folder by its name; one word for all stands for the default one."""
        said = self.inputs.get(kind)
        if isinstance(said, Mapping) and name in said:
            return str(said[name])
        if said is not None and not isinstance(said, Mapping) and name == default:
            return str(said)
        for protocol in (EXACT, TRACKED):
            if any(getattr(one, kind) == name for one in self._named(protocol)):
                return protocol if kind == "parameters" else WORDS[protocol]
        return NOT_KNOWN

    def _named(self, name: str) -> list[ProtocolFiles]:
        return [one for key, one in self.protocols.items() if key == name]


def _path(source: ParamSource | None) -> Path | None:
    """The file or folder that parameters are read from."""
    if isinstance(source, StackedParams):
        return source.path
    return source.files.folder if isinstance(source, ParamFiles) else None


def _folder(capture: Capture, kind: str) -> str | None:
    """Name of the folder with the maps of a kind."""
    series = next(iter(capture.recording.files.get(kind, {}).values()), None)
    return None if series is None else series.folder.parent.name


def _trained(run: Path) -> tuple[str | None, int | None, int | None]:
    """Source of the normals, and frames and cameras, of the last training that is in the run."""
    for stage in reversed(TRAIN_STAGES):
        numbers = (read_manifest(run / stage) or {}).get("numbers", {})
        if "training_frames" in numbers and "training_cameras" in numbers:
            return numbers.get("normals"), numbers["training_frames"], numbers["training_cameras"]
    return None, None, None
