"""The arrays of a template's file by name: its body model and its weights to plain arrays, and back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body.model import BodyModel
from smplxpp.core import InputError, SkinWeights

# Raised when a reader of the older layout would misread the file.
SCHEMA = 1
SCHEMA_KEY = "smplxpp_template_schema"
# What the file calls a field of the body model. The rest of the model is the template's own: its mean shape, faces and
# weights are those of the first part, its name is in the metadata.
BODY_KEYS = {
    "joint_regressor": "joint_regressor",
    "parents": "parents",
    "joint_names": "joint_names",
    "shapedirs": "shape_basis",
    "exprdirs": "expression_basis",
    "posedirs": "pose_basis",
    "left_hand_components": "left_hand_components",
    "right_hand_components": "right_hand_components",
    "left_hand_mean": "left_hand_mean",
    "right_hand_mean": "right_hand_mean",
    "part_labels": "body_labels",
    "part_label_names": "body_label_names",
    "expression_names": "expression_names",
}
# The order in which a file holds its arrays; those of the weights stand together.
_ORDER = (
    *(SCHEMA_KEY, "vertices", "faces", "vertex_labels", "vertex_part", "part_names", "vertex_colors", "weights"),
    *("joint_regressor", "parents", "joint_names", "betas", "shape_basis", "expression_basis", "pose_basis"),
    *("left_hand_components", "right_hand_components", "left_hand_mean", "right_hand_mean"),
    *("body_labels", "body_label_names", "body_index", "scan_index", "expression_names", "metadata"),
)
_WEIGHTS = "weights_"
_BASES = ("shapedirs", "exprdirs", "posedirs")


def body_arrays(body: BodyModel) -> dict[str, np.ndarray]:
    """The body's own arrays as a file names them, bases in float32; those that it lacks are left out."""
    arrays = {key: getattr(body, name) for name, key in BODY_KEYS.items()}
    bases = {BODY_KEYS[name] for name in _BASES}
    return {
        key: plain_array(value).astype(np.float32) if key in bases else plain_array(value)
        for key, value in arrays.items()
        if value is not None
    }


def body_from_arrays(arrays: Mapping[str, np.ndarray], *, name: str) -> BodyModel:
    """The body model that `body_arrays` took apart; the template it belongs to gives it surface and weights.

    Raises:
        KeyError: an array that no file is without.
        InputError: arrays that do not fit each other.
    """
    regressor, pose_basis = arrays["joint_regressor"], arrays.get("pose_basis")
    joint_count, vertex_count = regressor.shape
    return BodyModel(
        name=name,
        v_template=np.zeros((vertex_count, 3)),
        faces=np.zeros((0, 3), np.int64),
        shapedirs=_as_float(arrays["shape_basis"]),
        exprdirs=_as_float(arrays["expression_basis"]),
        posedirs=None if pose_basis is None else _as_float(pose_basis),
        joint_regressor=regressor,
        parents=arrays["parents"],
        joint_names=_texts(arrays["joint_names"]),
        weights=np.zeros((vertex_count, joint_count)),
        left_hand_components=arrays.get("left_hand_components"),
        right_hand_components=arrays.get("right_hand_components"),
        left_hand_mean=arrays.get("left_hand_mean"),
        right_hand_mean=arrays.get("right_hand_mean"),
        part_labels=arrays["body_labels"],
        part_label_names=_texts(arrays["body_label_names"]),
        expression_names=_texts(arrays.get("expression_names", ())),
    )


def completed_body(
    body: BodyModel,
    *,
    vertices: Float64[np.ndarray, "V 3"],
    faces: Int64[np.ndarray, "F 3"],
    weights: Float64[np.ndarray, "V J"],
) -> BodyModel:
    """The body on a surface of its own, its arrays read-only and as they come out of a file: bases in float32."""
    return replace(
        body,
        v_template=vertices,
        faces=faces,
        weights=weights,
        shapedirs=_rounded(body.shapedirs),
        exprdirs=_rounded(body.exprdirs),
        posedirs=None if body.posedirs is None else _rounded(body.posedirs),
        joint_regressor=read_only(body.joint_regressor, np.float64),
        parents=read_only(body.parents, np.int64),
        left_hand_components=_optional(body.left_hand_components),
        right_hand_components=_optional(body.right_hand_components),
        left_hand_mean=_optional(body.left_hand_mean),
        right_hand_mean=_optional(body.right_hand_mean),
        part_labels=read_only(body.part_labels, np.int64),
        landmarks={},
    )


def weight_arrays(weights: SkinWeights) -> dict[str, np.ndarray]:
    """All of the weights and where they came from, as a file names them."""
    return {_WEIGHTS + f.name: plain_array(getattr(weights, f.name)) for f in fields(SkinWeights)}


def weights_from_arrays(arrays: Mapping[str, np.ndarray]) -> SkinWeights:
    """The weights that `weight_arrays` took apart.

    Raises:
        KeyError: one that is missing.
        InputError: indices of more than 32 bits.
    """
    return SkinWeights(
        joint_indices=_int32(arrays, f"{_WEIGHTS}joint_indices"),
        joint_weights=arrays[f"{_WEIGHTS}joint_weights"],
        joint_count=int(arrays[f"{_WEIGHTS}joint_count"]),
        matched=arrays[f"{_WEIGHTS}matched"],
        distance=arrays[f"{_WEIGHTS}distance"],
        angle=arrays[f"{_WEIGHTS}angle"],
        component=_int32(arrays, f"{_WEIGHTS}component"),
        policies=_texts(arrays[f"{_WEIGHTS}policies"]),
    )


def _int32(arrays: Mapping[str, np.ndarray], key: str) -> np.ndarray:
    values = arrays[key]
    out = values.astype(np.int32) if values.dtype.kind in "iu" else None
    if out is None or (out != values).any():
        raise InputError(f"template: {key}", expected="indices of 32 bits", received=f"others, of type {values.dtype}")
    return out


def in_file_order(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays in the order in which a file holds them."""

    def place(key: str) -> int:
        return _ORDER.index("weights" if key.startswith(_WEIGHTS) else key)

    return {key: arrays[key] for key in sorted(arrays, key=place)}


def plain_array(value: object) -> np.ndarray:
    """An array of a field's value; no texts become an array of no texts, not of no numbers."""
    array = np.asarray(value)
    return array if array.size or not isinstance(value, tuple) else np.zeros(0, dtype="<U1")


def read_only(value: object, dtype: type) -> np.ndarray:
    """A copy that cannot be written, rows one after the other in memory."""
    array: np.ndarray = np.array(value, dtype=dtype, order="C")
    array.setflags(write=False)
    return array


def _rounded(basis: np.ndarray) -> np.ndarray:
    return read_only(np.array(basis, np.float32), np.float64)


def _optional(array: np.ndarray | None) -> np.ndarray | None:
    return None if array is None else read_only(array, np.float64)


def _as_float(basis: np.ndarray) -> np.ndarray:
    return basis.astype(np.float64)


def _texts(values: Iterable[object]) -> tuple[str, ...]:
    return tuple(map(str, values))
