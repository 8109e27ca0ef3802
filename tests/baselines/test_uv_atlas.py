"""The atlas: charts apart, inside the square, of one density, and true to length where the surface is a cylinder."""

from __future__ import annotations

import numpy as np
import pytest

from avatar.baselines.uv_unet import REACH, _unrolled, cylinder_atlas
from avatar.gaussians.binding import corner_weights
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from tests.dolls.swaying import template

SIZE = 64


@pytest.fixture(scope="module")
def unwrapped():
    bound = sample_on_mesh(template(), SamplingConfig(count=4000, hidden_density=1.0))
    corners = template().mesh.triangles[bound.face_index.numpy()]
    points = (corner_weights(bound.barycentric).double().numpy()[..., None] * corners).sum(axis=1)
    return cylinder_atlas(template(), points, bound.face_index.numpy(), size=SIZE), points


def test_charts_are_inside_and_apart(unwrapped):
    atlas, _ = unwrapped
    assert atlas.pixels.min() >= 0.0 and atlas.pixels.max() <= SIZE
    assert set(atlas.chart) == {0, 1, 2}  # torso, head, skirt
    boxes = [(atlas.pixels[atlas.chart == k].min(0), atlas.pixels[atlas.chart == k].max(0)) for k in range(3)]
    for a in range(3):
        for b in range(a):
            low, high = np.maximum(boxes[a][0], boxes[b][0]), np.minimum(boxes[a][1], boxes[b][1])
            assert (low > high).any(), "two charts share texels"


def test_a_texel_is_a_point_near_it(unwrapped):
    atlas, _ = unwrapped
    rows, columns = np.nonzero(atlas.anchor >= 0)
    away = atlas.pixels[atlas.anchor[rows, columns]] - np.stack([columns, rows], axis=1) - 0.5
    assert np.linalg.norm(away, axis=1).max() <= REACH
    # Every point's own texel has one: nothing of the surface is left out.
    column, row = np.minimum(atlas.pixels, SIZE - 1).astype(int).T
    assert (atlas.anchor[row, column] >= 0).all()


def test_neighbours_in_a_chart_are_neighbours_in_space(unwrapped):
    atlas, points = unwrapped
    anchor = atlas.anchor
    pairs = np.stack([anchor[:, :-1].ravel(), anchor[:, 1:].ravel()])
    pairs = pairs[:, (pairs >= 0).all(axis=0)]
    pairs = pairs[:, atlas.chart[pairs[0]] == atlas.chart[pairs[1]]]
    apart = np.linalg.norm(points[pairs[0]] - points[pairs[1]], axis=1)
    assert np.percentile(apart, 95) < 0.1


def test_a_cylinder_unrolls_without_stretch():
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(-2.0, 2.0, 500), rng.uniform(-1.0, 1.0, 500)
    # A whole ring, so that the axis goes through its middle.
    angle = np.concatenate([angle, angle + np.pi])
    height = np.concatenate([height, height])
    points = np.stack([0.2 * np.sin(angle), height, 0.2 * np.cos(angle)], axis=1)
    flat = _unrolled(points)
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 0.05
    seam = np.abs(flat[:, None, 0] - flat[None, :, 0]) > 0.5
    flat_apart = np.linalg.norm(flat[:, None] - flat[None], axis=-1)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    kept = near & ~seam & (apart > 1e-6)
    np.testing.assert_allclose(flat_apart[kept], apart[kept], rtol=0.05)
