"""Reports on skinning weights and on the stretch between two poses."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core import InputError, SkinWeights, TriangleMesh
from smplxpp.metrics import edge_stretch, flipped_faces, stretch_report, total_variation, weight_report


def test_good_weights_are_valid_and_counted():
    dense = np.array([[1.0, 0, 0], [0.5, 0.5, 0], [0.2, 0.3, 0.5]])
    for weights in (dense, SkinWeights.from_dense(dense)):
        report = weight_report(weights, reference=dense, edges=np.array([[0, 1], [1, 2]]))
        assert report.valid
        assert report.influences == (0, 1, 1, 1)
        assert report.reference.max < 1e-15
        assert report.edges.mean == pytest.approx(0.5)


def test_each_defect_is_named():
    report = weight_report(np.array([[0.0, 0.0], [1.2, -0.2], [0.5, 0.4]]))
    assert (report.zero_rows, report.negative) == (1, 1)
    assert report.minimum == -0.2
    assert report.row_sum_error == 1.0
    assert not report.valid


def test_total_variation_is_the_share_that_moved():
    a, b = np.array([[1.0, 0.0], [0.7, 0.3]]), np.array([[0.0, 1.0], [0.5, 0.5]])
    np.testing.assert_allclose(total_variation(a, b), [1.0, 0.2])
    report = weight_report(a, reference=b)
    assert report.reference.mean == pytest.approx(0.6)
    assert report.reference.max == 1.0


@pytest.mark.parametrize(
    ("weights", "options"),
    [
        (np.array([[np.nan, 1.0]]), {}),
        (np.zeros((0, 4)), {}),
        (np.ones(4), {}),
        (np.ones((2, 1)), {"reference": np.ones((2, 2))}),
        (np.ones((2, 1)), {"edges": np.array([[0, 2]])}),
        (np.ones((2, 1)), {"edges": np.array([[0.0, 1.0]])}),
    ],
)
def test_bad_weights_are_refused(weights, options):
    with pytest.raises(InputError):
        weight_report(weights, **options)


def test_a_rigid_motion_does_not_stretch_and_a_scale_does(sphere):
    ball = sphere(1.0, 3)
    turn = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    report = stretch_report(ball, ball.with_vertices(ball.vertices @ turn.T + 3.0))
    assert (report.min, report.p50, report.max) == pytest.approx((1, 1, 1), abs=1e-12)
    assert (report.flagged_edges, report.flipped_faces) == (0, 0)
    scaled = stretch_report(ball, ball.with_vertices(4.0 * ball.vertices))
    assert scaled.p99 == pytest.approx(4.0)
    assert scaled.flagged_edges == ball.edges.shape[0] == scaled.edge_count


def test_a_torn_edge_is_flagged_and_an_edge_without_length_left_out():
    rest = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    posed = rest.with_vertices(rest.vertices * [5.0, 1.0, 1.0])
    ratio = edge_stretch(rest, posed)
    np.testing.assert_array_equal(rest.edges, [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]])
    np.testing.assert_allclose(ratio, [5, 1, np.sqrt(13), np.sqrt(13), np.nan])
    report = stretch_report(rest, posed)
    assert (report.flagged_edges, report.degenerate_edges, report.edge_count) == (3, 1, 4)


def test_a_vertex_pushed_past_its_ring_turns_faces_over(plane):
    flat = plane(0.0, cells=6)
    middle = int(np.argmin(np.linalg.norm(flat.vertices, axis=1)))
    vertices = flat.vertices.copy()
    vertices[middle] += [0.45, 0.0, 0.1]
    turned = flipped_faces(flat, flat.with_vertices(vertices))
    assert 0 < turned.sum() <= 6
    assert (flat.faces[turned] == middle).any(axis=1).all()
    # Bending a sheet by 90 degrees turns nothing over.
    bent = np.where(flat.vertices[:, :1] > 0, flat.vertices[:, [1, 0, 2]], flat.vertices)
    assert not flipped_faces(flat, flat.with_vertices(bent)).any()


def test_other_topology_is_refused(plane):
    with pytest.raises(InputError, match="rest mesh"):
        stretch_report(plane(0.0), plane(0.0, cells=4))
    with pytest.raises(InputError, match="limit"):
        stretch_report(plane(0.0), plane(0.0), limit=0.0)
