"""Which joints a garment of a label can follow."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64

from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh

_BOTH = ("left_", "right_")
_TRUNK = ("pelvis", "spine1", "spine2", "spine3")
_ARMS = tuple(side + joint for side in _BOTH for joint in ("collar", "shoulder", "elbow", "wrist"))
_THIGHS = tuple(side + "hip" for side in _BOTH)
_LEGS = _THIGHS + tuple(side + joint for side in _BOTH for joint in ("knee", "ankle", "foot"))

# What a label can never follow: a skirt hangs beside the hands, a collar and hair touch the jaw. Everything else stays
# possible, for hair may fall down the back and a boot reach the knee.
JOINTS_OF_LABEL: dict[str, tuple[str, ...]] = {
    "hair": ("head", "neck", "left_collar", "right_collar", *_TRUNK),
    "shoe": tuple(side + joint for side in _BOTH for joint in ("knee", "ankle", "foot")),
    "lower": ("pelvis", "spine1", "spine2", *_LEGS),
    "upper": (*_TRUNK, "neck", *_ARMS, *_THIGHS),
    "outer": (*_TRUNK, "neck", *_ARMS, *_THIGHS, "left_knee", "right_knee"),
}


def restrict_source(
    source: TriangleMesh, weights: Float[np.ndarray, "V J"], allowed: Bool[np.ndarray, " J"]
) -> tuple[TriangleMesh, Float64[np.ndarray, "n J"]]:
    """The part of the source that the allowed joints own (at least half of the weight at each corner).

    Args:
        weights: (V, J). allowed: (J,) bool.

    Returns:
        The submesh and its weights, other joints' shares removed and rows renormalised.

    Raises:
        InputError: no face is left.
    """
    share = weights @ allowed.astype(np.float64)
    keep = (share >= 0.5)[source.faces].all(axis=1)
    if not keep.any():
        raise InputError(
            "config allowed_joints",
            expected="joints that own some faces of the source",
            received=f"joints {np.flatnonzero(allowed).tolist()}, which own none",
            remedy="check the joint names and their order",
        )
    mesh, used = source.submesh(keep)
    return mesh, weights[used] * allowed / share[used, None]
