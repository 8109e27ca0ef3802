"""Labels of a clothed scan from its geometry, its colours and the body fitted to it: no parser, no photographs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64, Num

from smplxpp.body import BodyModel
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import MeshLike, TriangleMesh, as_mesh
from smplxpp.core.params import BodyParams
from smplxpp.core.topology import face_adjacency
from smplxpp.core.validation import require_at_least, require_positive
from smplxpp.raster import outer_visible_points
from smplxpp.segment.by_body_appearance import Blend, label_costs
from smplxpp.segment.by_body_certainty import most_certain
from smplxpp.segment.by_body_chart import TRUNK, BodyChart, chart_of_scan
from smplxpp.segment.by_body_colors import Palette, SkinModel, fit_skin, has_colors
from smplxpp.segment.by_body_doubts import AWAY, find_doubts
from smplxpp.segment.by_body_layers import Layers, find_layers
from smplxpp.segment.by_body_outfit import (
    ARM_END,
    ARM_START,
    COLUMN_END,
    Outfit,
    OutfitConfig,
    Rings,
    find_outfit,
    in_arm,
    in_column,
)
from smplxpp.segment.by_body_prior import place_prior
from smplxpp.segment.graph_cut import COST_SCALE, PottsProblem, minimize_potts
from smplxpp.segment.segment import SegmentedScan
from smplxpp.segment.smoothing import SmoothingConfig, absorb_islands, edge_weights, face_colors, likeness

_SEEN_WITHIN = 0.005  # metres
_MOST_NATS = 12.0
# Cloth lies above the body by some millimetres and up to some centimetres.
_ABOVE = 0.012
# A scan has a chest if this share of its area lies above this height of the trunk, standard metres.
_CHEST, _SOME = 1.05, 0.01


@dataclass(frozen=True)
class ByBodyConfig:
    """Options of `label_by_body`.

    Attributes:
        softness: metres by which a hem may hang lower or higher than the ring where it is looked for.
        body_softness: metres by which the body may be misplaced at the head.
        rounds: of learning the labels' colours.
        color_cap: nats that the colour of a face may cost a label at most.
        blend_steps: rings of faces over which costs of colour are averaged.
        distance: weight of a face's distance to the body with colours; `distance_alone` without.
        temperature: nats of cost that are a nat of confidence.
        outfit: costs of the outline. smoothing: of the graph cut.
    """

    softness: float = 0.035
    body_softness: float = 0.03
    rounds: int = 4
    color_cap: float = 4.0
    blend_steps: int = 8
    distance: float = 0.3
    distance_alone: float = 1.0
    temperature: float = 1.5
    outfit: OutfitConfig = field(default_factory=OutfitConfig)
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)

    def __post_init__(self) -> None:
        require_positive("softness", self.softness)
        require_at_least("rounds", self.rounds, 1)
        require_positive("temperature", self.temperature)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was found on the way to the labels.

    Attributes:
        chart: places on the body. outfit: the outline. skin: the skin model; None without colours.
        layers: what lies over the rest. misfit: metres by which the body misses bare skin.
        costs: (M, L) nats.
    """

    chart: BodyChart
    outfit: Outfit
    skin: SkinModel | None
    layers: Layers
    misfit: float
    costs: Float64[np.ndarray, "M L"]


def label_by_body(
    mesh: MeshLike,
    body: BodyModel,
    params: BodyParams,
    *,
    colors: Num[np.ndarray, "N C"] | None = None,
    config: ByBodyConfig | None = None,
) -> SegmentedScan:
    """Label every face of a clothed scan.

    The body says where face, hands, feet and skull are. The face and the hands give this person's skin colour; the
    outline of the clothes (`find_outfit`) gives each place its likely label; labels learn their colours from it; a
    graph cut along folds and edges of colour settles the borders.

    Confidence is P(label) of a face given all that, over the faces around it, and not above the probability of the
    outline that it rests on. `doubts` says what cannot be known.

    Args:
        params: one frame, in the pose of the scan. colors: sRGB of the vertices, bytes or 0..1; without them labels
            rest on the distance to the body alone, and the doubts say so.

    Raises:
        InputError: no faces, several frames, colours of another number of vertices or out of range.
    """
    mesh = as_mesh(mesh, subject="mesh")
    if not mesh.face_count:
        raise InputError("scan to be labelled", expected="a mesh with faces", received="none")
    config = config or ByBodyConfig()
    pairs, ends = face_adjacency(mesh.faces)
    lab = None if colors is None else face_colors(mesh, colors)
    if lab is not None and not has_colors(lab):
        lab = None
    found = weigh_evidence(mesh, body, params, lab, config)
    cost = found.costs - found.costs.min(axis=1, keepdims=True)
    weights = edge_weights(mesh, pairs, ends, config.smoothing, lab=lab)
    problem = PottsProblem.from_costs(np.minimum(cost, _MOST_NATS), pairs, weights)
    before = problem.energy(cost.argmin(axis=1))
    cut, after = minimize_potts(problem)
    share = np.exp(-cost / config.temperature)
    share /= share.sum(axis=1, keepdims=True)
    rows = np.arange(len(cut))
    labels = absorb_islands(mesh, cut, share[rows, cut], pairs, ends, config.smoothing)
    own = np.minimum(share[rows, labels], most_certain(found.chart, labels, found.outfit, found.layers))
    confidence = own * min(1.0, AWAY / max(found.misfit, 1e-9))
    seen = outer_visible_points(mesh, mesh.face_centers, tolerance=_SEEN_WITHIN)
    doubts = find_doubts(mesh, labels, confidence, found.outfit, found.skin, misfit=found.misfit)
    return SegmentedScan(
        labels, confidence, seen, int((labels != cut).sum()), before / COST_SCALE, after / COST_SCALE, doubts=doubts
    )


def weigh_evidence(
    mesh: TriangleMesh,
    body: BodyModel,
    params: BodyParams,
    lab: Float64[np.ndarray, "M 3"] | None,
    config: ByBodyConfig,
) -> Evidence:
    """The costs of all labels at all faces, and what they were made of; `lab`: colours of the faces."""
    chart = chart_of_scan(mesh, body, params)
    area = mesh.face_areas
    pairs, _ = face_adjacency(mesh.faces)
    bare = chart.face_core | chart.hand_core
    misfit = float(1.4826 * np.median(np.abs(chart.distance[bare if bare.any() else slice(None)])))
    misplaced = float(np.clip(misfit, 0.003, 0.02))
    skin, palette = None, None
    ratio = np.zeros(mesh.face_count)
    layers = Layers.none(mesh.face_count)
    skin_like = np.full(mesh.face_count, 0.5)
    if lab is not None:
        palette = Palette.of(lab)
        skin = fit_skin(lab, chart.face_core, chart.hand_core, area)
        ratio = skin.log_ratio(lab)
        skin_like = 1.0 / (1.0 + np.exp(-(ratio + 1.0)))
        layers = find_layers(chart, palette, ratio, area, pairs)

    def rings(mask: np.ndarray, over: np.ndarray, place: np.ndarray, start: float, end: float) -> Rings:
        return Rings.of(
            place[mask],
            start,
            end,
            area=area[mask],
            color=np.zeros(int(mask.sum()), dtype=np.int64) if palette is None else palette.index[mask],
            color_count=1 if palette is None else palette.size,
            skin=ratio[mask],
            distance=chart.distance[mask],
            used=~over[mask],
        )

    column = rings(in_column(chart), layers.hair | layers.coat, chart.height, 0.0, COLUMN_END)
    arm = rings(in_arm(chart), layers.hair, chart.reach, ARM_START, ARM_END)
    outline = config.outfit if lab is not None else replace(config.outfit, habit=1.0)
    chest = (chart.region == TRUNK) & (chart.height > _CHEST)
    outfit = find_outfit(column, arm, outline, misfit=misplaced, chest=area[chest].sum() > _SOME * area.sum())
    prior = place_prior(chart, outfit, layers, softness=config.softness, body_softness=config.body_softness)
    blend = Blend.of(
        pairs,
        np.ones(len(pairs)) if lab is None else likeness(lab, pairs),
        mesh.face_count,
        steps=config.blend_steps,
    )
    weight = config.distance_alone if lab is None else config.distance
    costs = label_costs(
        prior,
        palette,
        skin_like,
        area=area,
        far=weight * _cloth_by_distance(chart.distance, misplaced),
        blend=blend,
        bald=layers.bald,
        rounds=config.rounds,
        cap=config.color_cap,
    )
    return Evidence(chart, outfit, skin, layers, misfit, costs)


def _cloth_by_distance(distance: np.ndarray, misfit: float) -> np.ndarray:
    """Log ratio of distances for something worn against skin: a normal distribution against a shifted one."""
    spread = np.hypot(misfit, 0.004)
    z = distance / spread
    ratio = 0.5 * z**2 - np.maximum(distance, 0.0) / _ABOVE - np.log(_ABOVE / spread)
    return np.where(z < 0, -0.5, np.clip(ratio, -0.5, 3.0))
