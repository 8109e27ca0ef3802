"""Label a clothed scan from its geometry, its colours and the fitted body, without a parser or photographs.

The labels L minimise the Potts energy `sum_i C_i(l_i) + sum_(i,j) w_ij [l_i != l_j]` over the scan's faces, where the
unary cost is the negative log posterior of a label at a face,

    C_i(l) = -log P(l | place_i) - log P(colour_i | l) - [l = skin] log-ratio of the distance to the body

The terms are found one after the other:

1. `by_body_chart`: the body's limbs are moved onto the scan, then every face gets a place on the body (region, height
   along the column of feet, legs and trunk, reach along the arm, azimuth, signed distance) from the body vertex that is
   nearest in position and normal.
2. `by_body_colors`: light that falls on one side alone is taken out; a palette of the scan (k-means in OKLab), and a
   normal distribution of this person's skin colour from the face and the hands, whose log-likelihood ratio tells skin
   from other colours.
3. `by_body_objects`, `by_body_headwear`: things in hands and on the head, by cuts of their own; all other steps leave
   them out.
4. `by_body_layers`: long hair, open coats and bibs, as connected faces whose colours are nearer to the layer's
   histogram than to all others; they are left out of the next step, which they would disturb. Coats and capes that
   colours do not show are found after it, by their lips or by what hangs off the legs.
5. `by_body_outfit`: the outline of the clothes. The unknowns are the four borders between shoe, skin, lower, skin and
   upper along the column, and the end of the sleeve. Their cost sums the KL divergence of each ring's colours from its
   run's, likelihood ratios of skin by colour and distance, and priors on usual clothes. Dynamic programming over rings
   gives the exact minimum; the sum over all outlines (forward-backward) gives P(label) of every ring. Without colours
   `by_body_shape` finds the same from hems, folds, feet and distances, which `by_body_hems` measures. Where colours do
   not show the border of upper and lower garment either, `by_body_waist` takes it from folds.
6. `by_body_prior`: P(label | place), the outline softened by the uncertainty of its borders.
7. `by_body_colors.label_costs`: P(colour | label) by expectation maximisation, averaged over neighbours of like colour.
8. `graph_cut`: alpha-expansion of the energy, with weights w that prefer concave folds and edges of colour.
9. `by_body_shells`: of figures whose garments are surfaces of their own, each is kept to its own. Faces that are longer
   than the rings of the outline are split before the first step.
10. `by_body_confidence`: confidence of each face, at most the probability of the outline that it depends on, and notes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64, Num

from smplxpp.body import BodyModel
from smplxpp.core import (
    OBJECT,
    BodyParams,
    InputError,
    MeshLike,
    TriangleMesh,
    as_mesh,
    require_at_least,
    require_positive,
)
from smplxpp.core.topology import face_adjacency
from smplxpp.raster import outer_visible_points
from smplxpp.segment.by_body_chart import FOOT, LEG, TRUNK, BodyChart, chart_of_scan, in_arm, in_column, settled_body
from smplxpp.segment.by_body_colors import (
    Blend,
    Palette,
    SkinModel,
    fit_skin,
    has_colors,
    label_costs,
    without_one_sided_light,
)
from smplxpp.segment.by_body_confidence import BODY_ELSEWHERE, confidence_bound, notes_on_labels
from smplxpp.segment.by_body_headwear import find_headwear
from smplxpp.segment.by_body_hems import Hems, legs_apart, nats_for_hair, nats_for_shoes, on_heels, roughness
from smplxpp.segment.by_body_layers import Layers, around_both, coat_by_shape, find_layers
from smplxpp.segment.by_body_objects import FoundObjects, find_objects
from smplxpp.segment.by_body_outfit import Outfit, OutfitConfig, find_outfit
from smplxpp.segment.by_body_prior import place_prior, standing_collar
from smplxpp.segment.by_body_rings import ARM_END, ARM_START, COLUMN_END, STEP, Rings, cloth_against_skin
from smplxpp.segment.by_body_shape import ShapeEvidence, outfit_by_shape
from smplxpp.segment.by_body_shells import garment_shells, of_whole_faces, split_long_faces
from smplxpp.segment.by_body_waist import find_waist, one_or_two
from smplxpp.segment.graph_cut import (
    COST_SCALE,
    PottsProblem,
    SmoothingConfig,
    absorb_islands,
    edge_weights,
    face_colors,
    likeness,
    minimize_potts,
)
from smplxpp.segment.segment import SegmentedScan


@dataclass(frozen=True)
class ByBodyConfig:
    """Options of `label_by_body`, chosen on the procedural people of the benchmark `labels_by_body`.

    Attributes:
        softness: standard deviation, in metres, of a hem about its ring.
        body_softness: standard deviation, in metres, of the body's place at the head.
        rounds: rounds of expectation maximisation of the labels' colours.
        color_cap: upper bound, in nats, of a face's cost of colour, so that one odd colour cannot decide.
        blend_steps: rings of faces over which costs of colour are averaged, against noise of the texture.
        distance: weight of a face's distance to the body where the scan has colours.
        distance_alone: the same where it has none.
        temperature: nats of cost for one nat of confidence, because the costs of a face are not independent.
        outfit: costs of the outline.
        smoothing: weights of the graph cut.
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
    """Intermediate results of `label_by_body`, step by step.

    Attributes:
        chart: places of the faces on the body.
        outfit: outline of the clothes.
        skin: model of skin colour; None without colours.
        layers: layers over other clothes.
        objects: things in hands and on the head.
        misfit: robust standard deviation, in metres, of bare skin's distance to the body.
        lab: colours without the light on one side; None without colours.
        costs: unary costs of all labels, nats.
    """

    chart: BodyChart
    outfit: Outfit
    skin: SkinModel | None
    layers: Layers
    objects: FoundObjects
    misfit: float
    lab: Float64[np.ndarray, "M 3"] | None
    costs: Float64[np.ndarray, "M L"]


def label_by_body(
    mesh: MeshLike,
    body: BodyModel,
    params: BodyParams,
    *,
    colors: Num[np.ndarray, "N C"] | None = None,
    config: ByBodyConfig | None = None,
) -> SegmentedScan:
    """Label every face of a clothed scan; the module's docstring gives the energy and the steps.

    The confidence of a face is the posterior of its label, averaged over neighbours, and at most the probability of the
    outline that it depends on. `notes` lists what cannot be decided.

    Args:
        mesh: the scan, metres, +Y up.
        body: the body model.
        params: one frame, in the pose of the scan.
        colors: sRGB of the vertices, bytes or 0..1; without them labels depend on the distance to the body alone.
        config: options.

    Raises:
        InputError: no faces, several frames, colours of another number of vertices or out of range.
    """
    mesh = as_mesh(mesh, subject="mesh")
    if not mesh.face_count:
        raise InputError("scan to be labelled", expected="a mesh with faces", received="none")
    config = config or ByBodyConfig()
    # Colours that are one grey carry no information.
    pairs, ends = face_adjacency(mesh.faces)
    lab = None if colors is None else face_colors(mesh, colors)
    if lab is not None and not has_colors(lab):
        lab = None
    # 5 mm is the tolerance of visibility: less than the gap between layers of clothes, more than the scan's noise.
    seen = outer_visible_points(mesh, mesh.face_centers, tolerance=0.005)
    if lab is not None and colors is not None:
        fine, fine_colors, whole = split_long_faces(mesh, colors)
        if fine.face_count > mesh.face_count:
            parts = label_by_body(fine, body, params, colors=fine_colors, config=config)
            return of_whole_faces(parts, fine.face_areas, whole, seen)
    found = weigh_evidence(mesh, body, params, lab, config)
    # Minimise the Potts energy. Unary costs are capped at 12 nats, so that a single face can be overruled by its patch.
    cost = found.costs - found.costs.min(axis=1, keepdims=True)
    weights = edge_weights(mesh, pairs, ends, config.smoothing, lab=found.lab)
    problem = PottsProblem.from_costs(np.minimum(cost, _CERTAIN), pairs, weights)
    before = problem.energy(cost.argmin(axis=1))
    cut, after = minimize_potts(problem)
    # Posterior of each label at a temperature; patches that are too small take their neighbours' label.
    share = np.exp(-cost / config.temperature)
    share /= share.sum(axis=1, keepdims=True)
    rows = np.arange(len(cut))
    labels = absorb_islands(mesh, cut, share[rows, cut], pairs, ends, config.smoothing)
    # Glasses are smaller than any garment, and no fragment of one.
    labels = np.where(found.objects.faces & (cut == OBJECT.id), OBJECT.id, labels)
    # Confidence is bounded by the outline's and falls with the body's misfit.
    bound = confidence_bound(found.chart, labels, found.outfit, found.layers, colored=lab is not None)
    own = np.minimum(share[rows, labels], bound)
    confidence = own * min(1.0, BODY_ELSEWHERE / max(found.misfit, 1e-9))
    labels, confidence = garment_shells(mesh, labels, confidence, found.chart.height)
    notes = notes_on_labels(
        found.chart,
        mesh.face_areas,
        labels,
        confidence,
        found.outfit,
        found.skin,
        misfit=found.misfit,
        hanging=found.layers.vague is not None,
    )
    notes = (*found.objects.notes, *notes)
    return SegmentedScan(
        labels, confidence, seen, int((labels != cut).sum()), before / COST_SCALE, after / COST_SCALE, notes=notes
    )


def weigh_evidence(
    mesh: TriangleMesh,
    body: BodyModel,
    params: BodyParams,
    lab: Float64[np.ndarray, "M 3"] | None,
    config: ByBodyConfig,
) -> Evidence:
    """Return the unary costs of all labels at all faces with their ingredients; `lab` is (M, 3) colours in OKLab."""
    # What is worn on the head is found first: it would pull the body that is moved onto the scan, a hat by 15 mm.
    pairs, ends = face_adjacency(mesh.faces)
    worn = find_headwear(mesh, body, params, pairs, ends, lab=lab)
    rest = mesh.submesh(~worn.faces)[0] if worn.faces.any() else mesh
    # The misfit of the body is the robust spread (1.4826 MAD) of the distances of face and hands.
    chart = chart_of_scan(mesh, body, params, posed=settled_body(rest, body, params))
    # What the person holds says nothing about her clothes, so that it has no area in the steps that follow. A body that
    # is not even at the face, where nothing is held, would make a thing of her own arm. Where it is at the hands, a hat
    # or a mask stands off the face: what lies near it is the face.
    face = chart.face_core & ~worn.faces
    elsewhere = face.any() and _spread(chart.distance[face]) > BODY_ELSEWHERE
    if elsewhere and chart.hand_core.any() and _spread(chart.distance[chart.hand_core]) < 0.5 * BODY_ELSEWHERE:
        face, elsewhere = face & (np.abs(chart.distance) < 0.5 * BODY_ELSEWHERE), False
    objects = FoundObjects.none(mesh.face_count)
    if not elsewhere:
        objects = find_objects(mesh, body, params, lab=lab).joined(worn)
    area = np.where(objects.faces, 0.0, mesh.face_areas)
    bare = (face | chart.hand_core) & ~objects.faces
    misfit = _spread(chart.distance[bare if bare.any() else slice(None)])
    misplaced = float(np.clip(misfit, 0.003, 0.02))
    # Colours: the palette, the skin model, and layers that hang over other clothes.
    skin, palette = None, None
    ratio = np.zeros(mesh.face_count)
    layers = Layers.none(mesh.face_count)
    skin_like = np.full(mesh.face_count, 0.5)
    if lab is not None:
        lab = without_one_sided_light(lab, chart)
        palette = Palette.of(lab)
        hands = (chart.hand_core & (chart.side > 0), chart.hand_core & (chart.side <= 0))
        skin = fit_skin(lab, face, hands, area)
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
            used=~(over | objects.faces)[mask],
        )

    # The outline of the clothes, from rings of the column and the arms. Without colours, habits of dress replace them.
    # A scan has a chest if 1 % of its area lies above 1.05 m of the standard trunk.
    column = rings(in_column(chart), layers.hair | layers.coat, chart.height, 0.0, COLUMN_END)
    arm = rings(in_arm(chart), layers.hair, chart.reach, ARM_START, ARM_END)
    top = (chart.region == TRUNK) & (chart.height > 1.05)
    chest = bool(area[top].sum() > 0.01 * area.sum())
    heels = on_heels(mesh, body, params)
    if lab is None:
        used = np.where(layers.hair | layers.coat, 0.0, area)
        shape = _shape_evidence(mesh, chart, column, arm, area=used, chest=chest, heels=heels)
        outfit = outfit_by_shape(shape)
        hairy = nats_for_hair(mesh, chart, area)
        layers = replace(layers, bald=hairy < 0.0, scalp=float(1.0 / (1.0 + np.exp(-abs(hairy)))))
    else:
        shod, apart = nats_for_shoes(chart, area), legs_apart(chart, area, len(column))
        outfit = find_outfit(
            column, arm, config.outfit, misfit=misplaced, chest=chest, heels=heels, shod=shod, apart=apart
        )
        if heels:
            # In shoes the colour of skin is none.
            skin_like = np.where(np.isin(chart.region, (FOOT, LEG)) & (chart.height < outfit.shoe_top), 0.01, skin_like)
    # The border between upper and lower garment where the surface shows it, and colours do not: another border costs at
    # most 22 nats more in suits of one dye and overalls, 29 and more where the garments differ in colour.
    close_call = 25.0
    clothes = ~(layers.hair | layers.coat | objects.faces)
    legs = legs_apart(chart, area, len(column))
    waist = find_waist(mesh, chart, outfit, pairs, ends, used=clothes, smoothing=config.smoothing)
    seamless = waist is not None and waist.seamless
    if waist is not None and not waist.shown:
        waist = None
    if waist is not None and layers.bib:
        # A front that ends over the trousers is a waistcoat's.
        layers = replace(layers, bib=False)
    elif lab is not None and outfit.margins["lower_end"] > close_call:
        waist, seamless = None, False
    if outfit.one_piece and not layers.bib:
        # A top and a skirt of one cloth are one garment for the outline, but not for the surface.
        outfit, waist = one_or_two(mesh, chart, outfit, pairs, ends, used=clothes, smoothing=config.smoothing)
    if waist is not None:
        outfit = replace(outfit, waist_step=np.inf)
    if seamless and not layers.bib:
        # Without a border a skirt is a dress, and trousers of the colours above them are a jumpsuit.
        joined = around_both(legs, column) or (lab is not None and outfit.alike(column))
        outfit = outfit.as_one_piece() if joined else replace(outfit, seamless=lab is None)
    # Coats and capes by shape, where colours show none.
    if not layers.coat.any():
        upper = chart.height > outfit.upper_start
        upper = upper if waist is None else np.where(waist.faces, waist.upper, upper)
        coat, vague = coat_by_shape(chart, area, outfit, column, legs, pairs=pairs, upper=upper, lips=lab is None)
        layers = replace(layers, coat=coat & clothes, hair=layers.hair & ~coat, vague=vague)
    prior = place_prior(
        chart,
        outfit,
        layers,
        softness=config.softness,
        body_softness=config.body_softness,
        waist=waist,
        collar=standing_collar(chart, area),
    )
    # Costs of colour are averaged over faces of like colour, and the distance to the body is added.
    blend = Blend.of(
        pairs,
        np.ones(len(pairs)) if lab is None else likeness(lab, pairs),
        mesh.face_count,
        steps=config.blend_steps,
    )
    weight = config.distance_alone if lab is None else config.distance
    local = _local_misfit(chart, column, arm, misplaced)
    # Distances err together, so that one of a face tells little for skin.
    alone = np.clip(cloth_against_skin(chart.distance, local), -0.5, 3.0)
    far = alone if lab is None else _cloth_by_distance(chart.distance, misplaced)
    costs = label_costs(
        prior,
        palette,
        skin_like,
        area=area,
        far=weight * far,
        blend=blend,
        bald=layers.bald,
        rounds=config.rounds,
        cap=config.color_cap,
    )
    # Nothing but the cut that found them makes faces of objects.
    costs[objects.faces] += _CERTAIN
    costs[:, OBJECT.id] = np.where(objects.faces, 0.0, _CERTAIN)
    return Evidence(chart, outfit, skin, layers, objects, misfit, lab, costs)


def _shape_evidence(
    mesh: TriangleMesh,
    chart: BodyChart,
    column: Rings,
    arm: Rings,
    *,
    area: Float64[np.ndarray, " M"],
    chest: bool,
    heels: bool,
) -> ShapeEvidence:
    """Measure hems along both legs and the trunk and along both arms, folds, feet, and how far the legs are apart."""
    legs, arms = np.isin(chart.region, (LEG, FOOT)), in_arm(chart)
    left = chart.side > 0

    def hems(place: np.ndarray, tubes: tuple[np.ndarray, ...], rings: Rings, *, strict: bool) -> Hems:
        return Hems.of(
            place,
            chart.turn,
            tubes=tubes,
            distance=chart.distance,
            area=area,
            start=rings.start,
            count=len(rings),
            strict=strict,
        )

    tubes = legs & left, legs & ~left, chart.region == TRUNK
    along = hems(chart.height, tubes, column, strict=True)
    return ShapeEvidence(
        column,
        arm,
        along.about_shoes(hems(chart.height, tubes, column, strict=False), column.places),
        hems(chart.reach, (arms & left, arms & ~left), arm, strict=False),
        _HEELED if heels else nats_for_shoes(chart, area),
        (
            roughness(mesh, (chart.region == TRUNK) & (chart.height > 1.0) & (chart.height < 1.3) & (area > 0)),
            roughness(mesh, (chart.region == LEG) & (chart.height > 0.55) & (chart.height < 0.75) & (area > 0)),
        ),
        legs_apart(chart, area, len(column)),
        chest,
    )


_HEELED = 4.0
"""Nats for shoes under raised heels, the most that the distance of the feet can say."""
_CERTAIN = 12.0
"""Nats, the largest cost of a label at a face."""


def _spread(distance: np.ndarray) -> float:
    """Return the robust standard deviation about 0, 1.4826 times the median of the absolute values."""
    return float(1.4826 * np.median(np.abs(distance)))


def _local_misfit(chart: BodyChart, column: Rings, arm: Rings, misfit: float) -> Float64[np.ndarray, " M"]:
    """Return what the body misses each face by, metres: the spread of the distances about its limb there.

    A limb that no shape of the model has, or that is turned, lies on the body on one side and off it on the other,
    while face and hands may fit. `misfit` is that of face and hands, the least anywhere.
    """
    out = np.full(len(chart.region), misfit)
    for mask, rings, place in ((in_column(chart), column, chart.height), (in_arm(chart), arm, chart.reach)):
        ring = np.clip(np.floor((place[mask] - rings.start) / STEP).astype(np.int64), 0, len(rings) - 1)
        out[mask] = np.clip(rings.spread[ring], misfit, 0.02)
    return out


def _cloth_by_distance(distance: np.ndarray, misfit: float) -> np.ndarray:
    """Return the log ratio of distances for cloth against skin.

    Skin has a normal distribution about 0, whose spread is the body's misfit; cloth an exponential distribution of mean
    12 mm above the body, because cloth lies from some millimetres to some centimetres above it. The ratio is bounded
    to [-0.5, 3] nats, because distances err together.
    """
    above = 0.012
    spread = np.hypot(misfit, 0.004)
    z = distance / spread
    ratio = 0.5 * z**2 - np.maximum(distance, 0.0) / above - np.log(above / spread)
    return np.where(z < 0, -0.5, np.clip(ratio, -0.5, 3.0))
