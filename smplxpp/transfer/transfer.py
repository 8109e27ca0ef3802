"""Skin weights from a body to what it wears."""

from __future__ import annotations

import numpy as np

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.transfer.components import settle_unmatched, vertex_components
from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.correspond import closest_points
from smplxpp.transfer.inpaint import inpainting_energy, solve_quadratic
from smplxpp.transfer.repair import check_placement, check_source, consistent_winding


def transfer_weights(
    source: TriangleMesh,
    source_weights: np.ndarray,
    target: TriangleMesh,
    *,
    config: TransferConfig = TransferConfig(),  # noqa: B008 (frozen)
) -> SkinWeights:
    """Robust skin weight transfer (Abdrashitov et al., SIGGRAPH Asia 2023)."""
    weights = check_source(source, source_weights)
    source = consistent_winding(source, subject="source mesh")
    target = consistent_winding(target, subject="target mesh")
    found = closest_points(source, target)
    check_placement(source, target, found.distance)
    copied = found.interpolate(source, weights)
    matched = found.matched(
        max_distance=config.max_distance * target.bbox_diagonal, max_angle=np.radians(config.max_angle_deg)
    )
    component, _ = vertex_components(target)
    settled, copied, policies = settle_unmatched(component, matched, copied, config)
    known = matched | settled
    occurring = np.flatnonzero(copied[known].any(axis=0))
    dense = np.zeros_like(copied)
    dense[:, occurring] = _inpaint(source, target, known, copied[:, occurring], config)
    return SkinWeights.from_dense(
        dense, max_influences=config.max_influences, matched=matched, distance=found.distance, angle=found.angle,
        component=component, policies=policies,
    )  # fmt: skip


def _inpaint(
    source: TriangleMesh, target: TriangleMesh, known: np.ndarray, values: np.ndarray, config: TransferConfig
) -> np.ndarray:
    if known.all():
        return values
    mesh, used = target.submesh(slice(None))
    energy = inpainting_energy(mesh, length=config.length_scale * source.bbox_diagonal, laplacian=config.laplacian)
    out = values.copy()
    out[used] = solve_quadratic(energy, np.zeros((len(used), values.shape[1])), known[used], values[used])
    return out
