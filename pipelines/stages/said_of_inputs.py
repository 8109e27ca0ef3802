"""What a capture says of its own inputs: exact or tracked parameters, true or estimated labels and normals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smplxpp.capture.readers import simple
from smplxpp.capture.readers.common import read_json
from smplxpp.core.errors import InputError

DESCRIPTIONS = ("capture.json", "manifest.json")
"""Files in a capture's folder that may say it, under the key "inputs"; the first that is there."""
OWN_PARAMETERS = "params.npz"
TRACKED = "tracked"


def said_of_inputs(root: Path) -> Mapping[str, Any]:
    """Read what a capture of our own layout says of its inputs; empty where it says nothing.

    Raises:
        InputError: something else than docs/captures.md has.
    """
    path = next((root / name for name in DESCRIPTIONS if (root / name).is_file()), None)
    said = {} if path is None else read_json(path).get("inputs", {})
    if not isinstance(said, Mapping):
        raise InputError(f"file {path}", expected='an object under "inputs", see docs/captures.md', received=repr(said))
    return said


def said_of_parameters(said: Any, chosen: Path | None, root: Path) -> str | None:
    """Return the capture's word for the parameters in use, None where it has none.

    Args:
        said: a word for its own parameters, or a word by the name of a file in `params/`.
        chosen: another file than its own.
    """
    if isinstance(said, Mapping):
        name = OWN_PARAMETERS if chosen is None else chosen.name
        own = chosen is None or simple.stacked_params(root, chosen).resolve() == (root / "params" / name).resolve()
        return str(said[name]) if own and name in said else None
    return None if said is None or chosen is not None else str(said)
