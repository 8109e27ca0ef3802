"""Light on one side, what hangs off the legs, bare scalps, seamless cloth: what the surface shows and what not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.core import HAIR, LABELS, LOWER, SKIN, UPPER, TriangleMesh
from smplxpp.core.topology import face_adjacency
from smplxpp.segment.by_body_chart import ARM, HEAD, LEG, TRUNK, BodyChart
from smplxpp.segment.by_body_colors import without_one_sided_light
from smplxpp.segment.by_body_confidence import UNSURE, confidence_bound, notes_on_labels
from smplxpp.segment.by_body_hems import nats_for_hair
from smplxpp.segment.by_body_layers import Layers, hanging_layer
from smplxpp.segment.by_body_outfit import Outfit
from smplxpp.segment.by_body_rings import COLUMN_END, STEP, Rings
from smplxpp.segment.by_body_waist import find_waist, one_or_two
from smplxpp.segment.graph_cut import SmoothingConfig


def chart_of(region, height, azimuth, *, reach=0.0, distance=0.0, face_height=0.0) -> BodyChart:
    """A chart of faces whose places are known; legs turn as the trunk does."""
    count = len(region)
    rows = [np.broadcast_to(np.asarray(x, np.float64), count).copy() for x in (height, reach, azimuth)]
    side = np.where(np.sin(azimuth) >= 0, 1, -1)
    more = [np.broadcast_to(np.asarray(x, np.float64), count).copy() for x in (face_height, distance)]
    return BodyChart(np.asarray(region), *rows, rows[2].copy(), *more, side)


def test_a_shadow_on_one_side_is_no_other_cloth_and_a_glove_on_one_hand_is():
    rng = np.random.default_rng(0)
    count = 6000
    height, turn = rng.uniform(0.1, 1.4, count), rng.uniform(-np.pi, np.pi, count)
    chart = chart_of(np.where(height < 0.9, LEG, TRUNK), height, turn)
    shirt, trousers, patch = np.array([0.8, 0.01, 0.02]), np.array([0.45, -0.01, -0.08]), np.array([0.5, 0.15, 0.08])
    albedo = np.where((height < 0.95)[:, None], trousers, shirt) * (1.0 + 0.02 * rng.normal(size=(count, 1)))
    one_sided = (height > 1.1) & (height < 1.25) & (np.abs(turn - 1.2) < 0.4)
    albedo[one_sided] = patch
    # Light of strength k scales OKLab by the cube root of k.
    lit = np.where(np.sin(turn) > 0, 0.3 ** (1 / 3), 1.0)[:, None] * albedo
    found = without_one_sided_light(lit, chart)
    left = np.log(found[:, 0] / albedo[:, 0])
    assert np.std(np.log(lit[:, 0] / albedo[:, 0])) > 0.19
    assert np.percentile(np.abs(left - np.median(left)), 95) < 0.06
    np.testing.assert_allclose(found[:, 1:] / found[:, :1], lit[:, 1:] / lit[:, :1], atol=1e-9)
    # Light that is alike on both sides is left as it is, other cloth on one side too.
    np.testing.assert_allclose(without_one_sided_light(albedo, chart)[:, 0], albedo[:, 0], rtol=0.05)


def _outfit(**changes) -> Outfit:
    count = round(COLUMN_END / STEP)
    kind = {"shoe_top": 0.0, "lower_start": 0.0, "lower_end": 0.9, "upper_start": 0.9, "cuff": 0.4} | changes
    shares = np.full((count, len(LABELS)), 1.0)
    return Outfit(**kind, margins={}, column=shares, sleeve=np.ones(45))


@pytest.mark.parametrize("where", ["behind", "around", "skirt", "nowhere"])
def test_what_hangs_behind_legs_that_are_seen_one_by_one_is_a_cape(where):
    rng = np.random.default_rng(1)
    count = 9000
    height, turn = rng.uniform(0.0, 1.3, count), rng.uniform(-np.pi, np.pi, count)
    arm = rng.random(count) < 0.15
    region = np.where(arm, ARM, np.where(height < 0.9, LEG, TRUNK))
    hangs = (np.abs(turn) > np.pi / 2) if where == "behind" else np.full(count, where in ("around", "skirt"))
    sheet = hangs & ~arm & (height > 0.4) & (height < 0.9) & (rng.random(count) < 0.7)
    distance = np.where(sheet, 0.09, 0.004)
    chart = chart_of(region, height, turn, reach=rng.uniform(0, 0.5, count), distance=distance)
    area, column = np.full(count, 2e-4), ~arm
    rings = Rings.of(
        height[column],
        0.0,
        COLUMN_END,
        area=area[column],
        color=np.zeros(int(column.sum()), np.int64),
        color_count=1,
        skin=np.zeros(int(column.sum())),
        distance=distance[column],
        used=np.ones(int(column.sum()), bool),
    )
    apart = np.full(len(rings), 0.0 if where == "skirt" else 1.0)
    found = hanging_layer(chart, area, rings, apart, upper=height > 0.9)
    if where in ("skirt", "nowhere"):
        assert found is None
        return
    layer, vague = found
    # What hangs behind alone is a cape, whose reach on the trunk is not known; what hangs all round has no name.
    sleeves = arm & (chart.reach < 0.4)
    assert not layer[sleeves].any()
    assert layer[sheet].all() if where == "behind" else not layer.any()
    assert vague[sleeves].all() and vague[region == TRUNK].all()
    assert vague[sheet & (region == LEG)].all() == (where == "around")
    labels = np.where(height > 0.9, UPPER.id, LOWER.id)
    bound = confidence_bound(chart, labels, _outfit(), Layers(False, layer, layer, False, vague), colored=False)
    assert (bound[region == TRUNK] < UNSURE).all()


@pytest.mark.parametrize("strands", [0.0, 0.003])
def test_a_smooth_scalp_is_bare_and_one_in_strands_is_not(strands):
    along, around = np.meshgrid(np.linspace(0.05, np.pi - 0.05, 60), np.linspace(0, 2 * np.pi, 120, endpoint=False))
    radius = 0.09 + strands * np.sin(14 * around) * np.sin(along)
    direction = np.stack([np.sin(along) * np.sin(around), np.cos(along), np.sin(along) * np.cos(around)], axis=-1)
    points = (radius[..., None] * direction).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(120), np.arange(59), indexing="ij")
    at, after = i * 60 + j, ((i + 1) % 120) * 60 + j
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((at, at + 1, after), (after, at + 1, after + 1))])
    mesh = TriangleMesh(points, faces)
    azimuth = np.arctan2(mesh.face_centers[:, 0], mesh.face_centers[:, 2])
    chart = chart_of(np.full(len(faces), HEAD), 1.6, azimuth, face_height=mesh.face_centers[:, 1] / 0.18 + 0.5)
    nats = nats_for_hair(mesh, chart, mesh.face_areas)
    assert nats < -2.0 if strands == 0.0 else nats > 2.0
    # Near the odds of one the label is not sure.
    labels = np.full(len(faces), HAIR.id)
    nothing = np.zeros(len(faces), bool)
    bound = confidence_bound(chart, labels, _outfit(), Layers(False, nothing, nothing, False, scalp=0.55))
    assert bound.min() <= 0.55 and bound[chart.face_core].min() == 1.0


@pytest.mark.parametrize("step", [0.0, 0.012])
def test_cloth_without_a_fold_at_the_waist_may_be_one_garment(step):
    rows, columns = 120, 90
    heights = np.linspace(0.5, 1.3, rows)
    turns = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    radius = 0.15 + np.where(heights > 0.92, step, 0.0)
    points = np.stack(
        [np.outer(radius, np.sin(turns)), np.repeat(heights[:, None], columns, 1), np.outer(radius, np.cos(turns))],
        axis=-1,
    ).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    at, right = i * columns + j, i * columns + (j + 1) % columns
    up, other = at + columns, right + columns
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((at, right, up), (right, other, up))])
    mesh = TriangleMesh(points, faces)
    center = mesh.face_centers
    chart = chart_of(np.where(center[:, 1] < 0.9, LEG, TRUNK), center[:, 1], np.arctan2(center[:, 0], center[:, 2]))
    pairs, ends = face_adjacency(faces)
    waist = find_waist(mesh, chart, _outfit(), pairs, ends, used=np.ones(len(faces), bool), smoothing=SmoothingConfig())
    assert waist is not None
    assert waist.seamless == (step == 0.0)
    assert waist.shown == (step > 0.0)
    assert waist.height == pytest.approx(0.92, abs=0.01) or not step
    # What the outline takes for one garment is two where the surface has the border, and not at the garment's own hem.
    for hem in (0.6, 0.88):
        one = _outfit(lower_start=0.5, lower_end=0.5, upper_start=hem)
        found, border = one_or_two(
            mesh, chart, one, pairs, ends, used=np.ones(len(faces), bool), smoothing=SmoothingConfig()
        )
        in_two = bool(step) and hem == 0.6
        assert (border is not None) == found.has_lower == in_two
        assert found.seamless == (not step)
        assert found.lower_start == (hem if in_two else 0.5) and found.upper_start == (0.98 if in_two else hem)


def test_a_bare_trunk_above_shorts_is_not_sure_without_colours():
    height = np.linspace(0.1, 1.3, 500)
    chart = chart_of(np.where(height < 0.9, LEG, TRUNK), height, np.zeros(500))
    outfit = _outfit(lower_start=0.6, lower_end=1.0, upper_start=COLUMN_END)
    labels = np.where((height > 0.6) & (height < 1.0), LOWER.id, SKIN.id)
    none = Layers.none(500)
    bare = (labels == SKIN.id) & (height > 1.0)
    assert (confidence_bound(chart, labels, outfit, none, colored=False)[bare] < UNSURE).all()
    assert (confidence_bound(chart, labels, outfit, none)[bare] > UNSURE).all()


def test_a_seamless_waist_is_not_sure_and_said():
    height = np.linspace(0.1, 1.3, 500)
    chart = chart_of(np.where(height < 0.9, LEG, TRUNK), height, np.zeros(500))
    outfit = _outfit()
    outfit = Outfit(**{**outfit.__dict__, "seamless": True})
    labels = np.where(height < 0.9, LOWER.id, UPPER.id)
    bound = confidence_bound(chart, labels, outfit, Layers.none(500), colored=False)
    assert (bound < UNSURE).all()
    notes = notes_on_labels(chart, np.ones(500), labels, bound, outfit, None, misfit=0.003, hanging=True)
    assert any("one garment" in note for note in notes) and any("cape" in note for note in notes)
    whole = outfit.as_one_piece()
    assert whole.one_piece and not whole.has_lower and whole.upper_start == outfit.lower_start
    assert (whole.column[:, LOWER.id] == 0).all() and (whole.column[:, UPPER.id] == 2).all()


def test_a_dress_without_a_seam_is_doubted_once():
    """Two fifths of a dancer were unsure: the odds of a dress against a skirt and a top counted twice, though the
    surface has no border at her waist."""
    height = np.linspace(0.1, 1.3, 500)
    chart = chart_of(np.where(height < 0.9, LEG, TRUNK), height, np.zeros(500))
    shares = np.zeros((round(COLUMN_END / STEP), len(LABELS)))
    shares[:, UPPER.id], shares[:, LOWER.id] = 0.63, 0.37
    outfit = replace(_outfit(lower_start=0.0, lower_end=0.0, upper_start=0.0), column=shares)
    labels = np.full(500, UPPER.id)
    before, after = (
        confidence_bound(chart, labels, one, Layers.none(500), colored=False) for one in (outfit, outfit.as_one_piece())
    )
    assert (before < 0.5).all() and (after > UNSURE).all() and (after < 0.8).all()
