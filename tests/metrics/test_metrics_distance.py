"""Distances between surfaces against shapes whose distances are known, other libraries, and invariants."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from smplxpp.core import InputError, TriangleMesh, concatenate_meshes
from smplxpp.metrics import CompareConfig, compare, directed_distances, point_to_surface, sample_surface


def random_rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def test_concentric_spheres_are_their_radii_apart(sphere):
    result = compare(sphere(1.0), sphere(0.9), samples=20_000)
    for way in (result.pred_to_gt, result.gt_to_pred):
        assert way.mean == pytest.approx(100.0, abs=0.5)
        assert way.rms == pytest.approx(100.0, abs=0.5)
        assert way.max == pytest.approx(100.0, abs=1.5)
        assert way.normal_angle_deg < 0.3
    assert result.p2s == result.pred_to_gt.mean
    assert result.chamfer == pytest.approx((result.pred_to_gt.mean + result.gt_to_pred.mean) / 2, abs=1e-12)
    # Vertices lie on the spheres, samples within.
    assert result.hausdorff == pytest.approx(100.0, abs=1e-9) and result.hausdorff >= result.pred_to_gt.max
    assert result.fscore == 0.0


def test_translated_plane_is_its_offset_away_everywhere(plane):
    result = compare(plane(0.003), plane(0.0), samples=5_000)
    for way in (result.pred_to_gt, result.gt_to_pred):
        for value in (way.mean, way.median, way.rms, way.p95, way.max):
            assert value == pytest.approx(3.0, abs=1e-9)
        assert way.normal_angle_deg == pytest.approx(0.0, abs=1e-6)
    assert (result.precision, result.recall, result.fscore) == (1.0, 1.0, 1.0)


def test_fscore_threshold_and_reversed_winding(plane):
    low = plane(0.0)
    turned = TriangleMesh(low.vertices, low.faces[:, ::-1])
    result = compare(plane(0.003), turned, samples=1_000, config=CompareConfig(threshold_mm=2.9))
    assert result.fscore == 0.0
    assert result.pred_to_gt.normal_angle_deg == pytest.approx(180.0, abs=1e-6)


def test_a_half_covered_plane_has_the_directions_apart(plane):
    """Ground truth twice as wide: prediction lies on it, half of each axis of the truth is uncovered."""
    small, large = plane(0.0, half=0.5), plane(0.0, half=1.0)
    result = compare(small, large, samples=200_000)
    assert result.pred_to_gt.max < 1e-9
    assert result.precision == 1.0
    # d = max(|x| - .5, 0) and the same in z: the mean of their norm over [-1, 1]^2, on a fine grid.
    axis = np.abs((np.arange(2000) + 0.5) / 1000 - 1)
    over = np.maximum(axis - 0.5, 0)
    expected = 1e3 * np.hypot(over[:, None], over[None]).mean()
    assert result.gt_to_pred.mean == pytest.approx(expected, rel=1e-3)
    assert result.gt_to_pred.max == pytest.approx(1e3 * np.hypot(0.5, 0.5), rel=0.01)


def test_swapping_the_meshes_swaps_the_directions(sphere, plane):
    a, b = sphere(0.5, 3), plane(0.2)
    one, other = compare(a, b, samples=2_000, seed=3), compare(b, a, samples=2_000, seed=3)
    assert one.pred_to_gt == other.gt_to_pred
    assert one.gt_to_pred == other.pred_to_gt
    assert one.chamfer == pytest.approx(other.chamfer, rel=1e-15)


def test_the_same_seed_gives_the_same_bits_and_another_seed_others(sphere):
    a, b = sphere(1.0, 3), sphere(0.9, 2)
    assert compare(a, b, samples=3_000, seed=5) == compare(a, b, samples=3_000, seed=5)
    assert compare(a, b, samples=3_000, seed=5) != compare(a, b, samples=3_000, seed=6)


def test_rigid_motion_changes_nothing(sphere, plane):
    a, b = sphere(0.5, 3), plane(0.2)
    rotation, shift = random_rotation(1), np.array([3.0, -2.0, 5.0])
    moved = [m.with_vertices(m.vertices @ rotation.T + shift) for m in (a, b)]
    one, other = compare(a, b, samples=2_000), compare(*moved, samples=2_000)
    np.testing.assert_allclose(
        [*vars(one.pred_to_gt).values(), *vars(one.gt_to_pred).values()],
        [*vars(other.pred_to_gt).values(), *vars(other.gt_to_pred).values()],
        rtol=1e-6,
    )


def test_scaling_the_scene_scales_the_distances(sphere, plane):
    a, b = sphere(0.5, 3), plane(0.2)
    one = compare(a, b, samples=2_000)
    other = compare(a.with_vertices(a.vertices * 10), b.with_vertices(b.vertices * 10), samples=2_000)
    assert other.p2s == pytest.approx(10 * one.p2s, rel=1e-9)
    assert other.hausdorff == pytest.approx(10 * one.hausdorff, rel=1e-9)
    assert other.pred_to_gt.normal_angle_deg == pytest.approx(one.pred_to_gt.normal_angle_deg, rel=1e-9)


def test_order_of_vertices_and_faces_matters_only_within_sampling_noise(sphere, plane):
    a, b = sphere(0.5, 4), plane(0.2)
    rng = np.random.default_rng(0)
    order = rng.permutation(a.vertex_count)
    shuffled = TriangleMesh(a.vertices[order], rng.permutation(np.argsort(order)[a.faces]))
    one, other = compare(a, b, samples=50_000), compare(shuffled, b, samples=50_000)
    assert other.p2s == pytest.approx(one.p2s, rel=2e-3)
    assert other.gt_to_pred.mean == pytest.approx(one.gt_to_pred.mean, rel=1e-9)


def test_samples_lie_on_the_surface_in_proportion_to_area():
    thin = TriangleMesh([[0, 0, 0], [4, 0, 0], [0, 2, 0], [4, 0, 1], [0, 0, 0]], [[0, 1, 2], [0, 4, 1], [1, 3, 2]])
    samples = sample_surface(thin, 10_000, seed=2)
    share = np.bincount(samples.face, minlength=3) / 10_000
    np.testing.assert_allclose(share, thin.face_areas / thin.face_areas.sum(), atol=2e-4)
    assert share[1] == 0.0
    distance = point_to_surface(samples.points, thin)[0]
    assert distance.max() < 1e-12
    # Uniform inside a triangle: the mean of the samples is its centroid.
    inside = samples.points[samples.face == 0]
    np.testing.assert_allclose(inside.mean(axis=0), [4 / 3, 2 / 3, 0], atol=0.05)


def test_closest_points_agree_with_trimesh(sphere):
    mesh = sphere(0.7, 3)
    points = np.random.default_rng(4).normal(size=(60, 3))
    distance, closest, face = point_to_surface(points, mesh)
    # trimesh's closest point of every triangle to every point: no tree on its side.
    every = trimesh.triangles.closest_point(
        np.tile(mesh.triangles, (len(points), 1, 1)), np.repeat(points, mesh.face_count, axis=0)
    ).reshape(len(points), mesh.face_count, 3)
    expected = np.linalg.norm(every - points[:, None], axis=2)
    np.testing.assert_allclose(distance, expected.min(axis=1), atol=1e-12)
    np.testing.assert_allclose(closest, every[np.arange(len(points)), expected.argmin(axis=1)], atol=1e-9)
    on_face = np.einsum("ij,ij->i", closest - mesh.triangles[face, 0], mesh.face_normals[face])
    assert np.abs(on_face).max() < 1e-12


def test_faces_without_area_are_never_hit(plane):
    flat = plane(0.0)
    spike = TriangleMesh(
        np.concatenate([flat.vertices, [[0, 5.0, 0]]]), np.concatenate([[[0, 81, 0], [81, 81, 81]], flat.faces])
    )
    distance, _, face = point_to_surface(np.array([[0.1, 4.0, 0.1]]), spike)
    assert distance[0] == pytest.approx(4.0)
    assert face[0] >= 2
    assert np.isfinite(compare(spike, flat, samples=500).p2s)


def test_visible_only_leaves_the_hidden_body_out(sphere):
    """A body under clothes: template to scan is inflated by the hidden layer, visible-only is not."""
    clothes, body = sphere(1.0, 4), sphere(0.9, 4)
    template = concatenate_meshes([clothes, body])
    whole = compare(template, clothes, samples=5_000)
    assert whole.p2s == pytest.approx(100 * 0.81 / 1.81, rel=0.02)
    visible = compare(template, clothes, samples=5_000, config=CompareConfig(visible_only=True, visible_tolerance=0.02))
    assert visible.p2s < 1e-3
    assert visible.pred_to_gt.count < whole.pred_to_gt.count
    assert visible.gt_to_pred.count > 4_900


def test_labels_of_faces_and_of_vertices_give_a_result_each(plane):
    """Left half 1 mm away, right half 4 mm: labels by x."""
    gt = plane(0.0, cells=16)
    left = gt.vertices[:, 0] < -1e-9
    pred = gt.with_vertices(gt.vertices + np.where(left, 0.001, 0.004)[:, None] * [0, 1, 0])
    face_labels = np.where(gt.triangles[:, :, 0].mean(axis=1) < 0, 3, 4)
    by_face = compare(pred, gt, samples=40_000, gt_labels=face_labels)
    assert set(by_face.labels) == {"upper", "lower"}
    assert by_face.labels["lower"].gt_to_pred.mean == pytest.approx(4.0, abs=0.1)
    assert by_face.labels["upper"].gt_to_pred.mean == pytest.approx(1.0, abs=0.25)
    counts = [r.gt_to_pred.count for r in by_face.labels.values()]
    assert sum(counts) == by_face.gt_to_pred.count
    by_vertex = compare(pred, gt, samples=40_000, pred_labels=np.where(left, 3, 4))
    assert by_vertex.labels["lower"].p2s == pytest.approx(4.0, abs=0.1)
    # Labels of both meshes: each direction counts its own mesh's.
    both = compare(pred, gt, samples=1_000, pred_labels=np.full(pred.face_count, 3), gt_labels=face_labels)
    assert both.labels["lower"].pred_to_gt is None
    assert both.labels["lower"].chamfer is None
    assert both.labels["lower"].gt_to_pred.count > 400


def test_the_result_is_plain_json(plane):
    gt = plane(0.0)
    result = compare(plane(0.001), gt, samples=100, gt_labels=np.full(gt.face_count, 99))
    loaded = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert loaded["labels"]["99"]["pred_to_gt"]["count"] == 100


@pytest.mark.parametrize(
    "call",
    [
        lambda m: compare(m, TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))),
        lambda m: compare(TriangleMesh(np.zeros((3, 3)), [[0, 1, 2]]), m),
        lambda m: compare(m, m, samples=0),
        lambda m: compare(m, m, preset="chamfer"),
        lambda m: compare(m, m, samples=10, gt_labels=np.zeros(7, int)),
        lambda m: compare(m, m, samples=10, gt_labels=np.zeros(m.face_count)),
        lambda m: compare(m, m, samples=10, config=CompareConfig(threshold_mm=float("nan"))),
        lambda m: point_to_surface(np.array([[0.0, np.nan, 0.0]]), m),
        lambda m: point_to_surface(np.zeros((3, 2)), m),
        lambda m: directed_distances(m, TriangleMesh(m.vertices, np.zeros((0, 3), int)), samples=10),
    ],
)
def test_what_cannot_be_measured_is_refused(plane, call):
    with pytest.raises(InputError, match="expected"):
        call(plane(0.0))


@pytest.mark.filterwarnings("ignore:.*winding is mixed")
@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(*[st.sampled_from([0.0, 1.0, 1e-8, -3.0, 1e4])] * 3), min_size=3, max_size=8),
    st.lists(st.tuples(*[st.integers(0, 2)] * 3), min_size=1, max_size=6),
)
def test_any_mesh_gives_finite_numbers_or_an_input_error(vertices, faces):
    mesh = TriangleMesh(np.array(vertices), np.array(faces))
    square = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    try:
        result = compare(mesh, square, samples=20)
    except InputError:
        assert not mesh.face_areas.any()
        return
    json.dumps(result.as_dict(), allow_nan=False)


@pytest.mark.long
def test_importing_the_metrics_imports_no_heavy_package():
    code = "import sys, smplxpp.metrics; print([m for m in ('torch', 'plotly', 'trimesh', 'rich') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
