"""What a capture says of its own inputs: exact or tracked parameters, true or estimated labels and normals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avatar.evaluation.input_protocol import EXACT, MIXED, NOT_KNOWN, TRACKED
from pipelines.runs.folders import lies_in, same_place
from pipelines.runs.layout import REFINE_STAGE, REFINED_PARAMS, REGISTERED_PARAMS
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import BuildInputs
from pipelines.stages.register_config import load_register
from pipelines.stages.segment import label_source
from smplxpp.capture import Capture
from smplxpp.capture.protocols import ProtocolFiles, description_file, read_description, read_protocols
from smplxpp.capture.readers import simple
from smplxpp.capture.recording import ParamSource
from smplxpp.capture.sources import ParamFiles, StackedParams
from smplxpp.core.errors import InputError

OWN_PARAMETERS = "params.npz"
"""The capture's own parameters in what it says; files of single frames go by this name too."""
MADE_BY = {REGISTERED_PARAMS: "registered", REFINED_PARAMS: "refined"}
"""Parameters that a run makes, and by what."""
WORDS = {EXACT: "true", TRACKED: "estimated"}
"""What labels and normals are that a protocol of this name has."""


@dataclass(frozen=True)
class SaidOfInputs:
    """What a capture of our own layout says of its files.

    Attributes:
        root: its folder. inputs: what it says under "inputs". protocols: by name. protocol: the one that is read.
    """

    root: Path
    inputs: Mapping[str, Any]
    protocols: Mapping[str, ProtocolFiles]
    protocol: str | None

    @staticmethod
    def of(capture: Capture) -> SaidOfInputs:
        """Of an open capture.

        Raises:
            InputError: a capture that says it in other words than docs/captures.md.
        """
        if capture.format != simple.NAME:
            return SaidOfInputs(capture.root, {}, {}, capture.protocol)
        return SaidOfInputs.of_folder(capture.root, capture.protocol)

    @staticmethod
    def of_folder(root: Path, protocol: str | None) -> SaidOfInputs:
        """Of a folder in our layout; nothing where it says nothing."""
        description = read_description(root)
        said = description.get("inputs", {})
        if not isinstance(said, Mapping):
            raise InputError(
                f"file {description_file(root)}",
                expected='an object under "inputs", see docs/captures.md',
                received=repr(said),
            )
        return SaidOfInputs(root, said, read_protocols(description), protocol)

    def parameters(self, run: Path, path: Path | None) -> tuple[str, str]:
        """The word for parameters in a file or folder, and what the run made them by."""
        for file, stage in MADE_BY.items():
            if path is not None and same_place(path, run / file):
                return self._made_from(run), stage
        return self.given_parameters(path), ""

    def given_parameters(self, path: Path | None) -> str:
        """The word for parameters that lie in the capture; elsewhere, or None: not known."""
        if path is None:
            return NOT_KNOWN
        folder = self.root / "params"
        if same_place(path, folder) or path.stem.isdigit():
            name, inside = OWN_PARAMETERS, lies_in(path, folder)
        else:
            name, inside = path.name, same_place(path, folder / path.name)
        return self._word("parameters", name, OWN_PARAMETERS) if inside else NOT_KNOWN

    def own_parameters(self) -> Path | None:
        """The parameters that are read where nobody names others: a file, or the folder of single frames."""
        files = self.protocols.get(self.protocol or "")
        if files is not None:
            return files.parameter_file(self.root)
        folder = self.root / "params"
        stacked = folder / OWN_PARAMETERS
        if stacked.is_file():
            return stacked
        return folder if any(folder.glob("[0-9]*.npz")) else None

    def _made_from(self, run: Path) -> str:
        """The word for parameters that a run made, by what they began with: keypoints alone, or a fit."""
        began = self.own_parameters()
        registration = load_register(run)
        if registration is not None:
            began = (registration.params or began) if registration.start else None
        else:
            given = (read_manifest(run / REFINE_STAGE) or {}).get("numbers", {}).get("given")
            began = began if given is None else self.root / "params" / str(given).partition(" ")[0]
        if began is None:
            return TRACKED
        word = self.given_parameters(began)
        return MIXED if word == EXACT else word

    def labels(self, build: BuildInputs) -> str:
        """The word for the labels that a template was built with; what the body told is an estimate."""
        sources = list(build.label_maps.values()) or [build.labels or build.scan]
        if (build.reconstructs or all(path.exists() for path in sources)) and _told_by_body(build):
            return WORDS[TRACKED]
        if not all(path.exists() and lies_in(path, self.root) for path in sources):
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


def path_of_params(source: ParamSource | None) -> Path | None:
    """The file or folder that parameters are read from."""
    if isinstance(source, StackedParams):
        return source.path
    return source.files.folder if isinstance(source, ParamFiles) else None


def folder_of_maps(capture: Capture, kind: str) -> str | None:
    """Name of the folder with the maps of a kind."""
    series = next(iter(capture.recording.files.get(kind, {}).values()), None)
    return None if series is None else series.folder.parent.name


def _told_by_body(build: BuildInputs) -> bool:
    """Whether the body in the scan told its labels; a scan that cannot be read any more does not say it."""
    try:
        return label_source(build) == "body"
    except InputError:
        return False
