"""Points drawn from surfaces, and distances between two of them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.surface_points import SurfacePoints, position_normal_features, truncated_distance


def _square(y: float) -> TriangleMesh:
    corners = np.array([[0, y, 0], [0, y, 1], [1, y, 1], [1, y, 0]], dtype=np.float64)
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_points_lie_on_their_faces_evenly_and_look_as_they_do():
    drawn = SurfacePoints.sample(_square(0.3), 4000)
    assert np.allclose(drawn.points[:, 1], 0.3)
    assert np.allclose(drawn.normals, [0, 1, 0])
    counts, _, _ = np.histogram2d(drawn.points[:, 0], drawn.points[:, 2], bins=4, range=[[0, 1], [0, 1]])
    assert np.abs(counts / 4000 - 1 / 16).max() < 5 * np.sqrt(1 / 16 / 4000)
    assert set(drawn.face) == {0, 1}


def test_the_same_seed_gives_the_same_points():
    one, other = (SurfacePoints.sample(_square(0.0), 50, seed=3) for _ in range(2))
    assert np.array_equal(one.points, other.points)
    assert not np.array_equal(one.points, SurfacePoints.sample(_square(0.0), 50, seed=4).points)


def test_two_planes_are_as_far_from_each_other_as_they_are_and_no_farther_than_far():
    below = SurfacePoints.sample(_square(0.0), 4000)
    for height, expected in ((0.1, 0.1), (9.0, 0.25)):
        above = SurfacePoints.sample(_square(height), 4000, seed=1)
        assert abs(truncated_distance(above.points, above.normals, below) - expected) < 0.01


def test_a_surface_that_faces_away_is_not_near():
    below = SurfacePoints.sample(_square(0.0), 500)
    assert truncated_distance(below.points, -below.normals, below) > 0.2


def test_the_distance_is_that_of_search_trees_far_from_the_origin_too():
    below = SurfacePoints.sample(_square(0.0), 300)
    above = SurfacePoints.sample(_square(0.1), 200, seed=1)
    away = np.array([300.0, -20.0, 40.0])
    there, here = position_normal_features(above.points, above.normals), below.tree.data
    one, other = cKDTree(here).query(there)[0], cKDTree(there).query(here)[0]
    expected = 0.5 * (np.minimum(one, 0.12).mean() + np.minimum(other, 0.12).mean())
    moved = SurfacePoints.from_arrays(below.points + away, below.normals)
    assert abs(truncated_distance(above.points, above.normals, below, far=0.12) - expected) < 1e-14
    assert abs(truncated_distance(above.points + away, above.normals, moved, far=0.12) - expected) < 1e-12
