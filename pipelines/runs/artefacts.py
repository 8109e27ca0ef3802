"""Read and write the arrays that the stages of a build pass to each other."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.layout import (
    CANONICAL,
    LABEL_TABLE,
    LOCATE_STAGE,
    PARAMS,
    PARTS,
    PARTS_WITHOUT_BRIDGES,
    POSED_BODY,
    SCAN,
    SCAN_LABELS,
    WEIGHTS,
)
from pipelines.runs.stage import MANIFEST, StageRecord
from smplxpp.body import BodyModel, load_params
from smplxpp.build.data import LocatedInScan, Part, PosedFit, PreparedScan
from smplxpp.core import (
    ARRAY_NAMES,
    LABELS,
    BodyParams,
    InputError,
    Labels,
    SkinWeights,
    TriangleMesh,
    require_positive,
)
from smplxpp.core.files import as_integer, as_numbers, atomic_write_text, read_arrays, read_json
from smplxpp.core.files.safe_pickle import safe_npz
from smplxpp.skinning import Unposed

LOCATED_FILES = ("params.npz", "labels.npz")
"""Files of the stage that finds the body in a scan."""


def save_scan(folder: Path, scan: PreparedScan) -> None:
    """Write the repaired scan of a run."""
    arrays = {
        "vertices": scan.mesh.vertices,
        "faces": scan.mesh.faces,
        "colors": scan.colors,
        "source_vertex": scan.source_vertex,
        "source_face": scan.source_face,
    }
    save_arrays(folder / Path(SCAN).name, {"scan": arrays})


# Remedies of the errors below: a file whose arrays are missing, and one whose values cannot be used.
_DAMAGED = "the stage's file is damaged: delete the stage's folder and give the command again"
_FOREIGN = "it was written by another version or is damaged: delete its folder and give the command that makes it again"
# Exceptions of code that takes apart values of another kind than it expects.
_OF_ANOTHER_KIND = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
_KINDS = {"u": "whole numbers", "i": "whole numbers", "f": "numbers", "b": "true or false"}


def load_scan(run: Path) -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    """Read the repaired scan of a run: mesh, (N, 3) colours, (N,) index of each vertex in the user's file."""
    arrays = load_arrays(run / SCAN).get("scan", {})
    found = take(arrays, "vertices", "faces", "colors", "source_vertex", path=run / SCAN)
    with values_of(run / SCAN):
        return _mesh(found), found["colors"], found["source_vertex"]


def load_source_faces(run: Path) -> np.ndarray:
    """Read the index of each of the scan's faces in the user's file."""
    return take(load_arrays(run / SCAN).get("scan", {}), "source_face", path=run / SCAN)["source_face"]


def load_prepared_scan(run: Path) -> PreparedScan:
    """Read the prepared scan that `save_scan` wrote."""
    mesh, colors, source_vertex = load_scan(run)
    source_face = load_source_faces(run)
    with values_of(run / SCAN):
        _check("source_face", source_face, "iu", (mesh.face_count,))
        return PreparedScan(mesh, colors, source_vertex, source_face)


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


def load_scan_labels(run: Path, faces: int) -> np.ndarray:
    """Read the labels of the scan's faces, one for each of `faces`."""
    (labels,) = read_named(run / SCAN_LABELS, "face_labels")
    with values_of(run / SCAN_LABELS):
        _check("face_labels", labels, "iu", (faces,))
        return labels


def save_labels(folder: Path, labels: Labels) -> None:
    """Write what the ids of labels stand for, unless they are the built-in ones."""
    if labels != LABELS:
        atomic_write_text(folder / Path(LABEL_TABLE).name, json.dumps(labels.as_list(), indent=1) + "\n")


def load_labels(run: Path) -> Labels:
    """Read what the ids of a run's labels stand for: what `save_labels` wrote, or the built-in labels."""
    path = run / LABEL_TABLE
    return Labels.from_list(read_json(path), subject=f"file {path}") if path.is_file() else LABELS


def save_fit(folder: Path, fit: PosedFit) -> None:
    """Write the fitted body of the reference frame."""
    np.savez(
        folder / Path(POSED_BODY).name,
        vertices=fit.mesh.vertices,
        rest_vertices=fit.at_rest.vertices,
        joints=fit.joints,
        rest_joints=fit.rest_joints,
        posed_from_rest=fit.posed_from_rest,
    )


def load_fit(run: Path, body: BodyModel) -> PosedFit:
    """Read the posed body that `save_fit` wrote."""
    V, J = body.vertex_count, body.joint_count
    shapes = {
        "vertices": (V, 3),
        "rest_vertices": (V, 3),
        "joints": (J, 3),
        "rest_joints": (J, 3),
        "posed_from_rest": (J, 4, 4),
    }
    # A file of another body model has other sizes, which is an error with the name of the array.
    arrays = dict(zip(shapes, read_named(run / POSED_BODY, *shapes), strict=True))
    with values_of(run / POSED_BODY):
        found = {name: as_numbers(arrays[name], shape, subject=name) for name, shape in shapes.items()}
        return PosedFit(
            body.mesh(found["vertices"]),
            body.mesh(found["rest_vertices"]),
            found["joints"],
            found["rest_joints"],
            found["posed_from_rest"],
        )


def save_located(folder: Path, located: LocatedInScan) -> None:
    """Write the body that was found in a scan: one row of parameters, certain labels, and the body's bare vertices."""
    params, labels = LOCATED_FILES
    located.params.save(folder / params)
    np.savez(folder / labels, labels=located.labels, bare=located.bare, scale=np.float64(located.scale))


def load_located(folder: Path) -> LocatedInScan:
    """Read the located body that `save_located` wrote.

    Raises:
        InputError: files of another version.
    """
    params, file = LOCATED_FILES
    labels, bare = read_named(folder / file, "labels", "bare")
    with values_of(folder / file):
        return LocatedInScan(load_params(folder / params), labels.astype(np.int64), bare.astype(bool))


def load_scan_scale(run: Path) -> float:
    """Read by how much the stage that found the body scales the scan, as it was read, to the stated stature."""
    path = run / LOCATE_STAGE / LOCATED_FILES[1]
    (scale,) = read_named(path, "scale")
    with values_of(path):
        value = float(as_numbers(scale, (), subject="scale"))
        require_positive("scale", value)
        return value


def save_parts(folder: Path, parts: Mapping[str, Part]) -> None:
    """Write loose parts in the reference pose."""
    groups = {
        name: {
            "vertices": part.mesh.vertices,
            "faces": part.mesh.faces,
            "label": np.array(part.label),
            "source_vertex": part.source_vertex,
            "colors": part.colors,
        }
        for name, part in parts.items()
    }
    save_arrays(folder / Path(PARTS).name, groups)


def load_cleaned_parts(run: Path) -> dict[str, Part]:
    """Read the cleaned parts in the reference pose."""
    return _parts(run / PARTS)


def load_parts(run: Path) -> dict[str, Part]:
    """Read the parts without bridges, which is what the skin weights are for."""
    return _parts(run / PARTS_WITHOUT_BRIDGES)


def save_weights(folder: Path, weights: Mapping[str, SkinWeights]) -> None:
    """Write the skin weights of parts."""
    names = [field.name for field in fields(SkinWeights)]
    groups = {part: {name: np.asarray(getattr(found, name)) for name in names} for part, found in weights.items()}
    save_arrays(folder / Path(WEIGHTS).name, groups)


def load_weights(run: Path, parts: Mapping[str, Part]) -> dict[str, SkinWeights]:
    """Read the skin weights of the parts."""
    out = {}
    names, groups = [field.name for field in fields(SkinWeights)], load_arrays(run / WEIGHTS)
    for name, part in parts.items():
        with values_of(run / WEIGHTS):
            found = take(groups[name], *names, path=run / WEIGHTS)
            count, slots = part.mesh.vertex_count, found["joint_indices"].shape[-1]
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


def save_canonical(folder: Path, parts: Mapping[str, Unposed]) -> None:
    """Write the vertices of parts in the T-pose, and the determinants of what brought them there."""
    groups = {name: {"vertices": part.vertices, "determinant": part.determinant} for name, part in parts.items()}
    save_arrays(folder / Path(CANONICAL).name, groups)


def load_canonical(run: Path, parts: Mapping[str, Part]) -> dict[str, TriangleMesh]:
    """Read the parts in the T-pose."""
    groups, out = load_arrays(run / CANONICAL), {}
    for name, part in parts.items():
        with values_of(run / CANONICAL):
            vertices = take(groups[name], "vertices", path=run / CANONICAL)["vertices"]
            shape = (part.mesh.vertex_count, 3)
            out[name] = part.mesh.with_vertices(as_numbers(vertices, shape, subject=f"{name}/vertices"))
    return out


def _parts(file: Path) -> dict[str, Part]:
    needed = ("vertices", "faces", "label", "source_vertex", "colors")
    groups = {name: take(arrays, *needed, path=file) for name, arrays in load_arrays(file).items()}
    with values_of(file):
        out = {}
        for name, arrays in groups.items():
            label = as_integer(arrays["label"].item(), subject="label", least=0, most=255)
            out[name] = Part(_mesh(arrays), label, arrays["source_vertex"], arrays["colors"])
        return out


def _mesh(arrays: Mapping[str, np.ndarray]) -> TriangleMesh:
    """Return the mesh of a stage's arrays, after checks of its colours and source vertices."""
    mesh = TriangleMesh(arrays["vertices"], arrays["faces"])
    _check("colors", arrays["colors"], "u", (mesh.vertex_count, 3))
    _check("source_vertex", arrays["source_vertex"], "iu", (mesh.vertex_count,))
    return mesh


def _check(name: str, array: np.ndarray, kinds: str, shape: tuple[int, ...], *, finite: bool = True) -> None:
    """Raise `InputError` unless an array is of one of these kinds of numpy's types and of this shape."""
    right = array.dtype.kind in kinds and array.shape == shape
    if not right or (finite and not np.isfinite(array).all()):
        received = f"{array.dtype} of shape {array.shape}" if not right else "NaN or infinity"
        raise InputError(name, expected=f"{_KINDS[kinds[0]]} of shape {shape}", received=received)


def save_arrays(path: Path, groups: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write `{group: {name: array}}` as `group/name`."""
    flat: dict[str, Any] = {f"{g}/{name}": array for g, arrays in groups.items() for name, array in arrays.items()}
    # A bare person has no parts, and an archive without arrays would look damaged.
    np.savez(path, **(flat or {"none": np.zeros(0)}))


def load_arrays(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Read what `save_arrays` wrote, groups in their order.

    Raises:
        InputError: missing, damaged or foreign file.
    """
    groups: dict[str, dict[str, np.ndarray]] = {}
    arrays = read_arrays(path, subject="stage file", remedy=_DAMAGED)
    if list(arrays) == ["none"]:
        return {}
    for key, array in arrays.items():
        group, slash, name = key.partition("/")
        if not slash:
            raise InputError(f"stage file {path}", expected="arrays in groups", received=key, remedy=_DAMAGED)
        groups.setdefault(group, {})[name] = array
    return groups


def read_named(path: Path, *names: str) -> tuple[np.ndarray, ...]:
    """Read arrays of a stage's npz file by their names.

    Raises:
        InputError: missing, damaged or foreign file, or one without them.
    """
    arrays = read_arrays(path, subject="stage file", remedy=_DAMAGED)
    return tuple(take(arrays, *names, path=path).values())


def take(arrays: Mapping[str, np.ndarray], *names: str, path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of these names.

    Raises:
        InputError: one is missing.
    """
    missing = [name for name in names if name not in arrays]
    if missing:
        raise InputError(
            f"stage file {path}", expected=f"the array {missing[0]}", received="a file without it", remedy=_DAMAGED
        )
    return {name: arrays[name] for name in names}


@contextmanager
def values_of(file: Path | StageRecord) -> Iterator[None]:
    """Name the file in errors of the lines that use its values, or the values of a stage's manifest.

    Only code that uses values read from the file belongs there, because a mistake of ours in those lines would be
    reported as one of the file. Records that this process has made itself were never read; their errors pass unchanged.

    Raises:
        InputError: missing entries, entries of another kind, or an `InputError` of the lines themselves.
    """
    if isinstance(file, StageRecord) and file.ran:
        yield
        return
    path = file.folder / MANIFEST if isinstance(file, StageRecord) else file
    try:
        yield
    except InputError as error:
        if isinstance(file, StageRecord) or str(path) in str(error):  # files of the stage name themselves
            raise
        raise InputError(
            f"file {path}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy or _FOREIGN,
        ) from error
    except _OF_ANOTHER_KIND as error:
        received = f"{type(error).__name__}: {error}"[:200]
        raise InputError(
            f"file {path}", expected="the entries that this version writes", received=received, remedy=_FOREIGN
        ) from error
