"""Draw the body's feet into its shoes.

The shape of a body has one foot for everybody: it is longer than a small shoe, stands flat in a heel, and its toes
come through the front. No one sees a foot in a shoe, and a shoe is stiff, so that the foot yields: a vertex in
front of the shoe's surface goes to the nearest place behind it. The joints stay where they are. With the moved
vertices v' and the row r of a joint's regressor, the new row is r' = r (1 + [v' 1] y) with the y that solves

    sum_i r'_i v'_i = sum_i r_i v_i,    sum_i r'_i = sum_i r_i,

the smallest change relative to r.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core import SkinWeights, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField

_LEATHER = 0.002
"""Metres behind the surface of a shoe at which the skin begins; soles are thicker, the uppers of pumps are as thin."""
_FARTHEST = 0.08
"""Largest length in metres that a vertex is drawn in; what lies farther from every shoe is not in one."""
_ROUNDS = 4
"""Rounds of drawing in; after the first, a vertex may have come in front of another side of the shoe."""


def feet_in_shoes(
    body: BodyModel, rest: Float64[np.ndarray, "V 3"], shoes: list[tuple[TriangleMesh, SkinWeights]]
) -> tuple[Float64[np.ndarray, "V 3"], BodyModel]:
    """Return the body's vertices with its feet inside the shoes, and the model whose joints stay where they were.

    Args:
        body: the body model.
        rest: its vertices in the T-pose, metres.
        shoes: open surfaces in the T-pose, outward, with their skin weights. Toes bend as far as the shoe around them.

    Example:
        >>> from smplxpp.assemble.feet import feet_in_shoes
        >>> body = smplxpp.load_body()
        >>> same, _ = feet_in_shoes(body, body.v_template, [])
        >>> bool((same == body.v_template).all())
        True
    """
    moved, weights = rest.copy(), body.weights.copy()
    middle = float(rest[:, 0].mean())
    for side, (shoe, bound) in product(("left", "right"), shoes):
        # In the T-pose the left shoe lies on the side of the left foot, +x.
        own = (shoe.face_centers[:, 0] > middle) == (side == "left")
        if not (shoe.face_areas[own] > 0).any():
            continue
        foot = [body.joint_names.index(f"{side}_{joint}") for joint in ("ankle", "foot")]
        rows = np.flatnonzero(body.weights[:, foot].sum(axis=1) > 0.5)
        # The largest weight of the toes' joint in the shoe is the share of their turn that it makes.
        bends = float(bound.dense()[:, foot[1]].max())
        weights[:, foot] += (1.0 - bends) * weights[:, foot[1:]] * [1.0, -1.0]
        field = SignedDistanceField(shoe.submesh(own)[0], solid=False)
        for _ in range(_ROUNDS):
            found = field.query(moved[rows])
            # Beside the opening the surface has no sides; there the foot leaves the shoe.
            out = (found.distance > -_LEATHER) & (found.distance < _FARTHEST) & ~found.on_border
            if not out.any():
                break
            moved[rows[out]] = found.closest[out] - 1.01 * _LEATHER * found.normal[out]
    changed = np.abs(moved - rest).max(axis=1) > 0
    if not shoes:
        return rest, body
    # Rows of joints that depend on a moved vertex.
    regressor = body.joint_regressor.copy()
    for joint in np.flatnonzero((regressor[:, changed] != 0).any(axis=1)):
        used = np.flatnonzero(regressor[joint])
        row, places = regressor[joint, used], np.concatenate([moved[used], np.ones((len(used), 1))], axis=1)
        missing = np.append(row @ (rest[used] - moved[used]), 0.0)
        y = np.linalg.lstsq(places.T @ (row[:, None] * places), missing, rcond=None)[0]
        regressor[joint, used] = row * (1.0 + places @ y)
    return moved, replace(body, joint_regressor=regressor, weights=weights)
