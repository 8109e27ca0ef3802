"""Label files: per-vertex or per-face ids of a scan, and label maps of views."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int64, Num, Shaped
from scipy.spatial import cKDTree

from smplxpp.core.errors import InputError
from smplxpp.core.labels import BACKGROUND, LABELS
from smplxpp.core.mesh_io import read_mesh
from smplxpp.core.safe_pickle import safe_load
from smplxpp.segment.labels import LabelSet, map_labels

_KEYS = (
    "label",
    "labels",
    "scan_labels",
    "vertex_label",
    "vertex_labels",
    "face_label",
    "face_labels",
)


def read_labels(
    path: str | Path,
    *,
    vertex_count: int,
    face_count: int,
    label_set: str | Path | LabelSet = "4ddress",
    color_tolerance: float = 24.0,
) -> Int64[np.ndarray, " n"]:
    """Labels of a scan's vertices (N,) or faces (M,), in our ids; which of the two, the length tells.

    Reads `.npz` and `.pkl` (a key such as `label`, `labels`, `scan_labels`, `face_labels`), `.npy`, and mesh files:
    a PLY property of such a name, or else vertex colours, taken as the display colours of `smplxpp.core.labels`
    (nearest colour within `color_tolerance` in 8-bit RGB; farther ones are unlabelled, -1, and no label set applies).

    Raises:
        InputError: no labels in the file, a length that is neither count, or that is both, or unknown ids.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("label file", expected="an existing file", received=str(path))
    suffix = path.suffix.lower()
    if suffix == ".npy":
        values = _load_npy(path)
    elif suffix == ".npz":
        with np.load(path, allow_pickle=False) as data:
            values = _pick({key: data[key] for key in data.files if key in _KEYS}, path, list(data.files))
    elif suffix in (".pkl", ".pickle"):
        loaded = safe_load(path)
        values = _pick(loaded, path, list(loaded)) if isinstance(loaded, Mapping) else np.asarray(loaded)
    else:
        return _read_from_mesh(path, vertex_count, face_count, label_set, color_tolerance)
    values = np.asarray(values)
    if values.ndim == 2 and 1 in values.shape:
        values = values.ravel()
    check_element_count(values, vertex_count=vertex_count, face_count=face_count, subject=f"label file {path}")
    try:
        return map_labels(values, label_set)
    except InputError as error:
        raise InputError(
            f"label file {path}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy,
        ) from None


def check_element_count(
    values: Shaped[np.ndarray, "n ..."], *, vertex_count: int, face_count: int, subject: str
) -> bool:
    """True where `values` has one entry a vertex, False where one a face.

    Raises:
        InputError: another length or shape, or as many vertices as faces so that the length cannot tell.
    """
    length = len(values) if values.ndim == 1 else -1
    if length not in (vertex_count, face_count):
        raise InputError(
            subject,
            expected=f"{vertex_count} labels (one a vertex) or {face_count} (one a face)",
            received=f"shape {values.shape}",
            remedy="check that the labels belong to this scan and that the reader did not merge vertices",
        )
    if vertex_count == face_count:
        raise InputError(
            subject,
            expected="a length that tells vertices from faces",
            received=f"{length} labels for {vertex_count} vertices and {face_count} faces",
            remedy="give them as vertex_labels or face_labels of segment_scan",
        )
    return length == vertex_count


def _load_npy(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except ValueError as error:
        raise InputError(
            f"label file {path}", expected="an array without pickled objects", received=str(error)
        ) from None


def _pick(values: Mapping, path: Path, keys: list) -> np.ndarray:
    found = [key for key in _KEYS if key in values]
    if len(found) != 1:
        raise InputError(
            f"label file {path}",
            expected=f"one of the keys {', '.join(_KEYS)}",
            received=f"keys {sorted(map(str, keys))}",
        )
    return np.asarray(values[found[0]])


def _read_from_mesh(
    path: Path, vertex_count: int, face_count: int, label_set: str | Path | LabelSet, color_tolerance: float
) -> np.ndarray:
    file = read_mesh(path)
    if (file.mesh.vertex_count, file.mesh.face_count) != (vertex_count, face_count):
        raise InputError(
            f"label file {path}",
            expected=f"the scan's {vertex_count} vertices and {face_count} faces",
            received=f"{file.mesh.vertex_count} and {file.mesh.face_count}",
        )
    for properties in (file.vertex_properties, file.face_properties):
        found = [key for key in _KEYS if key in properties]
        if found:
            return map_labels(properties[found[0]], label_set)
    if file.vertex_colors is None:
        raise InputError(
            f"label file {path}",
            expected=f"a property named one of {', '.join(_KEYS)}, or vertex colours",
            received="neither",
        )
    labels = labels_from_colors(file.vertex_colors, tolerance=color_tolerance)
    if (labels == BACKGROUND).mean() > 0.5:
        raise InputError(
            f"label file {path}",
            expected="vertex colours from the table of labels",
            received=f"{(labels == BACKGROUND).mean():.0%} of the vertices with other colours",
            remedy="these may be texture colours: give the labels in a file of their own",
        )
    return labels


def labels_from_colors(colors: Num[np.ndarray, "N 3"], *, tolerance: float = 24.0) -> Int64[np.ndarray, " N"]:
    """The label ids of display colours; -1 farther than `tolerance` from every colour of the table."""
    table = cKDTree(np.array([label.display_rgb for label in LABELS], dtype=np.float64))
    distance, nearest = table.query(np.asarray(colors, dtype=np.float64), distance_upper_bound=tolerance + 1e-9)
    ids = np.array([label.id for label in LABELS] + [BACKGROUND])
    return np.where(np.isfinite(distance), ids[nearest], BACKGROUND)


def read_label_map(path: str | Path, *, label_set: str | Path | LabelSet) -> Int64[np.ndarray, "H W"]:
    """A view's label map, (H, W) in our ids: an index PNG (palette or grey) or an integer `.npy`.

    Raises:
        InputError: missing file, a colour image, or unknown ids.
    """
    from PIL import Image

    path = Path(path)
    if not path.is_file():
        raise InputError("label map", expected="an existing file", received=str(path))
    if path.suffix.lower() == ".npy":
        values = _load_npy(path)
    else:
        try:
            with Image.open(path) as image:
                values = np.array(image)
        except OSError as error:
            raise InputError(f"label map {path}", expected="an image", received=str(error)) from None
    if values.ndim != 2:
        raise InputError(
            f"label map {path}",
            expected="one index a pixel (palette or grey)",
            received=f"shape {values.shape}",
            remedy="save class indices, not colours",
        )
    return map_labels(values, label_set)
