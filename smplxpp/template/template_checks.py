"""What the file of a template must hold before a template is made of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from smplxpp.core.errors import InputError
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
}
_WORDS = {"f": "floats", "i": "integers", "b": "bools", "U": "texts"}
_ROW_SUM = 1e-6  # by which the weights of a vertex may miss 1


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
    if not np.isfinite(weights).all() or (weights < 0).any() or (np.abs(sums - 1.0) > _ROW_SUM).any():
        raise InputError(
            "weights_joint_weights", expected="finite values, none negative, rows that sum to 1", received="others"
        )
