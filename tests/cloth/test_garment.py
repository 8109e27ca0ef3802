"""Garments cut from a template: what holds them, what they carry, what they touch; opening bridges; bad garments."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.accuracy.cloth_stress import dressed, wardrobe
from smplxpp.body import load_body
from smplxpp.cloth import DriverConfig, Fabric, Garment, GarmentConfig, SolverConfig, cut_garment
from smplxpp.cloth.cloth_mesh import find_opening_bridges, find_opening_lids
from smplxpp.cloth.garment import find_carriers, usual_config
from smplxpp.core import HAIR, GeometryWarning, InputError, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.people.garments.cut import tube_along
from smplxpp.people.garments.hair import hairstyles
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.template.template import BODY_PART
from tests.cloth.persons import HEM, PART, WAIST, person, standing
from tests.dolls.doll import ball

COARSE = GarmentConfig(spacing=0.06, collider_spacing=0.04)


def cut(config: GarmentConfig = COARSE, **changes) -> Garment:
    return cut_garment(person(**changes), PART, standing(), config)


def test_a_skirt_hangs_from_its_waist_alone():
    garment = cut()
    height = garment.rest.vertices[:, 1]
    assert garment.pinned.any()
    np.testing.assert_allclose(height[garment.pinned], WAIST, atol=0.001)
    assert (height[garment.depth > 0.45] < HEM + 0.1).all() and garment.depth.max() > 0.45
    model = garment.model()
    assert (model.inverse_mass[garment.pinned] == 0).all() and (model.inverse_mass[~garment.pinned] > 0).all()
    assert 1.0 / model.inverse_mass[~garment.pinned].sum() > 0
    mass = (1.0 / model.inverse_mass[~garment.pinned].astype(float)).sum()
    assert mass == pytest.approx(garment.config.fabric.density * garment.rest.face_areas.sum(), rel=0.1)


def test_it_carries_all_vertices_of_the_part_and_the_pins_have_none_of_the_simulation():
    garment, template = cut(), person()
    np.testing.assert_array_equal(garment.vertices, np.unique(template.faces[template.part_faces(PART)]))
    share, depth = garment.share(), garment.vertex_depth
    assert (share[depth <= garment.config.pin_depth] == 0).all()
    assert (share[depth >= garment.config.pin_depth + garment.config.band] == 1).all()
    order = np.argsort(depth)
    assert (np.diff(share[order]) >= 0).all() and 0 < share.mean() < 1
    np.testing.assert_allclose(garment.embedding.carried(garment.rest), template.vertices[garment.vertices], atol=1e-6)


def test_the_outline_of_a_tie_is_no_opening_that_holds_it():
    """It lies on the chest all along, and was held all along, so that it did not swing."""
    mannequin = Mannequin.of(load_body(), np.zeros(10))
    tie = wardrobe(mannequin)["tie"]
    garment = cut_garment(dressed(mannequin, tie), tie.label, mannequin.params)
    height = garment.rest.vertices[:, 1]
    middle = 0.5 * (height.min() + height.max())
    assert garment.pinned.any() and not garment.pinned[height < middle - garment.config.pin_depth].any()


def test_lengths_at_rest_are_those_of_the_cloth_not_of_its_chords():
    garment = cut()
    a, b = garment.rest.edges.T
    chords = np.linalg.norm(garment.rest.vertices[a] - garment.rest.vertices[b], axis=1)
    assert (garment.lengths >= chords - 1e-9).all()
    assert garment.lengths.sum() > 1.001 * chords.sum()  # it is round


def test_spacing_is_what_was_asked_for():
    counts = {}
    for spacing in (0.06, 0.04):
        garment = cut(replace(COARSE, spacing=spacing))
        assert np.median(garment.lengths) == pytest.approx(spacing, rel=0.3)
        counts[spacing] = len(garment.particles)
    assert counts[0.04] / counts[0.06] == pytest.approx(2.25, rel=0.25)


def test_it_touches_skin_near_it_that_faces_out():
    garment, template = cut(), person()
    collider = garment.collider
    assert (collider.vertices < template.body.vertex_count).all()
    mesh = TriangleMesh(template.vertices[collider.vertices], collider.faces)
    body = template.part_mesh(BODY_PART)
    skin = body.vertex_normals[collider.vertices[collider.faces]].mean(axis=1)
    assert (np.einsum("fi,fi->f", mesh.face_normals, skin) > 0.3).mean() > 0.98
    np.testing.assert_allclose(collider.margin, garment.config.skin_margin)


def test_coarse_skin_lies_hardly_inside_of_the_skin_else_that_shows_through_drawn_cloth():
    template, collider = person(), cut(GarmentConfig()).collider
    skin = template.part_mesh(BODY_PART).vertices
    coarse = TriangleMesh(template.vertices[collider.vertices], collider.faces)
    found = SignedDistanceField(coarse, solid=False).query(skin)
    near = (np.abs(found.distance) < 0.03) & ~found.on_border
    assert np.quantile(found.distance[near], 0.98) < DriverConfig().drawn_margin


def test_a_skirt_touches_all_of_the_leg_that_it_can_fall_over():
    """Skin 30 cm about it was all that it knew: in a squat the shins of a full circle skirt came through sideways."""
    garment, template = cut(), person()
    height = template.vertices[garment.collider.vertices, 1]
    assert garment.depth.max() > 0.45 and height.min() < HEM - 0.4 == pytest.approx(0.05)
    # What lies above its hem is still looked at within 30 cm alone.
    assert height.max() < WAIST + 0.3


@pytest.mark.long
def test_hair_hangs_from_the_head_alone():
    """Where it lay on shoulders it was pinned to them, and tore from the head that turns."""
    body = load_body()
    mannequin = Mannequin.of(body, np.zeros(body.num_betas))
    template = dressed(mannequin, hairstyles(mannequin)[1])
    garment = cut_garment(template, HAIR.name, mannequin.params)
    shoulder = mannequin.joints["left_shoulder"][1]
    held = garment.rest.vertices[garment.pinned]
    assert len(held) >= 3 and held[:, 1].min() > shoulder + 0.08
    assert garment.rest.vertices[:, 1].min() < shoulder - 0.2
    # It is hair and no cloth: heavier, rounder, and its strands rub against each other.
    assert garment.config == usual_config(template, HAIR.name) != GarmentConfig()
    assert garment.config.fabric.density > Fabric().density
    assert usual_config(person(), PART) == GarmentConfig()


def test_another_pin_depth_holds_more_without_cutting_anew():
    garment = cut()
    deeper = garment.with_config(replace(garment.config, pin_depth=0.1))
    assert deeper.pinned.sum() > 2 * garment.pinned.sum() and deeper.rest is garment.rest
    assert (deeper.share() <= garment.share()).all() and deeper.share().sum() < garment.share().sum()


@pytest.mark.long
def test_a_bridge_under_a_hem_is_found_and_cut_off():
    template = person(bridge=2)
    bridge = find_opening_bridges(template)
    heights = template.vertices[template.faces[bridge]][..., 1]
    assert bridge.sum() == 192 and np.ptp(heights) < 1e-9 and heights[0, 0] == pytest.approx(HEM)
    with_bridge, without = cut(bridge=2), cut()
    assert with_bridge.rest.face_areas.sum() == pytest.approx(without.rest.face_areas.sum(), rel=0.01)
    # Its vertices ride along.
    assert len(with_bridge.vertices) == len(without.vertices) + 96
    assert np.isfinite(with_bridge.vertex_depth).all() and with_bridge.share()[-96:].min() == 1.0


@pytest.mark.parametrize("outwards", [True, False])
def test_a_lid_under_a_wide_skirt_is_a_bridge_as_a_whole(outwards):
    """The scan of a calf-length skirt closed all of it below; simulated, its hem was tied across."""
    template, without = person(bridge=5, outwards=outwards), person(outwards=outwards)
    bridge = find_opening_bridges(template)
    assert bridge.sum() == 5 * 96 and np.ptp(template.vertices[template.faces[bridge]][..., 1]) < 1e-9
    assert cut(bridge=5).rest.face_areas.sum() == pytest.approx(cut().rest.face_areas.sum(), rel=0.01)
    # As a part of a scan it is cut; what is no wider than a hem's gap stays.
    body = template.part_mesh(BODY_PART)
    if outwards:
        lids = find_opening_lids(template.part_mesh(PART), body)
        np.testing.assert_array_equal(lids, bridge[template.part_faces(PART)])
        for other in (person(bridge=2), without):
            assert not find_opening_lids(other.part_mesh(PART), body).any()
        inwards = TriangleMesh(body.vertices, body.faces[:, ::-1])
        assert not find_opening_lids(template.part_mesh(PART), inwards).any()


@pytest.mark.parametrize("moved", [0.05, -0.05])
def test_a_dent_in_a_bridge_is_the_bridges(moved):
    flat = person(bridge=2)
    bridge = find_opening_bridges(flat)
    ring = np.unique(flat.faces[bridge])
    # Of its inner edge: no face around such a vertex touches the skirt.
    inside = ring[~np.isin(ring, flat.faces[~bridge])]
    edge = min(inside, key=lambda vertex: (flat.faces == vertex).any(axis=1).sum())
    vertices = flat.vertices.copy()
    vertices[edge, 1] += moved
    dented = replace(flat, vertices=vertices)
    assert (bridge & (np.abs(dented.mesh.face_normals[:, 1]) < 0.5)).any()
    np.testing.assert_array_equal(find_opening_bridges(dented), bridge)


def test_a_skirt_without_a_bridge_has_none_and_nobody_takes_a_waist_for_one():
    assert not find_opening_bridges(person()).any()
    assert not find_opening_bridges(person(tight=False)).any()


def test_a_body_that_is_no_solid_has_no_bridges_and_carries_nothing():
    template = person(bridge=2)
    faces = template.faces.copy()
    body = template.part_faces(BODY_PART)
    faces[body] = faces[body][:, ::-1]
    hollow = replace(template, faces=faces)
    assert not find_opening_bridges(hollow).any()
    with pytest.warns(GeometryWarning, match="inwards"), pytest.raises(InputError, match="point inward"):
        cut_garment(hollow, PART, standing(), COARSE)


def test_waists_carry_and_hems_do_not():
    template = person()
    cloth = template.mesh.submesh(template.part_faces(PART))[0]
    body = template.part_mesh(BODY_PART)
    carriers = find_carriers(cloth, body)
    np.testing.assert_allclose(cloth.vertices[carriers][:, 1], WAIST)
    assert carriers.sum() == 48
    lowered = cloth.with_vertices(cloth.vertices * [1.3, 1, 1.3])  # 5 cm from the skin: a waistband under a shirt
    assert find_carriers(lowered, body).sum() == 48
    wide = cloth.with_vertices(cloth.vertices * [2.0, 1, 2.0])
    assert not find_carriers(wide, body).any()


def test_an_apron_that_is_tied_in_the_back_hangs_from_its_upper_edge():
    template = person()
    cloth = template.mesh.submesh(template.part_faces(PART))[0]
    lowered = cloth.vertices * [1.2, 1, 1.2]  # as far off as a waistband: nothing of it is tight
    front = cloth.with_vertices(lowered).submesh((lowered[:, 2] > -1e-6)[cloth.faces].all(axis=1))[0]
    carriers = find_carriers(front, template.part_mesh(BODY_PART))
    assert carriers.sum() == 25
    np.testing.assert_allclose(front.vertices[carriers][:, 1], WAIST)


def test_a_roll_hangs_from_its_underside_on_skin_that_looks_up():
    """The scarf of the stress bench had lost what held it: nothing of its upper side touches the body."""
    skin = ball((0.2, 0.2, 0.2), 1.0, {"pelvis": 1.0}, subdivisions=4)
    angle, tilt = np.linspace(0.0, 2.0 * np.pi, 61), np.radians(35.0)
    away = 0.2 + 0.004 + 0.02  # metres: the sphere's radius, a gap, the roll's radius
    middle = away * np.stack([np.sin(tilt) * np.cos(angle), np.full(61, np.cos(tilt)), np.sin(tilt) * np.sin(angle)], 1)
    middle += [0.0, 1.0, 0.0]
    points, faces = tube_along(middle, np.full(61, 0.02))
    out = ((points - np.repeat(middle, 24, axis=0)) * TriangleMesh(points, faces).vertex_normals).sum(axis=1).mean()
    roll = TriangleMesh(points, faces if out > 0 else faces[:, ::-1])
    body = TriangleMesh(skin.vertices, skin.faces)
    carriers = find_carriers(roll, body)
    assert 61 * 4 <= carriers.sum() <= 61 * 10
    away = np.linalg.norm(points[carriers] - [0.0, 1.0, 0.0], axis=1) - 0.2
    assert away.max() < 0.012
    assert not find_carriers(roll.with_vertices(points + [0.0, 0.05, 0.0]), body).any()
    sheet = roll.submesh(((points - np.repeat(middle, 24, axis=0))[:, 1] > 0.005)[faces].all(axis=1))[0]
    assert not find_carriers(sheet, body).any()


def test_a_garment_that_nothing_holds_is_refused_with_what_to_do():
    with pytest.raises(InputError, match="to hang from") as error:
        cut(tight=False)
    assert PART in str(error.value) and "--cloth" in str(error.value)


def test_an_inside_out_garment_is_turned_over_and_said():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right = cut()
    with pytest.warns(GeometryWarning, match="inwards"):
        wrong = cut(outwards=False)
    np.testing.assert_array_equal(wrong.particles, right.particles)
    np.testing.assert_array_equal(wrong.pinned, right.pinned)
    out = np.einsum("fi,fi->f", wrong.rest.face_normals, wrong.rest.face_centers * [1, 0, 1])
    assert (out > 0).all()


def test_a_torn_garment_hangs_from_what_is_tight_and_its_scraps_ride_along():
    garment = cut(torn=True)
    assert garment.pinned.sum() > 10 and (garment.rest.vertices[garment.pinned][:, 1] > WAIST - 0.06).all()
    scrap = garment.vertices[-3:]
    assert not np.isin(scrap, garment.particles).any()
    assert np.isfinite(garment.vertex_depth[-3:]).all()


def test_a_scrap_that_lies_away_from_the_cloth_was_swung_like_a_flag_on_a_pole():
    """The end of a scarf went through chest and arms, on a triangle of the roll about the neck."""
    garment = cut(torn=True)
    assert np.linalg.norm(garment.embedding.offset[-3:], axis=1).min() > 0.1
    assert (garment.share()[-3:] == 0.0).all() and (garment.share()[:-3] == 1.0).any()


def test_what_is_no_garment_is_refused():
    template = person()
    for part in (BODY_PART, "cape"):
        with pytest.raises(InputError, match="loose part"):
            cut_garment(template, part, standing())
    flat = np.array(template.vertices)
    flat[template.body.vertex_count :] = [0.0, 1.0, 0.0]
    with pytest.raises(InputError, match="area"):
        cut_garment(replace(template, vertices=flat), PART, standing(), COARSE)


@pytest.mark.parametrize(
    ("cls", "name", "value"),
    [
        (GarmentConfig, "spacing", 0.0),
        (GarmentConfig, "pin_depth", -1.0),
        (GarmentConfig, "skin_margin", float("nan")),
        (Fabric, "density", 0.0),
        (Fabric, "compression", float("inf")),
        (Fabric, "friction", -0.1),
        (SolverConfig, "substep", 0.0),
        (SolverConfig, "contacts_every", 0),
        (SolverConfig, "own_margin", -1.0),
    ],
)
def test_numbers_that_mean_nothing_are_refused(cls, name, value):
    with pytest.raises(InputError, match=name):
        cls(**{name: value})
