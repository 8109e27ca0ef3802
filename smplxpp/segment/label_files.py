"""Read label files: ids of a scan's vertices or faces, and label maps of views."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, Num, Shaped
from scipy.spatial import cKDTree

from smplxpp.core import BACKGROUND, LABELS, InputError, Labels
from smplxpp.core.files import as_numbers, read_arrays, regular_file
from smplxpp.core.files.array_file import array_names, read_array
from smplxpp.core.files.image_file import open_image
from smplxpp.core.files.safe_pickle import safe_load
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.segment.label_sets import LabelSet
from smplxpp.segment.labels import find_label_set, map_labels

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
    source_faces: Int64[np.ndarray, " M"] | None = None,
) -> Int64[np.ndarray, " n"]:
    """Read labels of a scan's vertices (N,) or faces (M,), in our ids; the length tells which of the two they are.

    Formats are `.npz` and `.pkl` (a key such as `label`, `labels`, `scan_labels`, `face_labels`), `.npy`, and mesh
    files: a PLY property of such a name, or else vertex colours, taken as the display colours of
    `smplxpp.core.labels`.

    Args:
        path: the file.
        vertex_count: number of vertices of the scan.
        face_count: number of triangles of the scan.
        label_set: numbering of the labels in the file; display colours need none.
        color_tolerance: distance in 8-bit RGB to the nearest display colour, above which a vertex is unlabelled (-1).
        source_faces: polygon of each triangle (`RawMesh.source_faces`), for a scan file with polygons. Labels may then
            be one for each polygon; each triangle takes its polygon's.

    Raises:
        InputError: no labels in the file, a length that is neither count, or that is both, or unknown ids.
    """
    path = regular_file(path, subject="label file")
    values = _read_array(path)
    if values is None:
        return _read_from_mesh(path, vertex_count, face_count, label_set, color_tolerance)
    if values.ndim == 2 and 1 in values.shape:
        values = values.ravel()
    # The length tells vertices, faces and polygons apart.
    polygons = None if source_faces is None else int(source_faces.max()) + 1
    of = check_element_count(
        values, vertex_count=vertex_count, face_count=face_count, polygon_count=polygons, subject=f"label file {path}"
    )
    labels = _mapped(values, label_set, path)
    return labels if source_faces is None or of != "polygon" else labels[source_faces]


def _read_array(path: Path) -> np.ndarray | None:
    """Read the array by the suffix of the file; None for whatever is no array file, which is a mesh."""
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return read_array(path, subject="label file")
    if suffix == ".npz":
        names = array_names(path, subject="label file")
        return _pick(read_arrays(path, subject="label file", keys=_KEYS), path, names)
    if suffix in (".pkl", ".pickle"):
        loaded = safe_load(path)
        is_table = isinstance(loaded, Mapping)
        return _pick(loaded, path, list(loaded)) if is_table else _as_array(loaded, path)
    return None


def _mapped(values: np.ndarray, label_set: str | Path | LabelSet, path: Path) -> np.ndarray:
    try:
        return map_labels(values, label_set)
    except InputError as error:
        raise InputError(
            f"label file {path}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy,
        ) from None


def check_label_ids(path: str | Path, label_set: str | Path | LabelSet) -> None:
    """Refuse a label file with ids that a set does not have; meshes are looked at when they are read.

    Raises:
        InputError: it names the ids, and the sets that have all of them.
    """
    path = regular_file(path, subject="label file")
    values = _read_array(path)
    if values is not None:
        _mapped(np.unique(values), label_set, path)


def check_element_count(
    values: Shaped[np.ndarray, "*n"],
    *,
    vertex_count: int,
    face_count: int,
    subject: str,
    polygon_count: int | None = None,
) -> str:
    """Return which element `values` has one entry for: "vertex", "face" (a triangle), or "polygon" of the scan's file.

    Raises:
        InputError: another length or shape, or one that two kinds of elements have.
    """
    # Compare the length with each count; exactly one must agree.
    length = len(values) if values.ndim == 1 else -1
    counts = {"vertex": vertex_count, "face": face_count}
    if polygon_count not in (None, face_count):
        counts["polygon"] = polygon_count
    fitting = [name for name, count in counts.items() if count == length]
    if not fitting:
        polygons = f" or {counts['polygon']} (one a polygon)" if "polygon" in counts else ""
        raise InputError(
            subject,
            expected=f"{vertex_count} labels (one a vertex) or {face_count} (one a face){polygons}, as the scan's file "
            "has them",
            received=f"shape {values.shape}",
            remedy=_why_not(length, vertex_count),
        )
    if len(fitting) > 1:
        raise InputError(
            subject,
            expected="a length that tells vertices from faces",
            received=f"{length} labels for {vertex_count} vertices and {counts.get('polygon', face_count)} faces",
            remedy="give them as vertex_labels or face_labels of segment_scan",
        )
    return fitting[0]


def _why_not(length: int, vertex_count: int) -> str:
    """Return the remedy for a wrong length.

    The project's readers neither merge nor split vertices, so that other counts come from the tool that wrote the
    labels.
    """
    if length < 0:
        return "give one list of labels"
    did = (
        "merged vertices that lie together"
        if length < vertex_count
        else "split vertices where texture or materials meet"
    )
    return (
        f"these are labels of another scan, or the tool that wrote them {did} when it read this one: "
        "label the file's own vertices or faces (trimesh: load with process=False from a PLY without texture), "
        "or save that tool's mesh and build from it"
    )


def _pick(values: Mapping, path: Path, keys: list) -> np.ndarray:
    found = [key for key in _KEYS if key in values]
    if len(found) != 1:
        raise InputError(
            f"label file {path}",
            expected=f"one of the keys {', '.join(_KEYS)}",
            received=f"keys {sorted(map(str, keys))}",
        )
    return _as_array(values[found[0]], path)


def _as_array(values: Any, path: Path) -> np.ndarray:
    if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
        return values
    return as_numbers(values, subject=f"label file {path}")


def holds_labels(path: str | Path, *, labels: Labels = LABELS) -> bool:
    """Return whether a mesh file holds labels: a property with a name of labels, or display colours of these labels.

    Raises:
        InputError: it is no mesh file.
    """
    raw = read_raw_mesh(path, clouds=True)
    if any(key in properties for properties in (raw.vertex_properties, raw.face_properties) for key in _KEYS):
        return True
    if raw.vertex_colors is None:
        return False
    # One colour throughout is a material without a texture; the grey of many tools is the colour of skin.
    found = labels_from_colors(raw.vertex_colors, labels=labels)
    return _of_the_table(found) and len(np.unique(found[found != BACKGROUND])) > 1


def _of_the_table(labels: np.ndarray) -> bool:
    """Return whether colours are display colours of labels, which holds if at least half of them are in the table."""
    return bool((labels == BACKGROUND).mean() <= 0.5)


def _read_from_mesh(
    path: Path, vertex_count: int, face_count: int, label_set: str | Path | LabelSet, color_tolerance: float
) -> np.ndarray:
    # The file must have the scan's vertices and faces in their order. Properties are preferred to colours.
    file = read_raw_mesh(path, clouds=True)
    if (len(file.vertices), len(file.faces)) != (vertex_count, face_count):
        raise InputError(
            f"label file {path}",
            expected=f"the scan's {vertex_count} vertices and {face_count} faces",
            received=f"{len(file.vertices)} and {len(file.faces)}",
            remedy=_why_not(len(file.vertices), vertex_count),
        )
    for properties in (file.vertex_properties, file.face_properties):
        found = [key for key in _KEYS if key in properties]
        if found and len(properties[found[0]]):
            return map_labels(properties[found[0]], label_set)
    if file.vertex_colors is None:
        raise InputError(
            f"label file {path}",
            expected=f"a property named one of {', '.join(_KEYS)}, or vertex colours",
            received="neither",
        )
    labels = labels_from_colors(file.vertex_colors, tolerance=color_tolerance, labels=find_label_set(label_set).labels)
    if not _of_the_table(labels):
        raise InputError(
            f"label file {path}",
            expected="vertex colours from the table of labels",
            received=f"{(labels == BACKGROUND).mean():.0%} of the vertices with other colours",
            remedy="these may be texture colours: give the labels in a file of their own",
        )
    return labels


def labels_from_colors(
    colors: Num[np.ndarray, "N 3"], *, tolerance: float = 24.0, labels: Labels = LABELS
) -> Int64[np.ndarray, " N"]:
    """Return the label ids of display colours; -1 farther than `tolerance` from every colour of the table."""
    table = cKDTree(np.array([label.display_rgb for label in labels], dtype=np.float64))
    distance, nearest = table.query(np.asarray(colors, dtype=np.float64), distance_upper_bound=tolerance + 1e-9)
    ids = np.array([label.id for label in labels] + [BACKGROUND])
    return np.where(np.isfinite(distance), ids[nearest], BACKGROUND)


def read_label_map(path: str | Path, *, label_set: str | Path | LabelSet) -> Int64[np.ndarray, "H W"]:
    """Read a view's label map, (H, W) in our ids, from an index PNG (palette or grey) or an integer `.npy`.

    Raises:
        InputError: missing file, a colour image, or unknown ids.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        values = read_array(path, subject="label map")
    else:
        values = np.array(open_image(path, subject="label map"))
    if values.ndim != 2:
        raise InputError(
            f"label map {path}",
            expected="one index a pixel (palette or grey)",
            received=f"shape {values.shape}",
            remedy="save class indices, not colours",
        )
    return map_labels(values, label_set)
