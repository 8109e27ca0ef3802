"""Connected components, and what happens to one that nothing matched."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32

from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import component_labels
from smplxpp.transfer.config import TransferConfig


def vertex_components(mesh: TriangleMesh) -> Int32[np.ndarray, " N"]:
    """The component of every vertex, numbered from 0."""
    return component_labels(mesh.edges, mesh.vertex_count).astype(np.int32)


def settle_unmatched(
    component: Int32[np.ndarray, " N"],
    matched: Bool[np.ndarray, " N"],
    weights: Float[np.ndarray, "N J"],
    config: TransferConfig,
) -> tuple[Bool[np.ndarray, " N"], Float64[np.ndarray, "N J"], tuple[str, ...]]:
    """Give every component without a match its stated policy.

    Args:
        component: (N,) ids 0..P-1.
        matched: (N,) bool.
        weights: (N, J) what each vertex would take by itself.

    Returns:
        (N,) bool rows settled here, (N, J) weights with those rows set, (P,) the policy of each component.

    Raises:
        InputError: a component without a match under the policy "raise".
    """
    count = int(component.max(initial=-1)) + 1
    lost = np.bincount(component, matched, minlength=count) == 0
    policies = tuple(np.where(lost, config.unmatched, "matched").tolist())
    rows = lost[component]
    if not rows.any() or config.unmatched == "extend":
        return np.zeros_like(rows), weights, policies
    message = f"{int(lost.sum())} of {count} components ({int(rows.sum())} of {len(rows)} vertices) have no match"
    if config.unmatched == "raise":
        raise InputError(
            "target mesh",
            expected="a matched vertex in every component",
            received=f"{message}, first at vertex {int(np.argmax(rows))}",
            remedy="choose the policy TransferConfig(unmatched='nearest') or 'rigid:JOINT', or remove those pieces",
        )
    if config.unmatched == "nearest":
        warnings.warn(f"skin weights: {message}; they take the nearest weights", GeometryWarning, stacklevel=3)
        return rows, weights, policies
    out = weights.copy()
    out[rows] = 0.0
    out[rows, config.joint_index(config.unmatched.removeprefix("rigid:"), weights.shape[1])] = 1.0
    return rows, out, policies
