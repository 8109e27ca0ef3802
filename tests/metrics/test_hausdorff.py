"""Bounds of the Hausdorff distance against brute force, and a spike that samples miss."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from smplxpp.core import GeometryWarning, InputError, TriangleMesh
from smplxpp.metrics import CompareConfig, compare, hausdorff, point_to_surface


def soup(rng: np.random.Generator, faces: int) -> TriangleMesh:
    """Random triangles: none of the neat cases of a surface."""
    return TriangleMesh(rng.normal(size=(3 * faces, 3)), np.arange(3 * faces).reshape(-1, 3))


def brute(source: TriangleMesh, target: TriangleMesh, cells: int) -> tuple[float, float]:
    """The largest distance of a grid on every face, and how far any other point may be from it (mm)."""
    i, j = np.meshgrid(np.arange(cells + 1), np.arange(cells + 1), indexing="ij")
    weights = np.stack([i, j, cells - i - j], axis=-1)[i + j <= cells] / cells
    points = np.einsum("gk,fkd->fgd", weights, source.triangles).reshape(-1, 3)
    longest = np.linalg.norm(source.triangles - np.roll(source.triangles, 1, axis=1), axis=2).max()
    return 1e3 * point_to_surface(points, target)[0].max(), 1e3 * longest / cells


@pytest.mark.parametrize("seed", range(8))
def test_the_bounds_hold_the_distance_of_random_triangles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = soup(rng, 2 + seed), soup(rng, 3)
    found = hausdorff(a, b, tolerance_mm=1.0)
    for bounds, (source, target) in ((found.a_to_b, (a, b)), (found.b_to_a, (b, a))):
        largest, step = brute(source, target, 60)
        assert largest <= bounds.upper_mm and bounds.lower_mm <= largest + step
        assert 0 <= bounds.upper_mm - bounds.lower_mm <= 1.001
        there = point_to_surface([bounds.point], target)[0]
        assert 1e3 * there[0] == pytest.approx(bounds.lower_mm, rel=1e-12)
    # Stopped early, the bounds are wide and still hold.
    early = hausdorff(a, b, tolerance_mm=1e-6, most_evaluations=10)
    assert early.lower_mm <= found.upper_mm and early.upper_mm >= found.lower_mm


def test_the_farthest_point_lies_within_a_face_between_two_surfaces() -> None:
    """Halfway between two squares 2 m apart, on the edge of neither face: no vertex and no middle of an edge."""
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    walls = np.concatenate([square[:, [1, 0, 2]] + [s, 0, 0] for s in (-0.97, 1.03)])
    found = hausdorff((0.9 * square, faces), (walls, np.concatenate([faces, faces + 4])), tolerance_mm=0.5)
    # Between the walls, in their middle at x = 0.03: 1 m from both.
    assert found.a_to_b.lower_mm == pytest.approx(1000.0, abs=0.5) and found.a_to_b.upper_mm >= 1000.0
    assert found.a_to_b.point[0] == pytest.approx(0.03, abs=1e-3)


@pytest.mark.long
def test_one_vertex_that_sticks_out_of_82k_faces_counts_in_full() -> None:
    """Samples hold a part of the 50 mm."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.5)
    vertices = np.array(ball.vertices)
    vertices[1234] *= 1.1
    result = compare((vertices, ball.faces), ball, samples=5_000, config=CompareConfig(certified=True))
    small = trimesh.creation.icosphere(subdivisions=2)
    tip = TriangleMesh(np.where(np.arange(162)[:, None] == 7, 1.1, 1.0) * small.vertices, small.faces)
    assert compare(tip, small, samples=100).hausdorff == pytest.approx(100.0)  # uncertified, too
    assert result.pred_to_gt.max < 45.0
    assert result.hausdorff == pytest.approx(50.0, abs=1e-6)
    assert result.hausdorff <= result.hausdorff_upper <= 50.02


def test_units_and_tolerances() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    moved = (ball.vertices + [0, 0, 0.002], ball.faces)
    metres = hausdorff(ball, moved)
    thousand = hausdorff((1e3 * ball.vertices, ball.faces), (1e3 * moved[0], ball.faces), unit="mm")
    assert thousand.lower_mm == pytest.approx(metres.lower_mm, rel=1e-9) and metres.upper_mm >= 2.0
    with pytest.raises(InputError, match="tolerance"):
        hausdorff(ball, moved, tolerance_mm=0.0)
    with pytest.raises(InputError, match="second mesh"):
        hausdorff(ball, (ball.vertices, np.zeros((0, 3), int)))


@pytest.mark.long
def test_meshes_in_other_units_get_few_evaluations() -> None:
    """Metres against millimetres, of which a warning tells, kept the command busy for ten minutes."""
    ball, fine = (trimesh.creation.icosphere(subdivisions=count, radius=0.5) for count in (3, 5))
    found = hausdorff((1e3 * ball.vertices, ball.faces), fine)
    # More vertices than evaluations: one pass over them. Fewer: the search comes to its end.
    assert len(fine.vertices) <= found.b_to_a.evaluations < len(fine.vertices) + 100
    assert found.a_to_b.evaluations < len(fine.vertices)
    assert found.a_to_b.upper_mm - found.a_to_b.lower_mm < 0.02
    assert found.lower_mm <= 499.5e3 * (1 + 1e-9) <= found.upper_mm


def test_normals_whose_winding_is_mixed_are_compared_without_their_sign() -> None:
    """A ball with every third face turned: the mean angle says 60 degrees, the consistency that nothing is off."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    faces = np.array(ball.faces)
    faces[::3] = faces[::3, ::-1]
    mixed = TriangleMesh(ball.vertices, faces)
    with pytest.warns(GeometryWarning, match="winding is mixed"):
        result = compare(mixed, ball, samples=2000)
    assert result.pred_to_gt.normal_angle_deg > 30.0
    # The same as a soup, whose faces share no vertex; its normals are the faces' own.
    apart = TriangleMesh(mixed.triangles.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))
    with pytest.warns(GeometryWarning, match="winding is mixed"):
        result = compare(apart, ball, samples=2000)
    assert result.pred_to_gt.normal_consistency > 0.99 and 50 < result.pred_to_gt.normal_angle_deg < 70
    turned = compare((ball.vertices, ball.faces[:, ::-1]), ball, samples=2000)
    assert turned.pred_to_gt.normal_angle_deg > 179.0 and turned.gt_to_pred.normal_consistency > 0.9999


def test_scores_at_several_thresholds_are_those_of_each() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    far = TriangleMesh(1.004 * ball.vertices + [0.002, 0, 0], ball.faces)
    several = compare(far, ball, samples=2000, config=CompareConfig(threshold_mm=(1.0, 4.0, 10.0)))
    for scores in several.scores:
        one = compare(far, ball, samples=2000, config=CompareConfig(threshold_mm=scores.threshold_mm))
        assert (scores.precision, scores.recall, scores.fscore) == (one.precision, one.recall, one.fscore)
    assert [s.threshold_mm for s in several.scores] == [1.0, 4.0, 10.0] and several.threshold_mm == 1.0
    assert several.scores[0].fscore < several.scores[1].fscore < several.scores[2].fscore == 1.0
    with pytest.raises(InputError, match="threshold_mm"):
        compare(far, ball, config=CompareConfig(threshold_mm=()))
