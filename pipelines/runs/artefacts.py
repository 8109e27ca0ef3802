"""What the stages of a build leave for each other, read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.arrays import load_arrays, read_named, take
from pipelines.runs.layout import (
    CANONICAL,
    PARAMS,
    PARTS,
    PARTS_WITHOUT_WEBS,
    POSED_BODY,
    SCAN,
    SCAN_LABELS,
    WEIGHTS,
)
from pipelines.runs.reading import values_of
from smplxpp.body import BodyModel, load_params
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_numbers
from smplxpp.core.files.safe_pickle import safe_npz
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import ARRAY_NAMES, BodyParams
from smplxpp.core.skin_weights import SkinWeights


def load_scan(run: Path) -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    """Read the repaired scan of a run: mesh, (N, 3) colours, (N,) index of each vertex in the user's file."""
    arrays = load_arrays(run / SCAN).get("scan", {})
    found = take(arrays, "vertices", "faces", "colors", "source_vertex", path=run / SCAN)
    with values_of(run / SCAN):
        return _mesh(found), found["colors"], found["source_vertex"]


def load_params_of_run(run: Path) -> BodyParams:
    """Read the parameters of the reference frame."""
    return load_params(run / PARAMS)


def load_stacked_params(path: Path) -> tuple[tuple[int, ...], BodyParams]:
    """Read the frames of a file whose row is the frame's number, NaN where there is none, and a row for each."""
    arrays = safe_npz(path)
    with values_of(path):
        good = np.isfinite(arrays["global_orient"]).all(axis=1)
        kept = {name: array[good] if name in ARRAY_NAMES else array for name, array in arrays.items()}
        if "v_shape" in arrays and len(np.atleast_1d(arrays["v_shape"])) == len(good):
            kept["v_shape"] = arrays["v_shape"][good]
        return tuple(np.flatnonzero(good).tolist()), BodyParams.from_mapping(kept, source=f"file {path}")


def load_source_faces(run: Path) -> np.ndarray:
    """Read the index of each of the scan's faces in the user's file."""
    return take(load_arrays(run / SCAN).get("scan", {}), "source_face", path=run / SCAN)["source_face"]


def load_scan_labels(run: Path, faces: int) -> np.ndarray:
    """Read the labels of the scan's faces, which are so many."""
    (labels,) = read_named(run / SCAN_LABELS, "face_labels")
    with values_of(run / SCAN_LABELS):
        _check("face_labels", labels, "iu", (faces,))
        return labels


def load_posed_body(run: Path, body: BodyModel) -> tuple[TriangleMesh, np.ndarray]:
    """Read the fitted body in the reference frame, and its (J, 4, 4) `posed_from_rest`."""
    vertices, posed_from_rest = read_named(run / POSED_BODY, "vertices", "posed_from_rest")
    with values_of(run / POSED_BODY):
        transforms = as_numbers(posed_from_rest, (body.joint_count, 4, 4), subject="posed_from_rest")
        return body.mesh(as_numbers(vertices, (body.vertex_count, 3), subject="vertices")), transforms


def load_resting_body(run: Path, body: BodyModel) -> TriangleMesh:
    """Read the fitted body in its rest pose."""
    (vertices,) = read_named(run / POSED_BODY, "rest_vertices")
    with values_of(run / POSED_BODY):
        return body.mesh(as_numbers(vertices, (body.vertex_count, 3), subject="rest_vertices"))


def load_cleaned_parts(run: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    """Read the cleaned parts in the reference pose: mesh, and arrays `label`, `source_vertex`, `colors`."""
    return _parts(run / PARTS)


def load_parts(run: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    """Read the same as `load_cleaned_parts` without webs: what skin weights are for."""
    return _parts(run / PARTS_WITHOUT_WEBS)


def load_weights(run: Path, parts: Mapping[str, tuple[TriangleMesh, Any]]) -> dict[str, SkinWeights]:
    """Read the skin weights of the parts."""
    out = {}
    names, groups = [field.name for field in fields(SkinWeights)], load_arrays(run / WEIGHTS)
    for name, (mesh, _) in parts.items():
        with values_of(run / WEIGHTS):
            found = take(groups[name], *names, path=run / WEIGHTS)
            count, slots = mesh.vertex_count, found["joint_indices"].shape[-1]
            joint_count = as_integer(found.pop("joint_count").item(), subject="joint_count", least=1, most=10_000)
            policies = tuple(map(str, found.pop("policies").tolist()))
            _check(f"{name}/joint_indices", found["joint_indices"], "i", (count, slots))
            _check(f"{name}/joint_weights", found["joint_weights"], "f", (count, slots))
            _check(f"{name}/component", found["component"], "i", (count,))
            _check(f"{name}/matched", found["matched"], "b", (count,))
            for measured in ("distance", "angle"):  # NaN where unknown
                _check(f"{name}/{measured}", found[measured], "f", (count,), finite=False)
            joints = found["joint_indices"]
            if joints.size and not (joints.min() >= 0 and joints.max() < joint_count):
                raise InputError(f"{name}/joint_indices", expected=f"joints in [0, {joint_count})", received="others")
            kept: dict[str, Any] = dict(found)
            out[name] = SkinWeights(**kept, joint_count=joint_count, policies=policies)
    return out


def load_canonical(run: Path, parts: Mapping[str, tuple[TriangleMesh, Any]]) -> dict[str, TriangleMesh]:
    """Read the parts in the T-pose."""
    groups, out = load_arrays(run / CANONICAL), {}
    for name, (mesh, _) in parts.items():
        with values_of(run / CANONICAL):
            vertices = take(groups[name], "vertices", path=run / CANONICAL)["vertices"]
            out[name] = mesh.with_vertices(as_numbers(vertices, (mesh.vertex_count, 3), subject=f"{name}/vertices"))
    return out


def _parts(file: Path) -> dict[str, tuple[TriangleMesh, dict[str, np.ndarray]]]:
    needed = ("vertices", "faces", "label", "source_vertex", "colors")
    groups = {name: take(arrays, *needed, path=file) for name, arrays in load_arrays(file).items()}
    with values_of(file):
        for arrays in groups.values():
            as_integer(arrays["label"].item(), subject="label", least=0, most=255)
        return {name: (_mesh(arrays), arrays) for name, arrays in groups.items()}


def _mesh(arrays: Mapping[str, np.ndarray]) -> TriangleMesh:
    """The mesh of a stage's arrays, whose colours and numbers of vertices in the user's file are as many as those."""
    mesh = TriangleMesh(arrays["vertices"], arrays["faces"])
    _check("colors", arrays["colors"], "u", (mesh.vertex_count, 3))
    _check("source_vertex", arrays["source_vertex"], "iu", (mesh.vertex_count,))
    return mesh


_WORDS = {"u": "whole numbers", "i": "whole numbers", "f": "numbers", "b": "true or false"}


def _check(name: str, array: np.ndarray, kinds: str, shape: tuple[int, ...], *, finite: bool = True) -> None:
    """Raise `InputError` unless an array is of one of these kinds of numpy's types and of this shape."""
    right = array.dtype.kind in kinds and array.shape == shape
    if not right or (finite and not np.isfinite(array).all()):
        received = f"{array.dtype} of shape {array.shape}" if not right else "NaN or infinity"
        raise InputError(name, expected=f"{_WORDS[kinds[0]]} of shape {shape}", received=received)
