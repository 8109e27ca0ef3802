"""Make the loose parts of a template: cleaned, with skin weights, in the T-pose."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Integer

from smplxpp.assemble.build import is_shoe
from smplxpp.assemble.fill_holes import LEG_CUT
from smplxpp.body import BodyModel
from smplxpp.build.config import BuildConfig
from smplxpp.build.data import Part, PosedFit, PreparedScan
from smplxpp.clean import BridgeConfig, PartsConfig, clean_parts, cut_bridges, find_bridges, find_tears
from smplxpp.clean.shreds import cut_borders, drawn_out, find_shreds
from smplxpp.cloth.cloth_mesh import find_opening_lids
from smplxpp.core import (
    LABELS,
    SKIN,
    Check,
    GeometryWarning,
    InputError,
    Labels,
    SkinWeights,
    StageOutput,
    TriangleMesh,
    row_lengths,
)
from smplxpp.core.labels import PartRule
from smplxpp.core.topology import face_components
from smplxpp.metrics import mesh_quality, point_to_surface, stretch_report, weight_report
from smplxpp.metrics.comparison import MM
from smplxpp.skinning import UnposeConfig, Unposed, invertible_weights, unpose
from smplxpp.transfer import TransferConfig, rigid_weights, shoe_weights, transfer_weights
from smplxpp.transfer.checks import extent, surface_components
from smplxpp.transfer.enclosed import Enclosure, LimbAxis, enclosed_by_one, limb_axes
from smplxpp.transfer.unfollowed import webs_to_hands

_FOLDED = 1e-6
"""Least determinant of a blended transform in trials of the T-pose: what is smaller has no inverse in float64."""


def clean_scan(
    scan: PreparedScan,
    face_labels: Integer[np.ndarray, " M"],
    config: BuildConfig,
    labels: Labels = LABELS,
    *,
    found: bool = False,
) -> tuple[dict[str, Part], StageOutput]:
    """Make one clean mesh within its face budget for every part that is not skin.

    Args:
        scan: prepared.
        face_labels: (M,) label ids.
        config: budgets and method.
        labels: whose ids they are.
        found: the body told the labels, so that skin alone is a bare and bald person, and no mistaken label set.
    """
    settings = PartsConfig(face_budgets=config.budgets, method=config.remesh, labels=labels)
    skin = [-1] + [label.id for label in labels if label.kind == SKIN.name]
    if found and np.isin(face_labels, skin).all():
        warnings.warn("no clothes, hair or shoes were found: the template is the body alone", GeometryWarning, 2)
        return {}, StageOutput([], {})
    cleaned = clean_parts(scan.mesh, face_labels, config=settings, vertex_colors=scan.colors)
    parts, checks, numbers = {}, [], {}
    for name, part in cleaned.items():
        parts[name] = Part(part.mesh, part.label, part.source_vertex, np.asarray(part.vertex_colors))
        # One-sided distance, from the part to the scan: simplification may cut corners, but must not invent surface.
        distance = point_to_surface(part.mesh.vertices, scan.mesh)[0] * MM
        quality = mesh_quality(part.mesh)
        numbers[name] = {"faces": part.mesh.face_count, "quality": quality, "report": part.report}
        checks += [
            # No edge may have three faces or more: the Laplacian that spreads skin weights over the part is that of a
            # 2-manifold.
            Check(f"{name}: non-manifold edges", quality.nonmanifold_edges, "", 0, 0),
            Check(f"{name}: vertices to scan, p95", float(np.percentile(distance, 95)), "mm", 2.0, 5.0),
        ]
    return parts, StageOutput(checks, numbers)


def transfer_to_parts(
    cleaned: Mapping[str, Part], fit: PosedFit, body: BodyModel, config: BuildConfig, labels: Labels = LABELS
) -> tuple[dict[str, Part], dict[str, SkinWeights], StageOutput]:
    """Transfer skin weights from the posed body to every part, and cut the bridges that the weights show.

    Rules of parts and of their pieces come first (`BuildConfig.rules`, then those of the labels): things get no weights
    of the body's surface, each is rigid (`rigid_weights`). Shoes are stiff (`shoe_weights`).

    Returns:
        The parts without bridges, their weights, checks and numbers.
    """
    parts: dict[str, Part] = {}
    weights: dict[str, SkinWeights] = {}
    checks: list[Check] = []
    numbers: dict[str, Any] = {}
    axes = limb_axes(fit.mesh, body.weights, extent(fit.mesh), TransferConfig(joint_names=body.joint_names))
    for name, scanned in cleaned.items():
        label, part = labels[scanned.label], without_lids(scanned, fit, labels)
        rule = PartRule.parse(config.rules.get(name, label.rule))
        pieces = rules_of_pieces(name, part.mesh, config.rules)
        if rule.kind in ("rigid", "isolate") and not pieces:
            # A thing is rigid: it has no bridges, and follows one joint.
            mesh, source = part.mesh, np.arange(part.mesh.vertex_count)
            joint = next(iter(rule.joints), None)
            found = rigid_weights(fit.mesh, body.weights, mesh, joint_names=body.joint_names, joint=joint)
        else:
            settings = replace(transfer_config(label.kind, body, config), rule=config.rules.get(name, label.rule))
            mesh, source, found = _without_bridges(part.mesh, fit, body, _Ruled(settings, pieces, axes), config.bridges)
            if is_shoe(replace(label, rule=settings.rule)) and not pieces and config.method != "paper":
                found = shoe_weights(found, mesh, fit.joints, joint_names=body.joint_names)
        parts[name] = Part(mesh, part.label, part.source_vertex[source], part.colors[source])
        # A few vertices whose blend folds flat in the scan's pose, as between thighs that touch, stop no build.
        found, folded = invertible_weights(found, fit.posed_from_rest)
        if folded.any():
            message = "vertices blend limbs that are turned against each other; they follow the stronger one"
            warnings.warn(f"{name}: {int(folded.sum())} of {len(folded)} {message}", GeometryWarning, stacklevel=2)
        weights[name] = found
        # Rows must sum to one, or blended transforms scale the part: T = sum_j w_j T_j is affine only then.
        report = weight_report(found)
        numbers[name] = {
            "matched_share": float(found.matched.mean()),
            "components": len(found.policies),
            "policies": sorted(set(found.policies)),
            "rule": config.rules.get(name, label.rule),
            "report": report.as_dict(),
            "folded_vertices": int(folded.sum()),
            "lid_faces": scanned.mesh.face_count - part.mesh.face_count,
            "web_faces": part.mesh.face_count - mesh.face_count,
            "web_area_share": 1.0 - float(mesh.face_areas.sum() / part.mesh.face_areas.sum()),
        }
        checks.append(cut_check(name, numbers[name]["web_area_share"]))
        # 1e-12 is the round-off of a sum of a few weights in double precision.
        checks += [
            Check(f"{name}: rows off partition of unity", report.row_sum_error, "", 1e-12, 1e-9),
            Check(f"{name}: negative weights and silent zero rows", report.negative + report.zero_rows, "", 0, 0),
            Check(
                f"{name}: share of folded vertices",
                float(folded.mean()),
                "",
                0.0,
                0.01,
                explanation="whose blended transform had no inverse in the scan's pose; they follow one joint more",
            ),
        ]
    return parts, weights, StageOutput(checks, numbers)


def without_lids(part: Part, fit: PosedFit, labels: Labels) -> Part:
    """Return clothing without the lids that a scan closes wide openings with (`find_opening_lids`); others as they are.

    They are looked for where the pelvis is upright, as in the T-pose.
    """
    if labels[part.label] not in labels.cloth or labels[part.label].stiff:
        return part
    turn = fit.posed_from_rest[0, :3, :3]
    own, body = (mesh.with_vertices(mesh.vertices @ turn) for mesh in (part.mesh, fit.mesh))
    lids = find_opening_lids(own, body)
    if not lids.any():
        return part
    mesh, kept = cut_bridges(part.mesh, lids)
    return Part(mesh, part.label, part.source_vertex[kept], part.colors[kept])


def cut_check(name: str, share: float) -> Check:
    """Return the check of a part's share of surface that was cut between limbs, which warns and never fails.

    Of eight real people at most 0.10 of a part was cut; of a man whose sleeves hung against his trunk 0.30, and his
    shirt is torn in other poses.
    """
    advice = "limbs touch there: take a frame (--frame) or a scan with arms and legs held apart"
    return Check(f"{name}: share of the surface cut between limbs", share, "", 0.15, 1.0, explanation=advice)


@dataclass(frozen=True)
class _Ruled:
    """Settings of a part's transfer; rules of some of the cleaned part's vertices; the body's limbs, and which of them
    the vertices go around."""

    settings: TransferConfig
    rules: Mapping[int, str]
    axes: list[LimbAxis]
    limbs: Enclosure | None = None

    def weights(self, fit: PosedFit, body: BodyModel, part: TriangleMesh, source: np.ndarray) -> SkinWeights:
        """Transfer to what is left of the part; a component has the rule of its vertices."""
        config = self.settings
        if self.rules:
            component = surface_components(part)
            found = {int(c): self.rules[int(v)] for c, v in zip(component, source, strict=True) if int(v) in self.rules}
            config = replace(config, component_rules=found)
        limbs = None if self.limbs is None else self.limbs.of(source)
        return transfer_weights(fit.mesh, body.weights, part, config=config, enclosure=limbs)

    def stiff(self, part: TriangleMesh, source: np.ndarray) -> Bool[np.ndarray, " M"]:
        """Which faces are of rigid pieces, in which there is no bridge."""
        own, rules = self.settings.rule, self.rules
        # There are few rules and many vertices: each is read once.
        rigid = {text: PartRule.parse(text).kind in ("rigid", "isolate") for text in {own, *rules.values()}}
        if not rules:
            return np.full(part.face_count, rigid[own])
        return np.array([rigid[rules.get(v, own)] for v in source.tolist()], dtype=bool)[part.faces[:, 0]]


def rules_of_pieces(name: str, part: TriangleMesh, rules: Mapping[str, str]) -> dict[int, str]:
    """Return the rule of each vertex of the pieces that rules name, `NAME/NUMBER`, 0 the largest in area.

    Raises:
        InputError: a number that the part has no piece of.
    """
    start = f"{name}/"
    named = {int(key.removeprefix(start)): rule for key, rule in rules.items() if key.startswith(start)}
    if not named:
        return {}
    component = surface_components(part)
    order = np.argsort(-np.bincount(component[part.faces[:, 0]], part.face_areas), kind="stable")
    out: dict[int, str] = {}
    for number, rule in named.items():
        if number >= len(order):
            raise InputError(
                f"option rules: {name}/{number}", expected=f"pieces 0 to {len(order) - 1}", received=str(number)
            )
        out |= dict.fromkeys(np.flatnonzero(component == order[number]).tolist(), rule)
    return out


def transfer_config(label: str, body: BodyModel, config: BuildConfig) -> TransferConfig:
    """Return the settings of the transfer for a part of this label, by the build's method."""
    base = TransferConfig.paper() if config.method == "paper" else TransferConfig.for_label(label)
    return replace(base, joint_names=body.joint_names, max_influences=config.max_influences)


def _long_stretches(part: TriangleMesh, joined: Bool[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """Return those faces between two legs that belong to a stretch of `LEG_CUT` and more.

    Only legs that were parted so far get their inner sides back. A shorter cut, as of shorts below the crotch, is
    closed straight across with a patch from leg to leg, which a step tears more than the cloth that was there.
    """
    faces = np.flatnonzero(joined)
    number = face_components(part.faces[faces])
    kept = joined.copy()
    for one in np.unique(number):
        own = faces[number == one]
        if np.ptp(part.vertices[part.faces[own]].reshape(-1, 3), axis=0).max() < LEG_CUT:
            kept[own] = False
    return kept


def _without_bridges(
    part: TriangleMesh, fit: PosedFit, body: BodyModel, ruled: _Ruled, config: BridgeConfig
) -> tuple[TriangleMesh, np.ndarray, SkinWeights]:
    """Return a part without its bridges, the vertex of `part` for each of its vertices, and its skin weights.

    Weights are smoothed along the surface. A bridge between two limbs mixes their weights far outside of it too. They
    are therefore computed again after each cut, which reveals the remains of a bridge.
    """
    source = np.arange(part.vertex_count)
    opened = np.unique(part.border_edges)
    axes = ruled.axes
    known = axes and ruled.settings.confident is not None and config.rounds
    limbs = enclosed_by_one(part, axes, body.joint_count) if known else None
    # Cloth that passes a hand hangs on the sleeve where the scan has fused them, and would follow it.
    apart = webs_to_hands(fit.mesh, body.weights, part, ruled.settings, limbs=limbs) & ~ruled.stiff(part, source)
    # Trouser legs that touch are parted, too. Which leg the cloth goes around is found before that opens its rings.
    if limbs is not None:
        joined = _long_stretches(part, limbs.joining_legs(part.faces) & ~ruled.stiff(part, source))
        if joined.any():
            ruled, apart = replace(ruled, limbs=limbs), apart | joined
    if apart.any():
        part, source = cut_bridges(part, apart, config=config)
    weights = ruled.weights(fit, body, part, source)
    # Folded vertices lose their fold for the trial alone: those that are left with the part are counted later.
    limits = UnposeConfig(warn_below=0.0, fail_below=_FOLDED)
    rest = _at_rest(part, weights, fit, limits)
    # Bridges in folds first, because these are cut where the scan lacks the gap; then what still tears.
    for find in (find_bridges, find_tears):
        for _ in range(config.rounds):
            bridge = find(part, rest, fit.mesh, fit.at_rest, config=config) & ~ruled.stiff(part, source)
            if not bridge.any():
                break
            part, kept = cut_bridges(part, bridge, config=config)
            source = source[kept]
            weights = ruled.weights(fit, body, part, source)
            rest = _at_rest(part, weights, fit, limits)
    # What cuts leave of the other limb hangs in the air at rest; without it the weights get better, which shows more.
    for _ in range(config.rounds):
        cut = cut_borders(part, np.isin(source, opened))
        shred = find_shreds(part, rest, fit.mesh, fit.at_rest, cut) & ~ruled.stiff(part, source)
        if not shred.any():
            break
        part, kept = cut_bridges(part, shred, config=config)
        source = source[kept]
        weights = ruled.weights(fit, body, part, source)
        rest = _at_rest(part, weights, fit, limits)
    # Weights that are computed again may tear a few faces more, of which each would be a sail in the T-pose.
    torn = torn_specks(part, rest, config) & ~ruled.stiff(part, source)
    if config.rounds and torn.any():
        part, kept = cut_bridges(part, torn, config=config)
        source, weights = source[kept], weights.of(kept)
    return part, source, weights


def torn_specks(part: TriangleMesh, rest: TriangleMesh, config: BridgeConfig) -> Bool[np.ndarray, " M"]:
    """Return the faces with an edge that the T-pose tears by 5 cm and more, none where they are more than a speck.

    Args:
        part: as scanned, without bridges.
        rest: the part in the T-pose.
        config: thresholds; `tear` and `speck_area` count.
    """
    sides, at_rest = (row_lengths((m.triangles - np.roll(m.triangles, 1, axis=1)).reshape(-1, 3)) for m in (part, rest))
    torn = ((at_rest > config.tear * sides) & (at_rest - sides > 0.05)).reshape(-1, 3).any(axis=1)
    speck = part.face_areas[torn].sum() < config.speck_area * part.face_areas.sum()
    return torn & bool(speck)


def _at_rest(part: TriangleMesh, weights: SkinWeights, fit: PosedFit, limits: UnposeConfig) -> TriangleMesh:
    """Return a part in the T-pose, by weights without the folds that cannot be inverted."""
    tried = invertible_weights(weights, fit.posed_from_rest, least=_FOLDED)[0]
    return part.with_vertices(unpose(part.vertices, tried, fit.posed_from_rest, config=limits).vertices)


def unpose_parts(
    parts: Mapping[str, Part], weights: Mapping[str, SkinWeights], fit: PosedFit
) -> tuple[dict[str, Unposed], StageOutput]:
    """Bring the parts to the T-pose, by the inverse of the skinning that will drive them."""
    results, checks, numbers = {}, [], {}
    for name, part in parts.items():
        # Inverse of linear blend skinning: v_rest = (sum_j w_j T_j)^-1 v_posed for each vertex.
        result = unpose(part.mesh.vertices, weights[name], fit.posed_from_rest)
        # Edges that grow at rest were folded or bridged in the scan's pose; their 99.9th percentile finds webs that
        # remain.
        stretch = stretch_report(part.mesh, part.mesh.with_vertices(result.vertices))
        results[name] = result
        drawn = drawn_out(part.mesh, part.mesh.with_vertices(result.vertices), 3.0)
        area = float(part.mesh.with_vertices(result.vertices).face_areas[drawn].sum())
        numbers[name] = {"stretch": stretch.as_dict(), "drawn_out": area}
        # Posing the result again must give the scan back up to round-off; the limits are millimetres.
        checks += [
            Check(f"{name}: round trip", result.report.round_trip_max * MM, "mm", 1e-6, 1e-3),
            # The determinant of the blended 3x3 falls where bones turn against each other (the "candy wrapper" of
            # LBS); 1 is a rotation.
            Check(
                f"{name}: smallest determinant",
                result.report.determinant_min,
                "",
                0.25,
                0.05,
                higher_is_better=True,
                explanation="of the blended transforms; 1 is rigid, 0 cannot be inverted",
            ),
            Check(f"{name}: edge stretch p99.9", stretch.p999, "x", 3.0, 10.0),
            # An edge in a thousand may be a sliver; shreds have an area that one sees.
            Check(
                f"{name}: cloth drawn out",
                1e4 * area,
                "cm2",
                15.0,
                60.0,
                explanation="area in the T-pose of faces with an edge three times as long as in the scan",
            ),
        ]
    return results, StageOutput(checks, numbers)
