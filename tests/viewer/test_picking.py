"""What lies under the pointer: hits, the middle of a limb, lines of a drag."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pipelines.viewer.scene import first_hit, hits, line_under, middle_of_limb
from smplxpp.core.mesh import concatenate_meshes
from smplxpp.segment.corrected_faces import ScanSurface
from tests.segment.test_corrections import tube

EYE = np.array([0.0, 0.5, 3.0])


@pytest.fixture(scope="module")
def surface():
    """Two legs side by side, and one 40 cm behind the left of them."""
    behind = tube(-0.2)
    return ScanSurface(concatenate_meshes([tube(-0.2), tube(0.2), behind.with_vertices(behind.vertices - [0, 0, 0.4])]))


def towards(x: float, y: float = 0.5) -> np.ndarray:
    """A direction that a camera at EYE sees the point (x, y, 0.06) in."""
    return np.array([x, y, 0.06]) - EYE


def test_the_nearest_hit_counts(surface):
    hit = first_hit(surface, EYE, towards(-0.2))
    assert hit.point[2] > 0.05 and hit.normal[2] > 0.9 and hit.normal @ towards(-0.2) < 0
    assert hit.distance == pytest.approx(np.linalg.norm(hit.point - EYE))
    np.testing.assert_allclose(surface.mesh.face_centers[hit.face], hit.point, atol=0.01)
    depths = [one.point[2] for one in hits(surface, EYE, towards(-0.2))]
    assert len(depths) >= 2 and depths == sorted(depths, reverse=True)
    assert first_hit(surface, EYE, towards(0.0)) is None and first_hit(surface, EYE, -towards(0.2)) is None


def test_a_face_seen_from_behind_turns_its_normal(surface):
    inside = first_hit(surface, np.array([0.2, 0.5, 0.0]), np.array([0.0, 0.0, 1.0]))
    assert inside.normal[2] < -0.9


def test_a_joint_lies_in_the_middle_of_the_limb(surface):
    found = middle_of_limb(surface, EYE, np.array([0.2, 0.5, 0.0]) - EYE)
    np.testing.assert_allclose(found, [0.2, 0.5, 0.0], atol=2e-3)
    assert middle_of_limb(surface, EYE, towards(0.0)) is None


def test_a_drag_leaves_a_line_on_the_surface(surface):
    ends = np.array([[0.17, 0.3, 1.0], [0.17, 0.7, 1.0]])
    ((points, normals),) = line_under(surface, EYE, ends, 0.02)
    assert len(points) > 20 and np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 0.025
    radii = np.linalg.norm((points - [0.2, 0, 0])[:, [0, 2]], axis=1)
    np.testing.assert_allclose(radii, 0.06, atol=3e-4)
    assert (np.einsum("nx,nx->n", normals, EYE - points) > 0).all()


def test_a_drag_across_both_legs_is_a_line_for_each(surface):
    ends = np.array([[-0.3, 0.5, 0.5], [0.3, 0.5, 0.5]])
    lines = [points for points, _ in line_under(surface, EYE, ends, 0.02)]
    assert lines[0][0, 0] < -0.1 and lines[-1][-1, 0] > 0.1 and len(lines) >= 2
    legs = [{(x > 0, z < -0.2) for x, _, z in points} for points in lines]
    assert all(len(leg) == 1 for leg in legs) and {(False, False), (True, False)} <= set.union(*legs)
    assert line_under(surface, EYE, np.array([[0.0, 0.5, 0.5]]), 0.02) == []


def test_a_pointer_that_lingers_leaves_no_more_points(surface):
    there = np.repeat(np.array([[0.17, 0.3, 1.0], [0.17, 0.35, 1.0]]), 400, axis=0)
    ((points, _),) = line_under(surface, EYE, there, 0.02)
    assert 4 <= len(points) < 20 and np.linalg.norm(np.diff(points, axis=0), axis=1).min() > 0.004


@pytest.mark.long
def test_a_very_long_drag_is_cut_into_lines_that_a_file_takes(surface):
    up = np.linspace(0.1, 0.9, 60)
    places = np.stack(
        [np.full(6000, 0.17), np.resize(np.concatenate([up, up[::-1]]), 6000), np.full(6000, 1.0)], axis=1
    )
    lines = line_under(surface, EYE, places, 0.003)
    assert len(lines) > 2 and all(len(points) <= 2000 for points, _ in lines)
    for (one, _), (other, _) in pairwise(lines):
        assert np.linalg.norm(one[-1] - other[0]) < 0.03  # none is missing between them
