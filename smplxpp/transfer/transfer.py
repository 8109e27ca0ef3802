"""Skin weights from a body to what it wears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from smplxpp.core.mesh import MeshLike, TriangleMesh, as_mesh
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.transfer.anchors import (
    anchor_share,
    anchor_weights,
    components_without,
    joint_reach,
    neighbouring_joints,
    smooth_step,
    turned_away,
)
from smplxpp.transfer.components import settle_unmatched, vertex_components
from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.correspond import Correspondence, closest_points, face_outward, prefer_facing
from smplxpp.transfer.extend import extend_weights, sample_surface
from smplxpp.transfer.inpaint import average_neighbours, fit_smoothly
from smplxpp.transfer.regions import restrict_source
from smplxpp.transfer.repair import check_placement, check_source, check_target, consistent_winding, extent

_FACING_LENGTH = 0.02  # of the source's extent: what an opposite normal costs in distance, halved
_LEAST_KEPT = 1e-3  # of a row
_OFF_THE_SKIN = (0.01, 0.025)  # of the source's extent: between these the published method comes to have its share


def transfer_weights(
    source: MeshLike,
    source_weights: Float[np.ndarray, "V J"],
    target: MeshLike,
    *,
    config: TransferConfig | None = None,
) -> SkinWeights:
    """Skin weights for `target` from those of the body it is worn on, both in the same pose and place.

    With the default settings each vertex takes the body's weights, averaged over a neighbourhood that grows with its
    distance from the body (`extend_weights`), and the whole is smoothed along the cloth over a length that grows alike
    (`fit_smoothly`): close cloth moves with the skin under it, loose cloth between two limbs blends them instead of
    tearing. Vertices that lie on the skin and face as it does are confident: they keep its weights whatever the label
    says, and their anchor weights along the cloth decide which limbs the others may follow at all (`anchor_weights`),
    so that a skirt does not follow the hand beside it, and far from the body it takes the place of what the body says.
    `TransferConfig.paper()` is "Robust Skin Weights Transfer via Weight Inpainting" (Abdrashitov, Raichstat,
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
        >>> body = smplxpp.load_body()
        >>> shirt = body.mesh(1.02 * body.v_template).submesh(np.arange(0, 2000))[0]
        >>> config = smplxpp.TransferConfig.for_label("upper")
        >>> weights = smplxpp.transfer_weights(body.mesh(), body.weights, shirt, config=config)
        >>> bool(np.allclose(weights.dense().sum(axis=1), 1.0))
        True
    """
    source = as_mesh(source, subject="source mesh")
    target = as_mesh(target, subject="target mesh")
    config = config or TransferConfig()
    weights = check_source(source, source_weights)
    check_target(target)
    joint_count = weights.shape[1]
    source = consistent_winding(source, subject="source mesh")
    target = consistent_winding(target, subject="target mesh")
    size = extent(source)
    allowed = config.allowed_mask(joint_count)
    if allowed is not None and config.confident is None:
        source, weights = restrict_source(source, weights, allowed)
    found = closest_points(source, target)
    check_placement(source, target, found.distance)
    component = vertex_components(target)
    limit = config.max_distance * extent(target)
    found, normals = face_outward(found, target, component, max_distance=limit)
    if config.confident is not None:
        found = prefer_facing(found, source, target.vertices, normals, length=_FACING_LENGTH * size)
    angle = np.radians(config.max_angle_deg)
    matched = found.matched(max_distance=limit, max_angle=angle)
    near = min(limit, (config.confident or 0.0) * size)
    confident = found.matched(max_distance=near, max_angle=angle) & (config.confident is not None)
    values = _values(source, weights, _Matches(target, normals, found, component, confident), allowed, size, config)
    settled, values, policies = settle_unmatched(component, matched, values, config)
    # Joints that nothing uses cost nothing in the solver.
    occurring = np.flatnonzero(values.any(axis=0))
    dense = np.zeros((target.vertex_count, joint_count))
    dense[:, occurring] = _smooth(target, found, values[:, occurring], matched, settled, size, config)
    if config.published:
        answer = _published(_Matches(target, normals, found, component, matched), source, weights, size, config)
        share = config.published * smooth_step(found.distance, *(k * size for k in _OFF_THE_SKIN))
        share[settled | components_without(component, matched)] = 0.0
        if allowed is not None:
            # What the label excludes and nothing here follows stays out: a skirt does not take a third of the hand.
            answer = np.where(allowed | (dense > _LEAST_KEPT), answer, 0.0)
            total = answer.sum(axis=1)
            share[total <= _LEAST_KEPT] = 0.0
            answer /= np.maximum(total, _LEAST_KEPT)[:, None]
        dense += share[:, None] * (answer - dense)
    return SkinWeights.from_dense(
        dense,
        max_influences=config.max_influences,
        matched=matched,
        distance=found.distance,
        angle=found.angle,
        component=component,
        policies=policies,
    )


@dataclass(frozen=True, eq=False)
class _Matches:
    """The target, its outward normals, where its vertices meet the source, their component, and which are confident."""

    target: TriangleMesh
    normals: np.ndarray
    found: Correspondence
    component: np.ndarray
    confident: np.ndarray


def _values(
    source: TriangleMesh,
    weights: np.ndarray,
    at: _Matches,
    allowed: np.ndarray | None,
    size: float,
    config: TransferConfig,
) -> np.ndarray:
    """The weights (N, J) each vertex would take by itself, blended with its anchor weights."""
    joint_count, used = weights.shape[1], np.flatnonzero(weights.any(axis=0))
    weights = weights[:, used]
    copied = at.found.interpolate(source, weights)
    anchors = reach = None
    alone = components_without(at.component, at.confident)
    if at.confident.any():
        anchors = _anchor_weights(at, copied, config.anchor_length * size, config)
        reach = joint_reach(anchors, neighbouring_joints(weights), None if allowed is None else allowed[used])
        reach[alone] = 1.0 if allowed is None else allowed[used]
    elif allowed is not None and config.confident is not None:
        reach = np.repeat(allowed[None, used].astype(np.float64), len(copied), axis=0)
    values, heard = copied, np.ones(len(copied))
    if config.falloff is not None:
        samples = sample_surface(source, weights)
        values, heard = extend_weights(
            at.target.vertices, at.normals, at.found, copied, samples, falloff=config.falloff, reach=reach
        )
    if anchors is not None:
        far = (config.far[0] * size, config.far[1] * size)
        lean = anchor_share(at.found.distance, at.found.angle, heard, far=far)
        lean[at.confident | alone] = 0.0
        values = values + lean[:, None] * (anchors - values)
    if reach is not None and alone.any():
        # A little of what may not speak comes along with what may; where nothing else is near it stays.
        kept = np.where(reach > 0, values, 0.0)
        total = kept.sum(axis=1, keepdims=True)
        values = np.where(alone[:, None] & (total > _LEAST_KEPT), kept / np.maximum(total, _LEAST_KEPT), values)
    out = np.zeros((len(values), joint_count))
    out[:, used] = values
    return out


def _published(
    at: _Matches, source: TriangleMesh, weights: np.ndarray, size: float, config: TransferConfig
) -> np.ndarray:
    """The published method's answer (N, J), with `at.confident` all that is matched."""
    used = np.flatnonzero(weights.any(axis=0))
    out = np.zeros((at.target.vertex_count, weights.shape[1]))
    out[:, used] = _anchor_weights(
        at, at.found.interpolate(source, weights[:, used]), config.length_scale * size, config
    )
    return out


def _anchor_weights(at: _Matches, copied: np.ndarray, length: float, config: TransferConfig) -> np.ndarray:
    """Return the anchor weights (N, J); vertices without a face and components without one keep `copied`."""
    kept = at.confident | components_without(at.component, at.confident)
    mesh, used = at.target.submesh(np.ones(at.target.face_count, dtype=bool))
    out = copied.copy()
    out[used] = anchor_weights(mesh, copied[used], kept[used], length=length, laplacian=config.laplacian)
    return out


def _smooth(
    target: TriangleMesh,
    found: Correspondence,
    values: np.ndarray,
    matched: np.ndarray,
    settled: np.ndarray,
    size: float,
    config: TransferConfig,
) -> np.ndarray:
    """The values (N, J) fitted smoothly over the surface; vertices without a face keep theirs."""
    if config.smoothing is None:
        width = np.where(matched | settled, 0.0, np.inf)
    else:
        doubt = 1.0 + config.normal_widening * (1.0 - np.cos(np.nan_to_num(found.angle)))
        doubted = np.hypot(found.distance, config.turned * size * turned_away(found.angle))
        width = np.where(settled, 0.0, config.smoothing * doubt * doubted)
    mesh, used = target.submesh(np.ones(target.face_count, dtype=bool))
    length = config.length_scale * size
    fitted = fit_smoothly(mesh, values[used], width[used], length=length, laplacian=config.laplacian)
    out = values.copy()
    out[used] = np.clip(fitted, 0.0, 1.0)
    out /= out.sum(axis=1, keepdims=True)
    if config.averaging_steps:
        out = average_neighbours(target, out, ~matched & ~settled, steps=config.averaging_steps)
    return out
