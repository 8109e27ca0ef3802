"""Which vertices of the target the body settles, and what these say about the others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer.inpaint import fit_smoothly

_TOGETHER = 0.1  # two joints are neighbours where a vertex follows both by at least this
_NEIGHBOUR = 0.1  # how far a neighbour of the joint of the anchor weights may count, against that joint
LEAST_REACH = 1e-6  # the whole body speaks where nothing that may speak is near
_OWN = 0.3  # a joint with this share of the confident cloth's weight is no longer what the label says about it
_UNHEARD = (0.01, 0.001)  # share of the body nearby that may speak: from the first to the second it loses its say
_UNHEARD_AWAY = (0.5, 0.1)  # ... for a vertex that faces away from it
_AWAY = (np.radians(35.0), np.radians(70.0))
_DOUBTED = (np.radians(15.0), np.radians(45.0))


def anchor_weights(
    mesh: TriangleMesh,
    copied: Float[np.ndarray, "N J"],
    confident: Bool[np.ndarray, " N"],
    *,
    length: float,
    laplacian: str,
) -> Float64[np.ndarray, "N J"]:
    """Inpaint the weights of confident vertices along the surface: these keep theirs, the others follow from them.

    Args:
        mesh: every vertex referenced. copied: weights of the closest points; components without a confident vertex
            keep them. length, laplacian: see `fit_smoothly`.

    Returns:
        (N, J), none negative, rows summing to 1.
    """
    known = copied.any(axis=0)
    out = np.zeros_like(copied, dtype=np.float64)
    width = np.where(confident, 0.0, np.inf)
    out[:, known] = np.clip(fit_smoothly(mesh, copied[:, known], width, length=length, laplacian=laplacian), 0.0, 1.0)
    return out / out.sum(axis=1, keepdims=True)


def neighbouring_joints(weights: Float[np.ndarray, "V J"]) -> Bool[np.ndarray, "J J"]:
    """The pairs of joints that some vertex follows both, each with itself: the skeleton as the weights show it."""
    strong = (weights > _TOGETHER).astype(np.float64)
    return (strong.T @ strong > 0) | np.eye(weights.shape[1], dtype=bool)


def joint_reach(
    anchors: Float[np.ndarray, "N J"], neighbours: Bool[np.ndarray, "J J"], allowed: Bool[np.ndarray, " J"] | None
) -> Float64[np.ndarray, "N J"]:
    """How far each joint may speak for a vertex: wholly where confident cloth leads to it, a little beside that.

    A sleeve that hangs before the thigh has anchor weights of the arm, and the thigh, no neighbour of the arm, is not
    asked; neither is the hand beside a skirt. What a label excludes (`allowed`) is not asked either, unless confident
    cloth
    follows it.
    """
    passed_on = np.where(neighbours, _NEIGHBOUR, 0.0)
    np.fill_diagonal(passed_on, 1.0)
    reach = np.minimum(anchors @ passed_on, 1.0)
    return reach if allowed is None else np.where(allowed | (anchors > _OWN), reach, 0.0)


def anchor_share(
    distance: Float[np.ndarray, " N"],
    angle: Float[np.ndarray, " N"],
    heard: Float[np.ndarray, " N"],
    *,
    far: tuple[float, float],
) -> Float64[np.ndarray, " N"]:
    """Return the share, 0 to 1, with which anchor weights replace the weights of the body nearby.

    Smoothly from 0 to 1 between the two distances `far` (metres); where hardly any of the body nearby may speak
    (`heard`, a share); and, for a vertex that faces away from the skin nearest to it (`angle`, radians), where less
    than half of it may: hair that lies against a raised arm, a sleeve that hangs beside the chest.
    """
    away = smooth_step(_angle(angle), *_AWAY) * smooth_step(heard, *_UNHEARD_AWAY)
    return 1.0 - (1.0 - smooth_step(distance, *far)) * (1.0 - smooth_step(heard, *_UNHEARD)) * (1.0 - away)


def turned_away(angle: Float[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """0 to 1: how far a vertex that faces so (radians) against the nearest skin is doubted, however near it lies."""
    return smooth_step(_angle(angle), *_DOUBTED)


def speaking(reach: Float[np.ndarray, "N J"], weights: Float[np.ndarray, "S J"]) -> Float64[np.ndarray, "N S"]:
    """How far each point of the body, by its weights, may speak for each vertex."""
    return np.maximum(reach @ weights.T, LEAST_REACH)


def components_without(component: Int32[np.ndarray, " N"], confident: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """The vertices of components that have no confident vertex."""
    return (np.bincount(component, confident) == 0)[component]


def _angle(angle: np.ndarray) -> np.ndarray:
    """Radians; 0 for a vertex without a normal, which faces nowhere."""
    return np.nan_to_num(angle, nan=0.0)


def smooth_step(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """A smooth step from 0 at `start` to 1 at `end` (either order)."""
    t = np.clip((x - start) / (end - start), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
