"""Choose the files of a capture by a named protocol.

A capture for evaluation has several files of one kind: exact parameters and those of a tracker, true label maps and
estimated ones. A protocol names one of each kind, so that the others are not read by mistake.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import read_json

DESCRIPTIONS = ("capture.json", "manifest.json")
"""Files that describe a capture of the simple layout, by hand or by a tool; the first that exists is read."""
EXACT, TRACKED = "exact", "tracked"
"""Names of the protocols of the true inputs, and of the outputs of trackers and estimators."""
_KEYS = ("parameters", "labels", "scan_labels", "normals", "keypoints")


@dataclass(frozen=True, kw_only=True)
class ProtocolFiles:
    """Files of a capture of the simple layout that are read; the defaults are those without a protocol.

    Attributes:
        name: name of the protocol; None without one.
        parameters: name of a file in `params/`. None means no parameters in a protocol, and those found there without.
        labels: folder of label maps, named as in the simple layout; None: none are read.
        normals: folder of normal maps; None: none are read.
        keypoints: folder of keypoints; None: none are read.
        scan_labels: whether labels that come with a scan may be used.
    """

    name: str | None = None
    parameters: str | None = None
    labels: str | None = "labels"
    scan_labels: bool = True
    normals: str | None = "normals"
    keypoints: str | None = "keypoints"

    def parameter_file(self, root: Path) -> Path | None:
        """Return the path of the named file of parameters; None without a name."""
        return None if self.parameters is None else root / "params" / self.parameters


def description_file(root: Path) -> Path | None:
    """Return the description file of a capture; None without one."""
    return next((root / name for name in DESCRIPTIONS if (root / name).is_file()), None)


def read_description(root: Path) -> Mapping[str, Any]:
    """Return the description of a capture of the simple layout; empty without a file.

    Raises:
        InputError: a broken file, or JSON that is not an object.
    """
    path = description_file(root)
    content = {} if path is None else read_json(path)
    if not isinstance(content, Mapping):
        raise InputError(
            f"file {path}", expected="an object with the keys of docs/captures.md", received=type(content).__name__
        )
    return content


def read_protocols(description: Mapping[str, Any]) -> dict[str, ProtocolFiles]:
    """Return the protocols of a capture by name; kinds that a protocol does not name are not read.

    Raises:
        InputError: an unknown key, or a value that is not a plain name.
    """
    found = description.get("protocols", {})
    if not isinstance(found, Mapping):
        raise InputError("protocols of the capture", expected="an object of protocols by name", received=repr(found))
    return {str(name): _protocol(str(name), values) for name, values in found.items()}


def choose_protocol(root: Path, description: Mapping[str, Any], name: str | None) -> ProtocolFiles:
    """Return the files of a protocol after checking that they exist; without a name, the defaults.

    Raises:
        InputError: an unknown protocol, or missing files; the message lists the protocols of the capture.
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
    # Check existence now, so that a protocol never falls back on files that it does not name.
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
        # A plain name cannot leave the capture's folder: no separators, no "..".
        plain = value is None or (isinstance(value, str) and Path(value).name == value and value not in ("", ".."))
        if not plain:
            raise InputError(f"{subject}: {key}", expected="a name without a path, or null", received=repr(value))
    return ProtocolFiles(name=name, scan_labels=scan_labels, **names)
