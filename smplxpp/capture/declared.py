"""What a capture declares about its own inputs: exact or tracked parameters, true or estimated labels and normals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from smplxpp.capture.capture import Capture
from smplxpp.capture.protocols import (
    EXACT,
    TRACKED,
    ProtocolFiles,
    description_file,
    read_description,
    read_protocols,
)
from smplxpp.capture.readers import simple
from smplxpp.capture.recording import ParamSource
from smplxpp.capture.sources import ParamFiles, StackedParams
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import lies_in, same_place

NOT_KNOWN = "not known"
OWN_PARAMETERS = "params.npz"
"""Name under which a capture declares its own parameters; files of single frames are declared under it too."""
LABEL_WORDS = {EXACT: "true", TRACKED: "estimated"}
"""Word for the labels and normals that a protocol of this name has."""


@dataclass(frozen=True)
class DeclaredInputs:
    """What a capture of our own layout declares about its files.

    Attributes:
        root: folder of the capture.
        inputs: entries under "inputs" of its description.
        protocols: protocols by name.
        protocol: name of the protocol that is read, None without one.
    """

    root: Path
    inputs: Mapping[str, Any]
    protocols: Mapping[str, ProtocolFiles]
    protocol: str | None

    @classmethod
    def of(cls, capture: Capture) -> Self:
        """Return the declarations of an open capture, none where its layout is not ours.

        Raises:
            InputError: a declaration in other words than docs/captures.md has.
        """
        if capture.format != simple.NAME:
            return cls(capture.root, {}, {}, capture.protocol)
        return cls.of_folder(capture.root, capture.protocol)

    @classmethod
    def of_folder(cls, root: Path, protocol: str | None) -> Self:
        """Return the declarations of a folder in our layout; empty where its description has none."""
        description = read_description(root)
        inputs = description.get("inputs", {})
        if not isinstance(inputs, Mapping):
            raise InputError(
                f"file {description_file(root)}",
                expected='an object under "inputs", see docs/captures.md',
                received=repr(inputs),
            )
        return cls(root, inputs, read_protocols(description), protocol)

    def given_parameters(self, path: Path | None) -> str:
        """Return the word for parameters that lie in the capture; "not known" for files elsewhere and for None."""
        if path is None:
            return NOT_KNOWN
        # Files of single frames share one declaration; they are known by a folder, or by a name of digits.
        folder = self.root / "params"
        if same_place(path, folder) or path.stem.isdigit():
            name, inside = OWN_PARAMETERS, lies_in(path, folder)
        else:
            name, inside = path.name, same_place(path, folder / path.name)
        return self._word("parameters", name, OWN_PARAMETERS) if inside else NOT_KNOWN

    def own_parameters(self) -> Path | None:
        """Return the file (or the folder of single frames) that is read where the user names no parameters."""
        # A protocol decides alone: where it names no parameters, none are read.
        files = self.protocols.get(self.protocol or "")
        if files is not None:
            return files.parameter_file(self.root)
        folder = self.root / "params"
        stacked = folder / OWN_PARAMETERS
        if stacked.is_file():
            return stacked
        return folder if any(folder.glob("[0-9]*.npz")) else None

    def scan_labels(self) -> str:
        """Return the word for labels that come with a scan of the capture."""
        word = self._word("labels", "labels", "labels")
        return "true" if word == NOT_KNOWN and any(one.scan_labels for one in self._named(EXACT)) else word

    def of_views(self, kind: str, folder: str | None) -> str:
        """Return the word for the label or normal maps in a folder; "not known" for None."""
        return NOT_KNOWN if folder is None else self._word(kind, folder, kind)

    def _word(self, kind: str, name: str, default: str) -> str:
        # The declaration by name wins; a single word is for the default file; then the protocols that name the file
        # count.
        """Return what is declared of a file or folder by its name; a single word stands for the default name."""
        declared = self.inputs.get(kind)
        if isinstance(declared, Mapping) and name in declared:
            return str(declared[name])
        if declared is not None and not isinstance(declared, Mapping) and name == default:
            return str(declared)
        for protocol in (EXACT, TRACKED):
            if any(getattr(one, kind) == name for one in self._named(protocol)):
                return protocol if kind == "parameters" else LABEL_WORDS[protocol]
        return NOT_KNOWN

    def _named(self, name: str) -> list[ProtocolFiles]:
        return [one for key, one in self.protocols.items() if key == name]


def path_of_params(source: ParamSource | None) -> Path | None:
    """Return the file or folder that parameters are read from, None where they are in memory."""
    if isinstance(source, StackedParams):
        return source.path
    return source.files.folder if isinstance(source, ParamFiles) else None


def has_estimated_params(capture: Capture) -> bool:
    """Return whether a capture's body parameters are estimates: registered ones, or declared as tracked.

    Raises:
        InputError: a declaration in other words than docs/captures.md has.
    """
    source = capture.recording.params
    if source is not None and path_of_params(source) is None:  # in memory: a registration made them, unless they say
        return bool(getattr(source, "estimated", True))
    return DeclaredInputs.of(capture).given_parameters(path_of_params(source)) == TRACKED
