"""Transfer skin weights from a body to the parts that it wears."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core import MeshLike, SkinWeights, TriangleMesh, WeightsLike, as_mesh, dense_weights
from smplxpp.core.labels import PartRule
from smplxpp.transfer.anchors import (
    anchor_share,
    anchor_weights,
    components_without,
    hung_from_top,
    joint_admissibility,
    neighbouring_joints,
    smooth_step,
    turned_away,
)
from smplxpp.transfer.checks import (
    check_placement,
    check_source,
    check_target,
    consistent_winding,
    extent,
    restrict_source,
    welded,
)
from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.correspond import (
    Correspondence,
    closest_points,
    face_outward,
    prefer_facing,
    settle_unmatched,
    vertex_components,
)
from smplxpp.transfer.enclosed import Enclosure, enclosed_by_one, limb_axes
from smplxpp.transfer.extend import extend_weights, sample_weights, with_linings
from smplxpp.transfer.hanging import (
    beside_trunk,
    bounded_legs,
    cloth_before_legs,
    lifted_by_thighs,
    with_own_legs,
)
from smplxpp.transfer.inpaint import Operators, average_neighbours, fit_smoothly, shared_operators
from smplxpp.transfer.rigid import rigid_weights
from smplxpp.transfer.rings import behind_legs, depth_below_hips
from smplxpp.transfer.unfollowed import PassedHand, passed_hands, unfollowed_arms

_PUBLISHED_FAR = 0.4
"""By how much of itself the published method's share grows where anchor weights replace those of the body nearby: the
free end of a sari has the shoulder alone as an anchor (worst ratio of `benchmarks transfer_garments` and the embedded
person's skirt)."""
_CLOSED = 0.45
"""Share of a component that faces away from the skin from which on it is a closed tube; of an open scarf it is 0.38."""
_LEAST_SUM = 1e-3
"""Least sum of a row's weights that is worth normalising; also the least weight that counts as following a joint."""


def transfer_weights(
    source: MeshLike,
    source_weights: WeightsLike,
    target: MeshLike,
    *,
    config: TransferConfig | None = None,
    enclosure: Enclosure | None = None,
) -> SkinWeights:
    """Transfer skin weights to `target` from the body that it is worn on, both in the same pose and place.

    With the default settings each vertex takes the body's weights, averaged over a neighbourhood that grows with its
    distance from the body (`extend_weights`). These values are smoothed along the cloth over a length that grows in the
    same proportion (`fit_smoothly`). So close cloth moves with the skin under it, and loose cloth between two limbs
    blends them instead of tearing. Vertices that lie on the skin and face as it does are confident: they keep its
    weights whatever the label says. Inpainting from them gives all others anchor weights (`anchor_weights`), which
    decide the limbs that a vertex may follow, so that a skirt does not follow the hand beside it. Far from the body
    anchor weights replace the body's values.

    `TransferConfig.paper()` is "Robust Skin Weights Transfer via Weight Inpainting" (Abdrashitov, Raichstat,
    Monsen, Hill; SIGGRAPH Asia 2023 Technical Communications): weights of closest points are kept where these are near
    and face the same direction, the rest is inpainted.

    Args:
        source: the body. Inconsistent winding is repaired with a warning.
        source_weights: (V, J), rows sum to 1; read where a face uses the vertex.
        target: what it wears; open, with several components, bad faces or unreferenced vertices.
        config: settings; `TransferConfig.for_label("lower")` and the like know which joints a part can follow, `rule`
            and `component_rules` make plates and bags rigid.

    Returns:
        Weights of the target's vertices; rows sum to 1, none negative. `matched`, `distance` and `angle` are those
        of the closest points, `policies` has "matched" or the policy of the settings for each connected component.

    Raises:
        InputError: meshes without faces, weights that are none, another unit or other axes than the source's, a
            component without a match under the policy "raise", a rule of a joint or component that there is not.

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
    # Check the inputs, and repair their winding.
    source = as_mesh(source, subject="source mesh")
    target = as_mesh(target, subject="target mesh")
    config = config or TransferConfig()
    weights = check_source(source, dense_weights(source_weights))
    check_target(target)
    joint_count = weights.shape[1]
    source = consistent_winding(source, subject="source mesh")
    # Copies of a vertex, as along texture seams, get one row of weights, which is handed back to all of them.
    target, copies = welded(target)
    if enclosure is not None:
        enclosure = enclosure.of(np.unique(copies, return_index=True)[1])
    target = consistent_winding(target, subject="target mesh")
    size = extent(source)
    # Weights by each rule that a component has; most targets have "auto" alone.
    component = vertex_components(target)
    rules = config.rules_of(int(component.max(initial=-1)) + 1, joint_count)
    worn = _Worn(target, component, enclosure)
    answers = {rule: _by_rule(rule, source, weights, worn, size, config) for rule in dict.fromkeys(rules)}
    found = _chosen(tuple(answers[rule] for rule in rules), component)
    return SkinWeights.from_dense(
        found.dense[copies],
        max_influences=config.max_influences,
        matched=found.matched[copies],
        distance=found.distance[copies],
        angle=found.angle[copies],
        component=component[copies],
        policies=found.policies,
    )


@dataclass(frozen=True, eq=False)
class _Weighted:
    """Weights (N, J) of a target by one rule, their provenance by vertex, and the policy of each component."""

    dense: np.ndarray
    matched: np.ndarray
    distance: np.ndarray
    angle: np.ndarray
    policies: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Worn:
    """What weights are transferred to: a mesh of N vertices, the component of each, and the limbs they go around."""

    mesh: TriangleMesh
    component: np.ndarray
    enclosure: Enclosure | None


def _chosen(of_component: tuple[_Weighted, ...], component: np.ndarray) -> _Weighted:
    """Return for every component the rows of its own answer."""
    first = of_component[0]
    if all(one is first for one in of_component):
        return first
    rows = {name: getattr(first, name).copy() for name in ("dense", "matched", "distance", "angle")}
    for number, answer in enumerate(of_component):
        own = component == number
        for name, values in rows.items():
            values[own] = getattr(answer, name)[own]
    return _Weighted(**rows, policies=tuple(answer.policies[k] for k, answer in enumerate(of_component)))


def _by_rule(
    rule: PartRule,
    source: TriangleMesh,
    weights: np.ndarray,
    worn: _Worn,
    size: float,
    config: TransferConfig,
) -> _Weighted:
    """Return the weights that a rule gives all components of the target."""
    if rule.kind == "auto":
        return _transferred(source, weights, worn, size, config, whole=True)
    joint_count = weights.shape[1]
    chosen = [config.joint_index(joint, joint_count) for joint in rule.joints]
    if rule.kind == "chain":
        # Skin of other joints is out of reach; what lies over it is far from the chain, and inpainted from what is not.
        mask = np.zeros(joint_count, dtype=bool)
        mask[chosen] = True
        near, own = restrict_source(source, weights, mask)
        out = _transferred(near, own, worn, size, replace(config, allowed_joints=None), whole=False)
        return replace(out, policies=tuple(f"chain:{','.join(rule.joints)}" for _ in out.policies))
    names = config.joint_names or JOINT_NAMES.get(joint_count) or tuple(map(str, range(joint_count)))
    rigid = rigid_weights(source, weights, worn.mesh, joint_names=names, joint=names[chosen[0]] if chosen else None)
    return _Weighted(rigid.dense(), rigid.matched, rigid.distance, rigid.angle, rigid.policies)


def _transferred(
    source: TriangleMesh,
    weights: np.ndarray,
    worn: _Worn,
    size: float,
    config: TransferConfig,
    *,
    whole: bool,
) -> _Weighted:
    """Return the weights that the surface of the source gives the target, see `transfer_weights`.

    Args:
        source: the body, or a part of it.
        weights: of its vertices.
        worn: what it wears.
        size: the body's extent.
        config: settings.
        whole: whether the source is the whole body, which tells where the target lies and which arms are in sleeves.
    """
    joint_count = weights.shape[1]
    target, component = worn.mesh, worn.component
    allowed = config.allowed_mask(joint_count)
    if allowed is not None and config.confident is None:
        source, weights = restrict_source(source, weights, allowed)
    # Match vertices to the source.
    found = closest_points(source, target)
    if whole:
        check_placement(source, target, found.distance)
    # Find the rings that go around one limb, and leave out arms that are not in the sleeves.
    axes, limbs, unfollowed = [], None, None
    if config.confident is not None and found.distance.max() > config.around[0] * size:
        axes = limb_axes(source, weights, size, config)
        if axes:
            limbs = worn.enclosure or enclosed_by_one(target, axes, joint_count)
            unfollowed = unfollowed_arms(target, axes, limbs, size, config, joint_count)
            if whole and unfollowed.joints.any():
                source, weights = restrict_source(source, weights, ~unfollowed.joints)
                found = closest_points(source, target)
    # Cloth of the trunk that passes a hand, as the corner of a jacket does over one in a pocket, is none of that arm's.
    passing: list[PassedHand] = []
    if whole and limbs is not None:
        passing = passed_hands(target, found.interpolate(source, weights), limbs, config)
    if passing:
        hands = np.any([passed.hand for passed in passing], axis=0)
        source, weights = restrict_source(source, weights, ~hands)
        found = closest_points(source, target)
    # Find the confident vertices among the matched ones.
    limit = config.max_distance * extent(target)
    found, normals = face_outward(found, target, component, max_distance=limit)
    if config.confident is not None:
        # An opposite normal costs 4 % of the source's extent in distance.
        found = prefer_facing(found, source, target.vertices, normals, length=0.02 * size)
    for passed in passing:
        off = weights[:, ~passed.arm].sum(axis=1) > 0.5
        found = found.instead(passed.vertices, closest_points(source, target, among=off))
    angle = np.radians(config.max_angle_deg)
    matched = found.matched(max_distance=limit, max_angle=angle)
    near = min(limit, (config.confident or 0.0) * size)
    confident = found.matched(max_distance=near, max_angle=angle) & (config.confident is not None)
    hangs = np.zeros(target.vertex_count, dtype=bool)
    if axes:
        # What touches the skin nowhere hangs from its top.
        up = axes[-1].points[-1] - axes[-1].points[0]
        tops, hangs = hung_from_top(target.vertices, component, found.distance, up, size)
        confident |= tops
    # Compute each vertex's own value, then smooth the values over the surface.
    surface, used = target.submesh(np.ones(target.face_count, dtype=bool))
    shared = shared_operators(surface, config.laplacian) if config.published else None
    at = _Matches(_Surface(surface, used, shared), target, normals, found, component, confident, hangs)
    copied = found.interpolate(source, weights)
    values = _values(source, weights, at, copied, allowed, size, config)
    for passed in passing:
        values = passed.without_arm(values)
    far_off = np.zeros(len(values))
    if limbs is not None:
        far_off = limbs.share * smooth_step(found.distance, *(k * size for k in config.around))
        values = values + far_off[:, None] * (limbs.weights - values)
    settled, values, policies = settle_unmatched(component, matched, values, config)
    # Joints without weight are left out of the linear systems.
    occurring = np.flatnonzero(values.any(axis=0))
    dense = np.zeros((target.vertex_count, joint_count))
    # The angle says nothing on closed tubes, half of which faces away from the skin that they lie on: a braid, beads.
    away = np.bincount(component, np.nan_to_num(found.angle) > 0.5 * np.pi) / np.bincount(component)
    closed = (away > _CLOSED)[component] & ~hangs & (config.confident is not None)
    angles = np.where(closed, 0.0, found.angle)
    closer = replace(found, distance=found.distance * (1.0 - 0.7 * far_off), angle=angles)
    dense[:, occurring] = _smooth(at, closer, values[:, occurring], matched, settled, size, config)
    # Find what hangs free before both legs, and how wide it is.
    hanging = None
    if whole and limbs is not None and config.hanging is not None:
        arms = [joint for axis in axes[2:4] for joint in axis.joints]
        off = np.where(copied[:, arms].sum(axis=1) > 0.5, np.inf, found.distance)
        depth, behind = depth_below_hips(target.vertices, axes[:2]), behind_legs(target.vertices, axes)
        hanging = cloth_before_legs(depth, component, off, limbs, behind, size=size, cone=config.hanging)
    if config.published:
        # Mix in the published method's weights. Their share rises from 1 % to 2.5 % of the source's extent off the
        # skin.
        answer = np.zeros_like(dense)
        followed = np.flatnonzero(copied.any(axis=0))
        length = config.published_length * size
        answer[:, followed] = _anchor_weights(replace(at, confident=matched), copied[:, followed], length, config)
        off = smooth_step(found.distance, *(k * size for k in (0.01, 0.025)))
        share = config.published * off
        share *= 1.0 + _PUBLISHED_FAR * smooth_step(found.distance, *(k * size for k in config.far))
        # On the skin what faces away from it, as the folds of a hijab beside the neck, has no other place to follow;
        # hair has, whose strands face all ways.
        if not (allowed is not None and axes and allowed[axes[-1].joints[-1]]):
            share = np.clip(share, (1.0 - off) * turned_away(found.angle) * ~matched * whole, 1.0)
        share = np.minimum(share, 1.0)
        share *= 1.0 - far_off
        for passed in passing:
            answer = passed.without_arm(answer)
        share[settled | hangs | components_without(component, confident)] = 0.0
        if allowed is not None:
            # Leave out joints that the label excludes and nothing here follows, such as the hand beside a skirt.
            answer = np.where(allowed | (dense > _LEAST_SUM), answer, 0.0)
            total = answer.sum(axis=1)
            share[total <= _LEAST_SUM] = 0.0
            answer /= np.maximum(total, _LEAST_SUM)[:, None]
        mixed = dense + share[:, None] * (answer - dense)
        dense = mixed if hanging is None else with_own_legs(mixed, dense, hanging, axes)
    if whole and unfollowed is not None and config.hanging is not None:
        # Divide what follows the trunk by height. Empty sleeves hang from their armholes.
        off = smooth_step(found.distance, *(k * size for k in (0.01, 0.025))) * (1.0 - far_off)
        off[hangs | unfollowed.tubes] = 0.0
        # Between these distances off the skin, shares of the body's extent, height along the trunk replaces the nearest
        # skin: beads lie on it, a cape stands off it (worst ratio of loose garments on three persons).
        by_height = (0.025, 0.06)
        beside = 1.0 - smooth_step(found.distance, *(k * size for k in by_height))
        collars = tuple(config.joint_index(f"{side}_collar", joint_count) for side in ("left", "right"))
        lower = beside_trunk(target.vertices, dense, copied, beside, axes[-1], collars + unfollowed.shoulders)
        dense += off[:, None] * (lower - dense)
    if hanging is not None:
        # Leave the pelvis its share of cloth that hangs free before both legs.
        bound = lifted_by_thighs(target, dense, hanging.bound, depth, component, source, weights, axes)
        dense = bounded_legs(dense, bound, axes, config.joint_index("pelvis", joint_count))
    if whole and config.confident is not None:
        # Where a lining hangs free, the sides of one cloth are up to 2.5 cm apart; from 5 cm on they are of two things.
        thickness = (0.014 * size, 0.03 * size)
        dense = with_linings(dense, target, normals, found.angle, thickness=thickness)
    return _Weighted(dense, matched, found.distance, found.angle, policies)


@dataclass(frozen=True, eq=False)
class _Surface:
    """The mesh of the target's vertices that have a face, which these are, and the operators on it that fits share."""

    mesh: TriangleMesh
    used: np.ndarray
    whole: Operators | None


@dataclass(frozen=True, eq=False)
class _Matches:
    """Hold the target and its matches to the source.

    Attributes:
        surface: of the target.
        target: N vertices.
        normals: outward.
        found: closest points of the source.
        component: of each vertex.
        confident: vertices that keep the weights of their closest points.
        hangs: vertices that touch nothing and follow the confident ones alone.
    """

    surface: _Surface
    target: TriangleMesh
    normals: np.ndarray
    found: Correspondence
    component: np.ndarray
    confident: np.ndarray
    hangs: np.ndarray


def _values(
    source: TriangleMesh,
    weights: np.ndarray,
    at: _Matches,
    copied: np.ndarray,
    allowed: np.ndarray | None,
    size: float,
    config: TransferConfig,
) -> np.ndarray:
    """Return the weights (N, J) that each vertex takes from the body nearby, blended with its anchor weights."""
    joint_count, used = weights.shape[1], np.flatnonzero(weights.any(axis=0))
    weights, copied = weights[:, used], copied[:, used]
    anchors = admissible = None
    # Compute anchor weights and the admissible joints; components without a confident vertex have the label's alone.
    alone = components_without(at.component, at.confident)
    if at.confident.any():
        anchors = _anchor_weights(at, copied, config.anchor_length * size, config)
        possible = None if allowed is None else allowed[used]
        admissible = joint_admissibility(anchors, neighbouring_joints(weights), possible)
        admissible[alone] = 1.0 if possible is None else possible
    elif allowed is not None and config.confident is not None:
        admissible = np.repeat(allowed[None, used].astype(np.float64), len(copied), axis=0)
    # Extend the body's weights into space.
    values, admissible_share = copied, np.ones(len(copied))
    if config.falloff is not None:
        samples = sample_weights(source, weights)
        values, admissible_share = extend_weights(
            at.target.vertices, at.normals, at.found, copied, samples, falloff=config.falloff, admissible=admissible
        )
    # Replace them by anchor weights far from the body, and where hardly any of it is admissible.
    if anchors is not None:
        far = (config.far[0] * size, config.far[1] * size)
        share = anchor_share(at.found.distance, at.found.angle, admissible_share, far=far)
        share = np.where(at.hangs, 1.0, share)
        share[at.confident | alone] = 0.0
        values = values + share[:, None] * (anchors - values)
    if admissible is not None and alone.any():
        # Remove what is left of inadmissible joints, unless nothing else is near.
        kept = np.where(admissible > 0, values, 0.0)
        total = kept.sum(axis=1, keepdims=True)
        values = np.where(alone[:, None] & (total > _LEAST_SUM), kept / np.maximum(total, _LEAST_SUM), values)
    out = np.zeros((len(values), joint_count))
    out[:, used] = values
    return out


def _anchor_weights(at: _Matches, copied: np.ndarray, length: float, config: TransferConfig) -> np.ndarray:
    """Return the anchor weights (N, J); vertices without a face and components without one keep `copied`."""
    kept = at.confident | components_without(at.component, at.confident)
    on = at.surface
    out = copied.copy()
    out[on.used] = anchor_weights(
        on.mesh, copied[on.used], kept[on.used], length=length, laplacian=config.laplacian, whole=on.whole
    )
    return out


def _smooth(
    at: _Matches,
    found: Correspondence,
    values: np.ndarray,
    matched: np.ndarray,
    settled: np.ndarray,
    size: float,
    config: TransferConfig,
) -> np.ndarray:
    """Fit the values (N, J) smoothly over the surface; vertices without a face keep theirs."""
    # The width of smoothing: smoothing (1 + widening (1 - cos a)) sqrt(d^2 + (turned E s)^2), see docs/template.md.
    if config.smoothing is None:
        width = np.where(matched | settled, 0.0, np.inf)
    else:
        widening = 1.0 + config.normal_widening * (1.0 - np.cos(np.nan_to_num(found.angle)))
        distance = np.hypot(found.distance, config.turned * size * turned_away(found.angle))
        width = np.where(settled, 0.0, config.smoothing * widening * distance)
    # Fit, clip what the biharmonic energy overshoots, and normalise.
    on, used = at.surface, at.surface.used
    length = config.length_scale * size
    fitted = fit_smoothly(on.mesh, values[used], width[used], length=length, laplacian=config.laplacian, whole=on.whole)
    out = values.copy()
    out[used] = np.clip(fitted, 0.0, 1.0)
    out /= out.sum(axis=1, keepdims=True)
    if config.averaging_steps:
        out = average_neighbours(at.target, out, ~matched & ~settled, steps=config.averaging_steps)
    return out
