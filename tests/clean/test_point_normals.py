"""Normals of clouds of points: outward on bodies whose limbs touch, whatever the unit, the place and the order."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.clean.poisson import estimate_normals
from smplxpp.core import BodyParams, TriangleMesh, matrix_from_rotvec
from smplxpp.core.topology import face_components
from smplxpp.metrics import sample_surface
from smplxpp.raster import outer_visible_points

TURN = matrix_from_rotvec(np.array([0.3, -1.1, 0.7]))


@cache
def person(arms_down: bool) -> TriangleMesh:
    """The open body without eyes and teeth; with arms down the upper arms lie on the trunk."""
    body = load_body()
    params = BodyParams.rest(betas=0, expressions=0)
    if arms_down:
        pose = np.array(params.body_pose)
        pose[0, 3 * 15 + 2], pose[0, 3 * 16 + 2] = -1.25, 1.25
        params = replace(params, body_pose=pose)
    posed = TriangleMesh(body.forward(params).vertices[0], body.faces)
    return posed.submesh(_outer(posed))[0]


def _outer(mesh: TriangleMesh) -> np.ndarray:
    component = face_components(mesh.faces)
    return component == np.argmax(np.bincount(component))


@pytest.mark.parametrize("arms_down", [False, True])
@pytest.mark.parametrize(("count", "noise", "most"), [(8000, 0.0, 0.03), (30000, 0.0, 0.015), (30000, 0.002, 0.03)])
@pytest.mark.long
def test_few_points_face_inward(arms_down: bool, count: int, noise: float, most: float):
    samples = sample_surface(person(arms_down), count, seed=0)
    samples = samples.select(outer_visible_points(person(arms_down), samples.points, tolerance=0.004))
    points = samples.points + np.random.default_rng(0).normal(size=samples.points.shape) * noise
    normals = estimate_normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    wrong = (np.einsum("ij,ij->i", normals, samples.normals) < 0).mean()
    assert wrong < most


def test_normals_move_with_the_points_and_their_order():
    samples = sample_surface(person(False), 6000, seed=1)
    normals = estimate_normals(samples.points)
    moved = estimate_normals(100 * (samples.points @ TURN.T) + [3.0, -2.0, 5.0])
    # Other views: where they are hidden from most of them, a few points take another side.
    assert (np.einsum("ij,ij->i", moved, normals @ TURN.T) > 0.99).mean() > 0.97
    order = np.random.default_rng(0).permutation(len(normals))
    np.testing.assert_allclose(estimate_normals(samples.points[order]), normals[order], atol=1e-9)
