"""How firmly every vertex of a template sits on the body: cloth must not drag it."""

from __future__ import annotations

from collections.abc import Mapping

import igl
import numpy as np
from jaxtyping import Float64

from avatar.training.refinement.config import CLOTH_FACTORS
from smplxpp.core.labels import CLOTH_LABELS
from smplxpp.template.template import Template

LOOSE = 0.02
"""Firmness below this is none: what hangs there says nothing of the body."""


def firmness(
    template: Template, reach: float, *, factors: Mapping[str, float] = CLOTH_FACTORS
) -> Float64[np.ndarray, " V"]:
    """Return how much of a vertex's pull reaches the pose, from 0 to 1.

    1 on body, hair and shoes; on clothes `c exp(-(d / reach)^2)` with d the distance from the naked body in the T-pose
    and c the label's factor, 0 below `LOOSE`: a waistband says where the body is, a hem does not.

    Args:
        reach: metres. factors: c by the label's name.
    """
    firm = np.ones(template.vertex_count)
    cloth = np.flatnonzero(template.cloth_mask)
    if len(cloth):
        body = template.part_mesh("body")
        squared = igl.point_mesh_squared_distance(template.vertices[cloth], body.vertices, body.faces)[0]
        of_label = {label.id: factors.get(label.name, 0.0) for label in CLOTH_LABELS}
        factor = np.array([of_label[int(label)] for label in template.vertex_labels[cloth]])
        firm[cloth] = factor * np.exp(-squared / reach**2)
    firm[firm < LOOSE] = 0.0
    return firm
