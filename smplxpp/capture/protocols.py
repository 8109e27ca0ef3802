"""Protocols of a capture: which of its files are read, by a name.

A capture made for measuring has several files of one kind, exact parameters and a tracker's, true label maps and
estimated ones. A protocol names one of each, so that nothing of the others is read by mistake.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import read_json

DESCRIPTIONS = ("capture.json", "manifest.json")
"""Files that describe a capture of our layout: written by hand, or by the tool that made it. The first counts."""
EXACT, TRACKED = "exact", "tracked"
"""Protocols whose names say what their files are: the truth, and what trackers and estimators give."""
_KEYS = ("parameters", "labels", "scan_labels", "normals", "keypoints")


@dataclass(frozen=True, kw_only=True)
class ProtocolFiles:
    """The files of a capture of our layout that are read; without a name, those that are read where nobody chooses.

    Attributes:
        name: of the protocol, None without one.
        parameters: a file in `params/`. With a name, None: the capture has no parameters; without one, None: those
            that are found there.
        labels, normals, keypoints: folders of the capture with the naming of our layout inside; None: none are read.
        scan_labels: whether labels that come with a scan may be used.
    """

    name: str | None = None
    parameters: str | None = None
    labels: str | None = "labels"
    scan_labels: bool = True
    normals: str | None = "normals"
    keypoints: str | None = "keypoints"

    def parameter_file(self, root: Path) -> Path | None:
        """The file of parameters that is named, None where none is."""
        return None if self.parameters is None else root / "params" / self.parameters


def description_file(root: Path) -> Path | None:
    """The file that describes a capture, None where there is none."""
    return next((root / name for name in DESCRIPTIONS if (root / name).is_file()), None)


def read_description(root: Path) -> Mapping[str, Any]:
    """What a capture of our layout says of itself, empty where it says nothing.

    Raises:
        InputError: a broken file, or one that holds no object.
    """
    path = description_file(root)
    content = {} if path is None else read_json(path)
    if not isinstance(content, Mapping):
        raise InputError(
            f"file {path}", expected="an object with the keys of docs/captures.md", received=type(content).__name__
        )
    return content


def read_protocols(description: Mapping[str, Any]) -> dict[str, ProtocolFiles]:
    """The protocols that a capture has, by name. What a protocol does not name, it has not.

    Raises:
        InputError: another key, or a value that is no plain name.
    """
    found = description.get("protocols", {})
    if not isinstance(found, Mapping):
        raise InputError("protocols of the capture", expected="an object of protocols by name", received=repr(found))
    return {str(name): _protocol(str(name), values) for name, values in found.items()}


def choose_protocol(root: Path, description: Mapping[str, Any], name: str | None) -> ProtocolFiles:
    """The files of a protocol, all of which are there; of no name, those that are read without one.

    Raises:
        InputError: an unknown protocol, or files of it that are missing; both name the protocols that there are.
    """
    protocols = read_protocols(description)
    if name is None:
        return ProtocolFiles()
    have = ", ".join(protocols) or "none"
    if name not in protocols:
        raise InputError(
            f"protocol {name} of capture {root.name}",
            expected=f"a protocol that it has ({have})",
            received=name,
            remedy='name its files under "protocols" in capture.json (docs/captures.md)',
        )
    files = protocols[name]
    wanted = [files.parameter_file(root), *(root / f for f in (files.labels, files.normals, files.keypoints) if f)]
    missing = [path.relative_to(root).as_posix() for path in wanted if path is not None and not path.exists()]
    if missing:
        usable = [other for other in protocols if other != name]
        raise InputError(
            f"protocol {name} of capture {root.name}",
            expected=f"the files that it names: {', '.join(missing)}",
            received="no such files",
            remedy=f"make them, or choose another protocol ({', '.join(usable) or 'it has no other'})",
        )
    return files


def _protocol(name: str, values: Any) -> ProtocolFiles:
    subject = f"protocol {name} of the capture"
    if not isinstance(values, Mapping):
        raise InputError(subject, expected=f"an object with {', '.join(_KEYS)}", received=repr(values))
    unknown = sorted(set(values) - set(_KEYS))
    if unknown:
        raise InputError(subject, expected=f"keys among {', '.join(_KEYS)}", received=", ".join(unknown))
    scan_labels = values.get("scan_labels", False)
    if not isinstance(scan_labels, bool):
        raise InputError(f"{subject}: scan_labels", expected="true or false", received=repr(scan_labels))
    names = {key: values.get(key) for key in _KEYS if key != "scan_labels"}
    for key, value in names.items():
        plain = value is None or (isinstance(value, str) and Path(value).name == value and value not in ("", ".."))
        if not plain:
            raise InputError(f"{subject}: {key}", expected="a name without a path, or null", received=repr(value))
    return ProtocolFiles(name=name, scan_labels=scan_labels, **names)
