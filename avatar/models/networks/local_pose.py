"""Masks of the joints that influence a vertex, by steps along the skeleton."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64

from smplxpp.template.template import Template

MIN_SKIN_WEIGHT = 0.05
"""Least skin weight with which a joint carries a vertex."""
BODY_JOINTS = 21
"""Number of joints in theta: joints 1 to 21 of the skeleton."""


def seen_joints(template: Template, steps: int) -> Bool[np.ndarray, "V 21"]:
    """Mark, for each vertex, the joints of theta within `steps` of one that carries the vertex, along the skeleton.

    With few training poses, a skirt would overfit to the arms of those poses. Saito et al., "SCANimate" (2021), mask
    the pose by skin weights for the same reason.
    """
    return joint_steps(template) <= steps


def joint_steps(template: Template) -> Int64[np.ndarray, "V 21"]:
    """Count, for each vertex, the steps from each joint of theta to the nearest joint with skin weight on it."""
    parents = np.asarray(template.body.parents)
    # Adjacency of the skeleton; then grow the set of carrying joints step by step (breadth-first search).
    near = np.eye(len(parents), dtype=bool)
    children = np.flatnonzero(parents >= 0)
    near[children, parents[children]] = near[parents[children], children] = True
    seen = template.weights.dense() > MIN_SKIN_WEIGHT
    steps = np.where(seen, 0, len(parents))
    for count in range(1, len(parents)):
        seen = seen @ near
        steps = np.where(seen, np.minimum(steps, count), steps)
    return steps[:, 1 : BODY_JOINTS + 1].astype(np.int64)
