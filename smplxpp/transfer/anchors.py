"""Compute anchor weights: what confident vertices of the target imply for the others, and where that counts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int32
from scipy.sparse import csr_matrix

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer.inpaint import Operators, fit_smoothly

LEAST_ADMISSIBILITY = 1e-6
"""Floor of every admissibility: where nothing admissible is near, all points of the body count alike."""
_TOUCHES = 0.01
"""Distance within which cloth touches the skin, as a share of the body's extent (2 cm)."""


def anchor_weights(
    mesh: TriangleMesh,
    copied: Float[np.ndarray, "N J"],
    confident: Bool[np.ndarray, " N"],
    *,
    length: float,
    laplacian: str,
    whole: Operators | None = None,
) -> Float64[np.ndarray, "N J"]:
    """Inpaint the weights of confident vertices along the surface: these keep theirs, the others follow from them.

    Args:
        mesh: every vertex referenced.
        copied: weights of the closest points; components without a confident vertex keep them.
        confident: vertices that keep their weights.
        length, laplacian, whole: see `fit_smoothly`.

    Returns:
        (N, J), none negative, rows summing to 1.
    """
    known = copied.any(axis=0)
    out = np.zeros_like(copied, dtype=np.float64)
    width = np.where(confident, 0.0, np.inf)
    fitted = fit_smoothly(mesh, copied[:, known], width, length=length, laplacian=laplacian, whole=whole)
    out[:, known] = np.clip(fitted, 0.0, 1.0)
    return out / out.sum(axis=1, keepdims=True)


def neighbouring_joints(weights: Float[np.ndarray, "V J"], *, least: float = 0.1) -> Bool[np.ndarray, "J J"]:
    """Return the pairs of joints that some vertex follows both by more than `least`, each joint with itself.

    So the weights show the skeleton's neighbourhoods, whatever its tree is.
    """
    strong = csr_matrix(weights > least, dtype=np.float64)
    return (strong.T @ strong).toarray().astype(bool) | np.eye(weights.shape[1], dtype=bool)


def joint_admissibility(
    anchors: Float[np.ndarray, "N J"], neighbours: Bool[np.ndarray, "J J"], allowed: Bool[np.ndarray, " J"] | None
) -> Float64[np.ndarray, "N J"]:
    """Return how much each joint may count for a vertex: its anchor weight, and a tenth of its neighbours' weights.

    A sleeve that hangs before the thigh has anchor weights of the arm. The thigh is no neighbour of the arm and does
    not count; neither does the hand beside a skirt. Joints that a label excludes (`allowed`) do not count either,
    unless their anchor weight is above 0.3, which says that confident cloth follows them.
    """
    from_neighbours = np.where(neighbours, 0.1, 0.0)
    np.fill_diagonal(from_neighbours, 1.0)
    admissible = np.minimum(anchors @ from_neighbours, 1.0)
    return admissible if allowed is None else np.where(allowed | (anchors > 0.3), admissible, 0.0)


def point_admissibility(
    admissible: Float[np.ndarray, "N J"], weights: Float[np.ndarray, "S J"]
) -> Float64[np.ndarray, "N S"]:
    """Return how much each point of the body, by its weights, may count for each vertex."""
    used = np.flatnonzero(admissible.any(axis=0) & weights.any(axis=0))
    out = admissible[:, used] @ weights[:, used].T
    return np.maximum(out, LEAST_ADMISSIBILITY, out=out)


def anchor_share(
    distance: Float[np.ndarray, " N"],
    angle: Float[np.ndarray, " N"],
    admissible_share: Float[np.ndarray, " N"],
    *,
    far: tuple[float, float],
) -> Float64[np.ndarray, " N"]:
    """Return the share, 0 to 1, with which anchor weights replace the weights of the body nearby.

    It rises smoothly between the two distances `far` (metres), and where less than 1 % down to 0.1 % of the body nearby
    is admissible. For a vertex that faces away from the nearest skin (`angle`, from 35 to 70 degrees on) it rises from
    50 % down to 10 % already: hair that lies against a raised arm, a sleeve that hangs beside the chest.
    """
    facing_away = smooth_step(_known_angle(angle), np.radians(35.0), np.radians(70.0))
    contradicted = facing_away * smooth_step(admissible_share, 0.5, 0.1)
    near = 1.0 - smooth_step(distance, *far)
    return 1.0 - near * (1.0 - smooth_step(admissible_share, 0.01, 0.001)) * (1.0 - contradicted)


def hung_from_top(
    vertices: Float[np.ndarray, "N 3"],
    component: Int[np.ndarray, " N"],
    distance: Float[np.ndarray, " N"],
    up: Float[np.ndarray, " 3"],
    size: float,
) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Return the top tenth of components that touch the skin nowhere, and all of their vertices.

    A beard stands off the chest by less than off the jaw from which it hangs, so that the nearest skin is not what
    carries it. `up` is from the pelvis to the head.
    """
    nearest = np.full(component.max() + 1, np.inf)
    np.minimum.at(nearest, component, distance)
    hangs = nearest[component] > _TOUCHES * size
    height = vertices @ up
    low, high = np.full((2, len(nearest)), np.inf)
    np.minimum.at(low, component, height)
    np.minimum.at(high, component, -height)
    top = 0.1  # share of a component's height from which it hangs
    return hangs & (height >= (-high - top * (-high - low))[component]), hangs


def turned_away(angle: Float[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Return how far a vertex faces away from the nearest skin: 0 up to 15 degrees, 1 from 45 on."""
    return smooth_step(_known_angle(angle), np.radians(15.0), np.radians(45.0))


def components_without(component: Int32[np.ndarray, " N"], confident: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Return the vertices of components that have no confident vertex."""
    return (np.bincount(component, confident) == 0)[component]


def smooth_step(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """Interpolate with a cubic from 0 at `start` to 1 at `end` (either order)."""
    t = np.clip((x - start) / (end - start), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _known_angle(angle: np.ndarray) -> np.ndarray:
    """Return angles in radians, with 0 for vertices without a normal."""
    return np.nan_to_num(angle, nan=0.0)
