"""Presets of other papers: the algebra that ties them to each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from smplxpp.metrics import compare, directed_distances, presets, sample_surface


@pytest.fixture(scope="module")
def results(sphere, plane):
    a, b = sphere(0.5, 4), plane(0.2)
    return {name: compare(a, b, samples=4_000, preset=name) for name in presets()}


def test_every_preset_states_its_definition_source_and_unit(results):
    for name, convention in presets().items():
        assert convention.name == name
        assert convention.definition and convention.source
        assert results[name].unit == convention.unit
        assert results[name].convention == name


def test_centimetres_are_a_tenth_of_millimetres(results):
    ours, pifuhd = results["smplxpp"], results["pifuhd-cm"]
    assert pifuhd.p2s == pytest.approx(ours.p2s / 10, rel=1e-12)
    assert pifuhd.chamfer == pytest.approx(ours.chamfer / 10, rel=1e-12)
    assert pifuhd.pred_to_gt == ours.pred_to_gt


def test_icon_calls_the_other_direction_p2s(results):
    ours, icon = results["smplxpp"], results["icon-cm"]
    assert icon.p2s == pytest.approx(ours.gt_to_pred.mean / 10, rel=1e-12)
    assert icon.chamfer == pytest.approx(ours.chamfer / 10, rel=1e-12)
    assert icon.p2s != pytest.approx(ours.p2s / 10, rel=0.01)


def test_now_measures_every_vertex_of_the_truth_and_defines_no_chamfer(results, plane):
    now = results["now-mm"]
    assert now.gt_to_pred.count == plane(0.2).vertex_count
    assert now.p2s == pytest.approx(now.gt_to_pred.mean, rel=1e-12)
    assert now.chamfer is None


def test_pytorch3d_sums_what_occupancy_networks_halve(results):
    assert results["pytorch3d"].chamfer == pytest.approx(2 * results["occnet-l2"].chamfer, rel=1e-12)


def test_squared_is_the_square_of_the_root_mean_square(results):
    assert results["occnet-l2"].p2s == pytest.approx((results["occnet-l1"].pred_to_gt.rms / 1e3) ** 2, rel=1e-12)


def test_nearest_samples_are_never_nearer_than_the_surface(sphere, plane):
    a, b = sphere(0.5, 4), plane(0.2)
    surface = directed_distances(a, b, samples=2_000).distance
    nearest = directed_distances(a, b, samples=2_000, preset="occnet-l1").distance
    assert (nearest >= surface - 1e-12).all()
    assert nearest.mean() > surface.mean()


def test_two_samplings_of_one_mesh_do_not_coincide(sphere):
    """Nearest-sample conventions have a floor: the spacing of the samples, not zero."""
    ball = sphere(0.5, 4)
    result = compare(ball, ball, samples=2_000, preset="occnet-l1")
    spacing = np.sqrt(ball.face_areas.sum() / 2_000)
    assert 0.2 * spacing < result.chamfer < spacing


def test_occupancy_networks_by_hand(sphere, plane):
    a, b = sphere(0.5, 4), plane(0.2)
    points = sample_surface(a, 1_000, seed=0).points
    cloud = sample_surface(b, 1_000, seed=(0, 1)).points
    expected = np.mean(cKDTree(cloud).query(points)[0])
    assert compare(a, b, samples=1_000, preset="occnet-l1").p2s == pytest.approx(expected, rel=1e-12)
