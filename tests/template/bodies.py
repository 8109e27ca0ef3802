"""Naked bodies of small templates: joints and bases alone, the template fills in surface and weights."""

from __future__ import annotations

import numpy as np

from smplxpp.body import BodyModel


def small_body(
    *,
    joint_regressor: np.ndarray,
    parents: np.ndarray,
    joint_names: tuple[str, ...],
    shapedirs: np.ndarray,
    exprdirs: np.ndarray,
    posedirs: np.ndarray | None = None,
    hand_means: np.ndarray | None = None,
) -> BodyModel:
    """A body of one anatomical part without hand PCA, its surface and weights still zero.

    Args:
        joint_regressor: (J, V).
        parents: (J,).
        joint_names: J names.
        shapedirs, exprdirs, posedirs: (V, 3, ...) metres a unit.
        hand_means: (2, 45) the left hand's and the right's.
    """
    joints, vertices = joint_regressor.shape
    means = (None, None) if hand_means is None else hand_means
    return BodyModel(
        name="template",
        v_template=np.zeros((vertices, 3)),
        faces=np.zeros((0, 3), np.int64),
        shapedirs=shapedirs,
        exprdirs=exprdirs,
        posedirs=posedirs,
        joint_regressor=joint_regressor,
        parents=parents,
        joint_names=joint_names,
        weights=np.zeros((vertices, joints)),
        left_hand_components=None,
        right_hand_components=None,
        left_hand_mean=means[0],
        right_hand_mean=means[1],
        part_labels=np.zeros(vertices, np.int64),
        part_label_names=("all",),
    )
