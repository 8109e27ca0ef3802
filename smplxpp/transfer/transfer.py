"""Skin weights from a body to what it wears."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.transfer.components import settle_unmatched, vertex_components
from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.correspond import Correspondence, closest_points, face_outward
from smplxpp.transfer.extend import extend_weights, sample_surface
from smplxpp.transfer.inpaint import average_neighbours, fit_smoothly
from smplxpp.transfer.regions import restrict_source
from smplxpp.transfer.repair import check_placement, check_source, check_target, consistent_winding, extent


def transfer_weights(
    source: TriangleMesh,
    source_weights: Float[np.ndarray, "V J"],
    target: TriangleMesh,
    *,
    config: TransferConfig | None = None,
) -> SkinWeights:
    """Skin weights for `target` from those of the body it is worn on, both in the same pose and place.

    With the default settings each vertex takes the body's weights, averaged over a neighbourhood that grows with its
    distance from the body (`extend_weights`), and the whole is smoothed along the cloth over a length that grows alike
    (`fit_smoothly`): close cloth moves with the skin under it, loose cloth between two limbs blends them instead of
    tearing. `TransferConfig.paper()` is "Robust Skin Weights Transfer via Weight Inpainting" (Abdrashitov, Raichstat,
    Monsen, Hill; SIGGRAPH Asia 2023 Technical Communications): closest points are believed where near and facing the
    same way, the rest is inpainted.

    Args:
        source: the body. Inconsistent winding is mended with a warning.
        source_weights: (V, J), rows sum to 1; read where a face uses the vertex.
        target: what it wears; open, with several components, bad faces or unreferenced vertices.
        config: settings; `TransferConfig.for_label("lower")` and the like know which joints a part can follow.

    Returns:
        Weights of the target's vertices; rows sum to 1, none negative. `matched`, `distance` and `angle` tell how each
        was found and `policies` what happened to each connected component: "matched", or the policy of the settings.

    Raises:
        InputError: meshes without faces, weights that are none, another unit or other axes than the source's, a
            component without a match under the policy "raise".

    Warns:
        GeometryWarning: repaired winding, a part inside out, components without a match that took the nearest weights.

    Example:
        >>> weights = transfer_weights(body_mesh, body.weights, skirt, config=TransferConfig.for_label("lower"))
        >>> weights.dense().sum(axis=1)  # all 1
    """
    config = config or TransferConfig()
    weights = check_source(source, source_weights)
    check_target(target)
    joint_count = weights.shape[1]
    source = consistent_winding(source, subject="source mesh")
    target = consistent_winding(target, subject="target mesh")
    length = config.length_scale * extent(source)
    allowed = config.allowed_mask(joint_count)
    if allowed is not None:
        source, weights = restrict_source(source, weights, allowed)
    found = closest_points(source, target)
    check_placement(source, target, found.distance)
    component = vertex_components(target)
    limit = config.max_distance * extent(target)
    found, normals = face_outward(found, target, component, max_distance=limit)
    matched = found.matched(max_distance=limit, max_angle=np.radians(config.max_angle_deg))
    values = _values(source, weights, target, found, normals, config)
    settled, values, policies = settle_unmatched(component, matched, values, config)
    # Joints that nothing uses cost nothing in the solver.
    occurring = np.flatnonzero(values.any(axis=0))
    dense = np.zeros((target.vertex_count, joint_count))
    dense[:, occurring] = _smooth(target, found, values[:, occurring], matched, settled, length, config)
    return SkinWeights.from_dense(
        dense,
        max_influences=config.max_influences,
        matched=matched,
        distance=found.distance,
        angle=found.angle,
        component=component,
        policies=policies,
    )


def _values(
    source: TriangleMesh,
    weights: np.ndarray,
    target: TriangleMesh,
    found: Correspondence,
    normals: np.ndarray,
    config: TransferConfig,
) -> np.ndarray:
    """The weights (N, J) each vertex would take by itself: the closest point's, or their extension."""
    used = np.flatnonzero(weights.any(axis=0))
    values = found.interpolate(source, weights[:, used])
    if config.falloff is not None:
        samples = sample_surface(source, weights[:, used])
        values = extend_weights(target.vertices, normals, found, values, samples, falloff=config.falloff)
    out = np.zeros((target.vertex_count, weights.shape[1]))
    out[:, used] = values
    return out


def _smooth(
    target: TriangleMesh,
    found: Correspondence,
    values: np.ndarray,
    matched: np.ndarray,
    settled: np.ndarray,
    length: float,
    config: TransferConfig,
) -> np.ndarray:
    """The values (N, J) fitted smoothly over the surface; vertices without a face keep theirs."""
    if config.smoothing is None:
        width = np.where(matched | settled, 0.0, np.inf)
    else:
        doubt = 1.0 + config.normal_doubt * (1.0 - np.cos(np.nan_to_num(found.angle)))
        width = np.where(settled, 0.0, config.smoothing * doubt * found.distance)
    mesh, used = target.submesh(np.ones(target.face_count, dtype=bool))
    fitted = fit_smoothly(mesh, values[used], width[used], length=length, laplacian=config.laplacian)
    out = values.copy()
    out[used] = np.clip(fitted, 0.0, 1.0)
    out /= out.sum(axis=1, keepdims=True)
    if config.averaging_steps:
        out = average_neighbours(target, out, ~matched & ~settled, steps=config.averaging_steps)
    return out
