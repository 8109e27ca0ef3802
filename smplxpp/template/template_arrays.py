"""The arrays of a template's file by name: made of a template, checked, and read back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body.model import BodyModel
from smplxpp.core import LABELS, InputError, Labels, SkinWeights
from smplxpp.core.files.json_file import as_object, as_text, parse_json

# Kind of numbers ("f": any floats, "i": any integers, "b": bools, "U": texts) and number of axes, by name in the file.
_KINDS = {
    "vertices": ("f", 2),
    "faces": ("i", 2),
    "vertex_labels": ("i", 1),
    "vertex_part": ("i", 1),
    "vertex_colors": ("i", 2),
    "part_names": ("U", 1),
    "betas": ("f", 1),
    "body_index": ("i", 1),
    "scan_index": ("i", 1),
    "metadata": ("U", 0),
    "weights_joint_indices": ("i", 2),
    "weights_joint_weights": ("f", 2),
    "weights_joint_count": ("i", 0),
    "weights_matched": ("b", 1),
    "weights_distance": ("f", 1),
    "weights_angle": ("f", 1),
    "weights_component": ("i", 1),
    "weights_policies": ("U", 1),
    "joint_regressor": ("f", 2),
    "parents": ("i", 1),
    "joint_names": ("U", 1),
    "shape_basis": ("f", 3),
    "expression_basis": ("f", 3),
    "body_labels": ("i", 1),
    "body_label_names": ("U", 1),
}
_OPTIONAL = {
    "pose_basis": ("f", 3),
    "left_hand_components": ("f", 2),
    "right_hand_components": ("f", 2),
    "left_hand_mean": ("f", 1),
    "right_hand_mean": ("f", 1),
    "expression_names": ("U", 1),
    "labels": ("U", 0),
}
_WORDS = {"f": "floats", "i": "integers", "b": "bools", "U": "texts"}


def check_arrays(arrays: Mapping[str, np.ndarray]) -> None:
    """Look at kinds and axes, and at what a template does not look at itself: the skeleton and the weights.

    Raises:
        InputError: the first array that is missing or wrong.
    """
    for name, (kind, axes) in {**_KINDS, **_OPTIONAL}.items():
        array = arrays.get(name)
        if array is None and name in _OPTIONAL:
            continue
        wanted = f"{_WORDS[kind]} with {axes} axes"
        if array is None:
            raise InputError(name, expected=wanted, received="none")
        found = "i" if array.dtype.kind == "u" else array.dtype.kind
        if found != kind or array.ndim != axes:
            raise InputError(name, expected=wanted, received=f"{array.dtype} with {array.ndim}")
    _check_skeleton(arrays["parents"])
    _check_weights(arrays)


def metadata_of(arrays: Mapping[str, np.ndarray]) -> dict[str, str]:
    """The texts that a template's file says of it.

    Raises:
        InputError: something else than a JSON object of texts.
    """
    values = as_object(parse_json(str(arrays["metadata"]), subject="metadata"), subject="metadata")
    return {name: as_text(value, subject=f"metadata {name}") for name, value in values.items()}


def labels_of(arrays: Mapping[str, np.ndarray]) -> Labels:
    """The labels of a template's file, the built-in ones where it names none.

    Raises:
        InputError: something else than a list of labels.
    """
    if "labels" not in arrays:
        return LABELS
    return Labels.from_list(parse_json(str(arrays["labels"]), subject="labels"))


def _check_skeleton(parents: np.ndarray) -> None:
    """Every joint hangs on the root; their order is free."""
    count, ancestors = len(parents), parents.astype(np.int64)
    if not count or ancestors.min() < -1 or ancestors.max() >= count:
        raise InputError("parents", expected=f"joints in [0, {count}), -1 for a root", received="others, or no joints")
    for _ in range(count):  # joints have fewer ancestors than there are joints, unless they are their own
        ancestors = np.where(ancestors < 0, -1, ancestors[ancestors])
    above = np.flatnonzero(ancestors >= 0)
    if len(above):
        raise InputError("parents", expected="a tree", received=f"joint {above[0]} above itself or one that is")


def _check_weights(arrays: Mapping[str, np.ndarray]) -> None:
    row_sum = 1e-6  # largest difference of the sum of a vertex's weights from 1
    indices, weights = arrays["weights_joint_indices"], arrays["weights_joint_weights"]
    vertices, joints = len(arrays["vertices"]), len(arrays["parents"])
    if indices.shape != weights.shape or len(indices) != vertices:
        raise InputError(
            "weights",
            expected=f"joints and weights of {vertices} vertices",
            received=f"{indices.shape}, {weights.shape}",
        )
    for name in ("matched", "distance", "angle", "component"):
        if len(arrays[f"weights_{name}"]) != vertices:
            raise InputError(
                f"weights_{name}", expected=f"{vertices} values", received=str(len(arrays[f"weights_{name}"]))
            )
    if indices.size and not 0 <= indices.min() <= indices.max() < joints:
        raise InputError("weights_joint_indices", expected=f"joints in [0, {joints})", received="others")
    sums = weights.sum(axis=1) if weights.size else np.ones(vertices)
    if not np.isfinite(weights).all() or (weights < 0).any() or (np.abs(sums - 1.0) > row_sum).any():
        raise InputError(
            "weights_joint_weights", expected="finite values, none negative, rows that sum to 1", received="others"
        )


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
    *("body_labels", "body_label_names", "body_index", "scan_index", "expression_names", "metadata", "labels"),
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
        uv=None,
    )


def fitted_regressor(
    start: Float64[np.ndarray, "J V"],
    vertices: Float64[np.ndarray, "V 3"],
    bases: Float64[np.ndarray, "V 3 K"],
    *,
    joints: Float64[np.ndarray, "J 3"],
    moved: Float64[np.ndarray, "J 3 K"],
    sums: Float64[np.ndarray, " J"],
) -> Float64[np.ndarray, "J V"]:
    """Return the joint regressor nearest to another one that puts the joints where they belong on a changed surface.

    `min |R - S|^2` where `R v = J`, `R 1 = s` and `R e_k = d_k` for every base: rest joints, and how expressions move
    them (jaw and eyes), stay what they were.

    Args:
        start: regressor S to stay near to.
        vertices: v of the new surface, metres.
        bases: displacements e_k of its vertices, metres a unit.
        joints: J at rest, metres.
        moved: displacements d_k of the joints, metres a unit.
        sums: s of the rows, 1 where a joint moves with the body.
    """
    count = len(vertices)
    known = np.hstack([vertices, np.ones((count, 1)), bases.reshape(count, -1)])
    wanted = np.hstack([joints, sums[:, None], moved.reshape(len(joints), -1)])
    # Fewer conditions than vertices: of all solutions least squares returns the shortest.
    change = np.linalg.lstsq(known.T, (wanted - start @ known).T, rcond=None)[0]
    return start + change.T


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
