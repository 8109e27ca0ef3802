"""The file of a Template: one npz of plain arrays."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from dataclasses import fields
from pathlib import Path

import numpy as np

from smplxpp.core.atomic import atomic_path
from smplxpp.core.errors import InputError
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.template.template import Template

# Raised when a reader of the older layout would misread the file.
SCHEMA = 1
_SCHEMA_KEY = "smplxpp_template_schema"
_WEIGHTS = "weights_"
_TEXTS = ("part_names", "joint_names", "body_label_names", "expression_names")


def save_template(template: Template, path: str | Path) -> None:
    """See `Template.save`."""
    arrays: dict[str, np.ndarray] = {_SCHEMA_KEY: np.int64(SCHEMA)}
    for f in fields(Template):
        value = getattr(template, f.name)
        if f.name == "weights":
            arrays |= {_WEIGHTS + w.name: _plain(getattr(value, w.name)) for w in fields(SkinWeights)}
        elif f.name == "metadata":
            arrays["metadata"] = np.array(json.dumps(value, sort_keys=True))
        elif value is not None:
            arrays[f.name] = _plain(value)
    # An npz like numpy's own, with the quickest compression, and a fixed date so that the same template gives the same
    # bytes.
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), stream.getbuffer(), zipfile.ZIP_DEFLATED, compresslevel=1)


def load_template(path: str | Path) -> Template:
    """See `Template.load`."""
    path = Path(path)
    if not path.is_file():
        raise InputError("template file", expected="an existing file", received=str(path))
    arrays = _read(path)
    schema = arrays.pop(_SCHEMA_KEY, None)
    if schema is None:
        raise InputError(
            f"template file {path}",
            expected="a file written by Template.save",
            received=f"an npz with keys {sorted(arrays)[:6]}",
        )
    if int(schema) > SCHEMA:
        raise InputError(
            f"template file {path}",
            expected=f"a file of version {SCHEMA} or older",
            received=f"version {int(schema)}",
            remedy="update smplxpp",
        )
    try:
        weights = {f.name: arrays.pop(_WEIGHTS + f.name) for f in fields(SkinWeights)}
        weights["joint_count"] = int(weights["joint_count"])
        weights["policies"] = tuple(map(str, weights["policies"]))
        values = {f.name: arrays.get(f.name) for f in fields(Template)}
        values |= {name: () if values[name] is None else tuple(map(str, values[name])) for name in _TEXTS}
        values |= {"weights": SkinWeights(**weights), "metadata": json.loads(str(arrays["metadata"]))}
        return Template(**values)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"template file {path}", expected="all arrays of a template", received=f"{type(error).__name__}: {error}"
        ) from None


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        # A file of our own: numpy does not close what it opened when the archive turns out to be damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            return {key: data[key] for key in data.files}
    except (ValueError, OSError, EOFError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        # A lone npy loads as an array, which has no `files`; objects in an npz are refused as ValueError.
        raise InputError(
            f"template file {path}",
            expected="an npz of plain arrays",
            received=f"{type(error).__name__}: {error}",
            remedy="the file is damaged or no template: build it again",
        ) from None


def _plain(value) -> np.ndarray:
    array = np.asarray(value)
    # An empty tuple of texts would become an array of floats.
    return array if array.size or not isinstance(value, tuple) else np.zeros(0, dtype="<U1")
