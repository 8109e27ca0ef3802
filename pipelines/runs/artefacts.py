"""What the stages of a build leave for each other, read back."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.arrays import load_arrays, read_named, take
from pipelines.runs.layout import (
    PARAMS,
    PARTS,
    PARTS_WITHOUT_WEBS,
    POSED_BODY,
    SCAN,
    SCAN_LABELS,
    WEIGHTS,
)
from smplxpp.body import BodyModel, load_params
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import ARRAY_NAMES, BodyParams
from smplxpp.core.safe_pickle import safe_npz
from smplxpp.core.skin_weights import SkinWeights


def load_scan(run: Path) -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    """Read the repaired scan of a run: mesh, (N, 3) colours, (N,) index of each vertex in the user's file."""
    arrays = load_arrays(run / SCAN).get("scan", {})
    found = take(arrays, "vertices", "faces", "colors", "source_vertex", path=run / SCAN)
    return TriangleMesh(found["vertices"], found["faces"]), found["colors"], found["source_vertex"]


def load_params_of_run(run: Path) -> BodyParams:
    """Read the parameters of the reference frame."""
    return load_params(run / PARAMS)


def load_stacked_params(path: Path) -> tuple[tuple[int, ...], BodyParams]:
    """Read the frames of a file whose row is the frame's number, NaN where there is none, and a row for each."""
    arrays = safe_npz(path)
    good = np.isfinite(arrays["global_orient"]).all(axis=1)
    kept = {name: array[good] if name in ARRAY_NAMES else array for name, array in arrays.items()}
    if "v_shape" in arrays and len(np.atleast_1d(arrays["v_shape"])) == len(good):
        kept["v_shape"] = arrays["v_shape"][good]
    return tuple(np.flatnonzero(good).tolist()), BodyParams.from_mapping(kept, source=f"file {path}")


def load_scan_labels(run: Path) -> np.ndarray:
    """Read the (F,) labels of the scan's faces."""
    return read_named(run / SCAN_LABELS, "face_labels")[0]


def load_posed_body(run: Path, body: BodyModel) -> tuple[TriangleMesh, np.ndarray]:
    """Read the fitted body in the reference frame, and its (J, 4, 4) `posed_from_rest`."""
    vertices, posed_from_rest = read_named(run / POSED_BODY, "vertices", "posed_from_rest")
    return body.mesh(vertices), posed_from_rest


def load_cleaned_parts(run: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    """Read the cleaned parts in the reference pose: mesh, and arrays `label`, `source_vertex`, `colors`."""
    return _parts(run / PARTS)


def load_parts(run: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    """Read the same as `load_cleaned_parts` without webs: what skin weights are for."""
    return _parts(run / PARTS_WITHOUT_WEBS)


def _parts(file: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    needed = ("vertices", "faces", "label", "source_vertex", "colors")
    groups = {name: take(arrays, *needed, path=file) for name, arrays in load_arrays(file).items()}
    return {name: (TriangleMesh(a["vertices"], a["faces"]), a) for name, a in groups.items()}


def load_weights(run: Path) -> dict[str, SkinWeights]:
    """Read the parts' skin weights."""
    out = {}
    names = [field.name for field in fields(SkinWeights)]
    for name, found in load_arrays(run / WEIGHTS).items():
        arrays = take(found, *names, path=run / WEIGHTS)
        joint_count, policies = int(arrays.pop("joint_count")), tuple(arrays.pop("policies").tolist())
        kept: dict[str, Any] = dict(arrays)
        out[name] = SkinWeights(**kept, joint_count=joint_count, policies=policies)
    return out
